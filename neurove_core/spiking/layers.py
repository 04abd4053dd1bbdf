"""Shared parts of the layers: random weights, a step repeated over a sequence, and checks of arguments."""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from neurove_core.spiking.surrogate import SURROGATES
from neurove_protocol.errors import InvalidField

StateT = TypeVar("StateT", bound=tuple[Any, ...])
ParamsT = TypeVar("ParamsT")


def scan_of(
    step: Callable[[Tensor, StateT, ParamsT], StateT], x: Tensor, state: StateT, params: ParamsT
) -> tuple[StateT, StateT]:
    """Repeat a step over a sequence (T, B, I): the states of all steps, each field (T, B, N), and the last one."""
    steps = []
    for x_t in x:
        state = step(x_t, state, params)
        steps.append(state)
    fields = zip(*steps, strict=True)
    return type(state)(*(torch.stack(field) for field in fields)), state


def drawn_weights(hidden: int, *shape: int) -> nn.Parameter:
    """Random weights of a layer of N neurons, uniform between -1 / sqrt(N) and 1 / sqrt(N)."""
    bound = hidden**-0.5
    return nn.Parameter(torch.empty(shape).uniform_(-bound, bound))


def require(ok: bool, what: str, field: str, value: object, bound: str) -> None:
    """Raise InvalidField, with what, field, value and bound, unless ok."""
    if not ok:
        raise InvalidField(what, field, value, bound)


def require_threshold(what: str, v_th: float, surrogate: str, surrogate_width: float) -> None:
    """Raise InvalidField unless threshold and width are finite and above 0 and the surrogate is known."""
    require(0 < v_th < math.inf, what, "v_th", v_th, "must be above 0 and finite")
    known = SURROGATES
    require(surrogate in known, what, "surrogate", surrogate, f"must be one of {', '.join(known)}")
    require(0 < surrogate_width < math.inf, what, "surrogate_width", surrogate_width, "must be above 0 and finite")


def require_shape_of_layer(what: str, **widths: int) -> None:
    """Raise InvalidField unless each width is at least 1."""
    for name, width in widths.items():
        require(width >= 1, what, name, width, "must be at least 1")


def require_width(what: str, x: Tensor, inputs: int) -> None:
    """Raise InvalidField unless the input (..., I) has the layer's width."""
    if x.shape[-1:] != (inputs,):  # without a call in the usual case, because this runs once per step
        raise InvalidField(what, "x.shape", tuple(x.shape), f"its last axis must be {inputs} wide")


def require_sequence(what: str, x: Tensor, inputs: int, state: Sequence[Tensor], hidden: int) -> None:
    """Raise InvalidField unless x is a sequence (T, B, I) of at least one step and the state is (B, N)."""
    bound = f"must be (T, B, {inputs}), T at least 1"
    require(x.dim() == 3 and x.shape[0] >= 1 and x.shape[2] == inputs, what, "x.shape", tuple(x.shape), bound)
    want = (x.shape[1], hidden)
    for tensor in state:
        require(tuple(tensor.shape) == want, what, "state.shape", tuple(tensor.shape), f"must be (B, N) = {want}")
