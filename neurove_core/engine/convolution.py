"""A folded convolution of the engine: its weights packed once for oneDNN where this torch supports it, else plain."""

from collections.abc import Callable
from typing import Any, Final

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from neurove_core.engine.fallback import reason_of, warn_once

Convolution = Callable[[Tensor], Tensor]
"""(R, C, H, W) channels last to (R, C', H', W') channels last: 3x3, stride 2, zero padding of 1."""

LARGE: Final = 1 << 20
"""Values of a map from which the load-time check uses one map instead of three, to save seconds and memory."""


def convolution(weight: Tensor, bias: Tensor, rows: int, columns: int) -> Convolution:
    """A convolution with fixed weights, prepacked where that computes the same result.

    The prepacked operator is private to torch. When a model is loaded, it is compared with the public operator on
    random numbers. Where it is missing or differs, the public operator is used and one warning is logged.

    Args:
        weight: (C', C, 3, 3).
        bias: (C').
        rows: rows of the usual input map.
        columns: columns of the usual input map.
    """
    try:
        prepacked = _prepacked(weight, bias, rows, columns)
        agrees = _agrees(tuple(weight.shape), rows, columns)
    except (AttributeError, RuntimeError, NotImplementedError, TypeError) as error:
        warn_once("prepacked convolution", reason_of(error))
        return plain_convolution(weight, bias)
    if not agrees:
        warn_once("prepacked convolution", "its results differ")
        return plain_convolution(weight, bias)
    return prepacked


def plain_convolution(weight: Tensor, bias: Tensor) -> Convolution:
    """The reference implementation: torch's public operator."""
    laid_out = weight.contiguous(memory_format=torch.channels_last)
    return lambda x: conv2d(x, laid_out, bias, stride=2, padding=1)


def _prepacked(weight: Tensor, bias: Tensor, rows: int, columns: int) -> Convolution:
    run: Any = torch.ops.mkldnn._convolution_pointwise.default  # without the search among its overloads
    reorder: Any = torch.ops.mkldnn._reorder_convolution_weight
    shape = [1, weight.shape[1], rows, columns]
    with torch.inference_mode():
        own = reorder(weight, [1, 1], [2, 2], [1, 1], 1, shape)
    bias = bias.clone()

    def convolve(x: Tensor) -> Tensor:
        return run(x, own, bias, [1, 1], [2, 2], [1, 1], 1, "none", [], "")  # type: ignore[no-any-return]

    return convolve


@torch.inference_mode()
def _agrees(shape: tuple[int, ...], rows: int, columns: int) -> bool:
    """Whether the prepacked operator agrees with the public one, on one map and, where maps are small, on three."""
    generator = torch.Generator().manual_seed(0)

    def draw(*sizes: int) -> Tensor:
        return torch.randn(*sizes, generator=generator)

    weight, bias = draw(*shape), draw(shape[0])
    ours, public = _prepacked(weight, bias, rows, columns), plain_convolution(weight, bias)
    for count in (1, 3) if shape[1] * rows * columns <= LARGE else (1,):
        x = draw(count, shape[1], rows, columns).contiguous(memory_format=torch.channels_last)
        got, want = ours(x), public(x)
        if got.shape != want.shape or not torch.allclose(got, want, rtol=1e-4, atol=1e-4 * float(want.abs().max())):
            return False
    return True
