"""A folded convolution of the engine: its weights packed once for oneDNN where this torch offers it, else plain."""

import functools
import logging
from collections.abc import Callable
from typing import Any, Final

import torch
from torch import Tensor
from torch.nn.functional import conv2d

Convolution = Callable[[Tensor], Tensor]
"""(R, C, H, W) channels last to (R, C', H', W') channels last: 3x3, stride 2, one cell of zeros around."""

LARGE: Final = 1 << 20
"""Values of a map from which a try on three of them would take seconds and memory of a running service."""

log = logging.getLogger(__name__)


def convolution(weight: Tensor, bias: Tensor, rows: int, columns: int) -> Convolution:
    """A convolution with fixed weights, packed where that is proven to compute the same.

    The packed operator is private to torch and may change with it: at load it is tried on random numbers against the
    public one. Where it is missing or wrong the public one serves, slower; that is said once in the log.

    Args:
        weight: (C', C, 3, 3).
        bias: (C').
        rows: of the map that it mostly sees.
        columns: of the same.
    """
    try:
        packed = _packed(weight, bias, rows, columns)
        agrees = _agrees(tuple(weight.shape), rows, columns)
    except (AttributeError, RuntimeError, NotImplementedError, TypeError) as error:
        say_once("packed convolutions", str(error).partition("\n")[0])
        return plain_convolution(weight, bias)
    if not agrees:
        say_once("packed convolutions", "they compute something else")
        return plain_convolution(weight, bias)
    return packed


def plain_convolution(weight: Tensor, bias: Tensor) -> Convolution:
    """The same by torch's public operator."""
    laid_out = weight.contiguous(memory_format=torch.channels_last)
    return lambda x: conv2d(x, laid_out, bias, stride=2, padding=1)


def _packed(weight: Tensor, bias: Tensor, rows: int, columns: int) -> Convolution:
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
    """Whether the packed operator computes what the public one does, on one map and, where they are small, on three."""
    generator = torch.Generator().manual_seed(0)

    def draw(*sizes: int) -> Tensor:
        return torch.randn(*sizes, generator=generator)

    weight, bias = draw(*shape), draw(shape[0])
    ours, public = _packed(weight, bias, rows, columns), plain_convolution(weight, bias)
    for count in (1, 3) if shape[1] * rows * columns <= LARGE else (1,):
        x = draw(count, shape[1], rows, columns).contiguous(memory_format=torch.channels_last)
        got, want = ours(x), public(x)
        if got.shape != want.shape or not torch.allclose(got, want, rtol=1e-4, atol=1e-4 * float(want.abs().max())):
            return False
    return True


@functools.cache
def say_once(what: str, reason: str) -> None:
    """Log that a fast form is off, once for each reason."""
    log.warning("%s are off, plain ones serve: reason=%s", what, reason)


def forget_warnings() -> None:
    """Say it again at the next load."""
    say_once.cache_clear()
