"""Training's convolution of spikes, 3x3 with stride 2, over the neurons that fired: `neurove.SpikingBlock` on a CPU.

A dense convolution multiplies every neuron's 0 or 1. Where 14 % fire, adding the weights of those that fired takes 0.7
of its time, and adding their gradients takes 0.4 of the time of the dense gradient of the weights. The gradient of the
input is dense.

Sums have the order of oneDNN (rows, columns, channels; maps first in the gradient), so currents equal those of
`torch.nn.functional.conv2d` bit for bit. Tests compare both, and the gradients.
"""

from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from neurove_core.compiled import compiled

Array = NDArray[np.float32]
Indices = NDArray[np.int32]

_MOST: Final = 0.25  # share of neurons that fire, above which a dense convolution is about as fast
_WIDTH: Final = 16  # channels are multiples of this; oneDNN sums narrow maps in another order
_THREADS: Final = 2  # of torch; with more, its dense convolution is faster than this one, which uses one


def fits(spikes: Tensor, weight: Tensor) -> bool:
    """Whether `convolve` accepts maps (R, C, H, W) and weights (C', C, 3, 3), and gains by it."""
    return (
        torch.is_grad_enabled()
        and weight.requires_grad
        and not torch.is_autocast_enabled("cpu")
        and all(one.device.type == "cpu" and one.dtype == torch.float32 for one in (spikes, weight))
        and torch.get_num_threads() <= _THREADS
        and weight.shape[0] % _WIDTH == 0
        and weight.shape[1] % _WIDTH == 0
        and len(spikes) > 1  # a single map may be summed in another order
        and 0 < spikes.numel() < 1 << 31
    )


def convolve(spikes: Tensor, weight: Tensor) -> Tensor:
    """Convolution with stride 2 and a padding of 1.

    Args:
        spikes: 0 or 1 (R, C, H, W), accepted by `fits`.
        weight: (C', C, 3, 3).

    Returns:
        currents (R, C', H', W'), channels last.
    """
    return _Convolution.apply(spikes, weight)  # type: ignore[no-any-return, no-untyped-call]  # torch types apply as Any


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, spikes: Tensor, weight: Tensor) -> Tensor:  # torch's own type
        spikes = spikes.contiguous(memory_format=torch.channels_last)
        cells = spikes.permute(0, 2, 3, 1).numpy()
        indices, starts = np.empty(cells.size + 1, np.int32), np.empty(cells.size // cells.shape[3] + 1, np.int32)
        total = _list(cells, indices, starts)
        ctx.save_for_backward(spikes, weight)
        ctx.fired = None
        if total > _MOST * cells.size:
            return conv2d(spikes, weight, stride=2, padding=1)
        ctx.fired = indices[:total], starts
        maps, rows, columns, channels = cells.shape
        outputs = weight.shape[0]
        by_input = weight.detach().permute(2, 3, 1, 0).contiguous().numpy().reshape(9 * channels, outputs)
        currents = np.empty((maps, (rows + 1) // 2, (columns + 1) // 2, outputs), np.float32)
        _convolve(indices[:total], starts, cells.shape, by_input, currents.reshape(-1, outputs))
        return torch.from_numpy(currents).permute(0, 3, 1, 2)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None]:  # torch's own type
        spikes, weight = ctx.saved_tensors
        by_currents = grads[0].contiguous(memory_format=torch.channels_last)
        needs = [ctx.needs_input_grad[0], ctx.fired is None, False]
        found = torch.ops.aten.convolution_backward(
            by_currents, spikes, weight, None, [2, 2], [1, 1], [1, 1], False, [0, 0], 1, needs
        )
        by_spikes, by_weight = found[:2]
        if ctx.fired is not None:
            maps, channels, rows, columns = spikes.shape
            outputs = len(weight)
            sums = np.zeros((3, 3, channels, outputs), np.float32)
            given = by_currents.permute(0, 2, 3, 1).reshape(-1, outputs).numpy()
            indices, starts = ctx.fired
            _add_gradients(indices, starts, (maps, rows, columns, channels), given, sums.reshape(-1, outputs))
            by_weight = torch.from_numpy(sums).permute(3, 2, 0, 1)
        return by_spikes, by_weight


@compiled
def _list(maps: NDArray[Any], indices: Indices, starts: Indices) -> int:  # pragma: no cover (machine code)
    """List the neurons of maps (R, H, W, C) that fired, by their index in their map.

    Args:
        maps: 0 or 1.
        indices: written, map by map and cell by cell; one number behind the last is overwritten.
        starts: (R * H * W + 1), written: where each cell begins.

    Returns:
        number of spikes.
    """
    count, rows, columns, channels = maps.shape
    found = cell = 0
    for r in range(count):
        first = 0
        for y in range(rows):
            for x in range(columns):
                starts[cell] = found
                cell += 1
                for c in range(channels):
                    indices[found] = first + c
                    found += 1 if maps[r, y, x, c] != 0 else 0
                first += channels
    starts[cell] = found
    return found


@compiled
def _convolve(
    indices: Indices, starts: Indices, shape: tuple[int, int, int, int], weight: Array, out: Array
) -> None:  # pragma: no cover (machine code)
    """Currents (cells, C') of a list: the three cells of a row under the kernel are neighbours in the list.

    Args:
        indices: see `_list`.
        starts: see `_list`.
        shape: R, H, W, C of the spikes.
        weight: (3 * 3 * C, C').
        out: written.
    """
    maps, rows, columns, channels = shape
    outputs, cell = out.shape[1], 0
    for r in range(maps):
        for row in range(-1, rows - 1, 2):  # first row of the kernel
            for column in range(-1, columns - 1, 2):
                left, right = max(column, 0), min(column + 3, columns)
                current = out[cell]
                cell += 1
                for j in range(outputs):
                    current[j] = 0
                for y in range(max(row, 0), min(row + 3, rows)):
                    line = (r * rows + y) * columns
                    shift = ((y - row) * 3 - (y * columns + column)) * channels
                    for i in range(starts[line + left], starts[line + right]):
                        own = weight[indices[i] + shift]
                        for j in range(outputs):
                            current[j] += own[j]


@compiled
def _add_gradients(
    indices: Indices, starts: Indices, shape: tuple[int, int, int, int], by_currents: Array, out: Array
) -> None:  # pragma: no cover (machine code)
    """Gradient of the weights: to the row of each spike's weights, add the gradients of the cell that it excites.

    Args:
        indices: see `_list`.
        starts: see `_list`.
        shape: R, H, W, C of the spikes.
        by_currents: gradients of the currents (cells, C').
        out: zeros (3 * 3 * C, C'), added to.
    """
    maps, rows, columns, channels = shape
    height, width, outputs = (rows + 1) // 2, (columns + 1) // 2, out.shape[1]
    for kernel_row in range(3):  # a third of the sums at a time, so that they stay in the cache
        for r in range(maps):
            for above in range(height):
                y = 2 * above - 1 + kernel_row
                if y < 0 or y >= rows:
                    continue
                line = (r * rows + y) * columns
                for cell in range(width):
                    column = 2 * cell - 1
                    left, right = max(column, 0), min(column + 3, columns)
                    given = by_currents[(r * height + above) * width + cell]
                    shift = (kernel_row * 3 - (y * columns + column)) * channels
                    for i in range(starts[line + left], starts[line + right]):
                        own = out[indices[i] + shift]
                        for j in range(outputs):
                            own[j] += given[j]
