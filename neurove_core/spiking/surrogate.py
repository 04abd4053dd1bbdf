"""spike: Heaviside step forward, a surrogate gradient backward (paper Eq. 6c and the sentence below it; Wu 2018)."""

import math
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from neurove_protocol.errors import InvalidField

Surrogate = Literal["rectangular", "arctan", "triangle"]
SURROGATES: tuple[str, ...] = get_args(Surrogate)


class _Spike(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, u: Tensor, kind: Surrogate, width: float) -> Tensor:  # torch's own type
        ctx.save_for_backward(u)
        ctx.kind, ctx.width = kind, width
        return (u >= 0).to(u.dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:  # torch's own type
        (u,) = ctx.saved_tensors
        return grads[0] * surrogate_gradient(u, ctx.kind, ctx.width), None, None


def surrogate_gradient(u: Tensor, kind: Surrogate, width: float) -> Tensor:
    """The stand-in for the derivative of the step at u; each kind has area 1 over u.

    `rectangular`: 1/width where |u| < width/2 (Wu 2018, h1). `triangle`: max(0, 1 - |u|/width)/width.
    `arctan`: (1/width) / (1 + (pi u / width)^2).
    """
    if kind == "rectangular":
        return (u.abs() < width / 2).to(u.dtype) / width
    if kind == "triangle":
        return (1 - u.abs() / width).clamp_min(0) / width
    return 1 / (width * (1 + (math.pi * u / width).square()))


def spike(u: Tensor, kind: Surrogate = "rectangular", width: float = 1.0) -> Tensor:
    """1 where u >= 0, else 0; its gradient is the surrogate's.

    Source: NeuroVE, Eq. (6b, 6c), with u = V - V_th.

    Raises:
        InvalidField: the surrogate is unknown.

    >>> spike(torch.tensor([-0.1, 0.0, 0.1]))
    tensor([0., 1., 1.])
    """
    if kind not in SURROGATES:
        raise InvalidField("spike", "surrogate", kind, f"known are {', '.join(SURROGATES)}")
    return _Spike.apply(u, kind, width)  # type: ignore[no-any-return, no-untyped-call]  # torch types apply as Any
