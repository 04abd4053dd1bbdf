"""Functions of network states: tensors in named tuples, nested to any depth, that continue from window to window."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

S = TypeVar("S")


def tensors_of(state: Any) -> Iterator[Tensor]:
    """All tensors of a state, in order.

    >>> from neurove_core.spiking.lif import LIFState
    >>> [float(one) for one in tensors_of((LIFState(torch.tensor(1.0)), torch.tensor(2.0)))]
    [1.0, 2.0]
    """
    if isinstance(state, Tensor):
        yield state
        return
    for part in state:
        yield from tensors_of(part)


def is_finite(state: Any) -> bool:
    """Whether every number of a state is finite."""
    if all(math.isfinite(tensor.sum().item()) for tensor in tensors_of(state)):
        return True  # nan or inf makes a sum so, and a sum costs a third of a test of each number
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors_of(state))


def detached(state: S) -> S:
    """The state without its gradient history: gradients do not flow into the previous chunk."""
    if isinstance(state, Tensor):
        return state.detach()  # type: ignore[return-value]  # S is Tensor here
    parts = [detached(part) for part in state]  # type: ignore[attr-defined]  # a state is a tuple
    return type(state)(*parts) if hasattr(state, "_fields") else type(state)(parts)  # type: ignore[call-arg]  # tuples


def joined(states: Sequence[S]) -> S:
    """The states of several streams as one state of a batch.

    Args:
        states: each of a batch of one.
    """
    first = states[0]
    if isinstance(first, Tensor):
        return torch.cat(list(states), dim=_axis(first))  # type: ignore[arg-type, return-value]  # S is Tensor here
    parts = [joined(part) for part in zip(*states, strict=True)]
    return type(first)(*parts) if hasattr(first, "_fields") else type(first)(parts)  # type: ignore[call-arg]  # tuples


def parted(state: S, count: int) -> list[S]:
    """The states of the streams of a batch, as views of its memory.

    Args:
        state: of a batch.
        count: number of its streams.
    """
    if isinstance(state, Tensor):
        return list(torch.split(state, 1, dim=_axis(state)))  # type: ignore[arg-type]  # S is Tensor here
    parts = [parted(part, count) for part in state]  # type: ignore[attr-defined]  # a state is a tuple
    named = hasattr(state, "_fields")
    own = [[part[b] for part in parts] for b in range(count)]
    return [type(state)(*one) if named else type(state)(one) for one in own]  # type: ignore[call-arg]  # tuples


def _axis(tensor: Tensor) -> int:
    """The dimension of the batch: the first one, except in the states (L, B, N) of an LSTM."""
    return 1 if tensor.dim() == 3 else 0
