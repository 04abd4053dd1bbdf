"""The spike function: a Heaviside step in the forward pass, a surrogate gradient in the backward pass.

    s = [u >= 0],  u = v - v_th                             forward
    ds/du = 1/width where |u| < width/2, else 0             rectangular (Wu 2018, h1)
    ds/du = max(0, 1 - |u|/width) / width                   triangle
    ds/du = (1/width) / (1 + (pi u / width)^2)              arctan

Source: NeuroVE, Eq. (6b) and (6c), and the sentence below them about the surrogate; Wu 2018.
Differs: the paper names no width; each surrogate here has area 1 over u.
"""

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
    """The surrogate of the step's derivative at u; each kind has area 1 over u. The module has the equations."""
    if kind == "rectangular":
        return (u.abs() < width / 2).to(u.dtype) / width
    if kind == "triangle":
        return (1 - u.abs() / width).clamp_min(0) / width
    return 1 / (width * (1 + (math.pi * u / width).square()))


def spike(u: Tensor, kind: Surrogate = "rectangular", width: float = 1.0) -> Tensor:
    """1 where u >= 0, else 0; its gradient is the surrogate gradient.

    Source: NeuroVE, Eq. (6b, 6c), with u = V - V_th.

    Raises:
        InvalidField: the kind of surrogate is unknown.

    >>> spike(torch.tensor([-0.1, 0.0, 0.1]))
    tensor([0., 1., 1.])
    """
    if kind not in SURROGATES:
        raise InvalidField("spike", "surrogate", kind, f"known are {', '.join(SURROGATES)}")
    return _Spike.apply(u, kind, width)  # type: ignore[no-any-return, no-untyped-call]  # torch types apply as Any
