"""Lists of the neurons that fired, and the layouts that they are read from and written to."""

from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.compiled import compiled
from neurove_core.engine.vectors import LANES

Array = NDArray[np.float32]


Places = NDArray[np.int32]


SPARE: Final = 2 * LANES
"""Numbers behind those of a list that may be read and written, and mean nothing."""


class Fired(NamedTuple):
    """Who fired, in maps (R, H, W, C)."""

    places: Places  # of those that fired, in their map as it lies channels last, ascending; map after map
    starts: Places  # (R * H * W + 1): where in `places` each cell begins
    shape: tuple[int, int, int, int]
    found: int  # of `places`; what lies behind means nothing


def maps_of(fired: Fired, kind: type[np.generic] = np.float32) -> Tensor:
    """Spikes of 0 and 1 (R, C, H, W), channels last."""
    maps = np.zeros((fired.shape[0], fired.shape[1] * fired.shape[2] * fired.shape[3]), kind)
    mark_starts(fired.places, fired.starts, maps)
    return in_maps(maps.reshape(fired.shape))


def listed(maps: Tensor) -> Fired:
    """What `maps_of` undoes."""
    rows = cells_of(maps)
    flat = rows.reshape(rows.shape[0], -1)
    found = np.nonzero(flat)[1]
    places = np.zeros(found.size + SPARE, np.int32)
    places[: found.size] = found
    cells = np.count_nonzero(rows.reshape(-1, rows.shape[3]), axis=1)
    starts = np.concatenate([[0], np.cumsum(cells)]).astype(np.int32)
    return Fired(places, starts, rows.shape, found.size)


def shape_after(given: tuple[int, ...], weights: tuple[int, int], v: Array) -> tuple[int, int, int, int]:
    """Shape (R, H', W', C') after a layer of C and C' channels; compiled code asks no more whether all fits."""
    maps, rows, columns, inputs = given
    shape = (rows + 1) // 2, (columns + 1) // 2, weights[1]
    if v.shape[1:] != shape or maps % v.shape[0] or inputs != weights[0] or v.dtype != np.float32:
        have = f"{v.dtype} {v.shape}"
        raise ValueError(f"maps {given} and weights {weights} give {shape} for each stream, potentials are {have}")
    return maps, *shape


def values_of(x: Tensor) -> NDArray[Any]:
    """Of a tensor, without its gradient; each call of torch takes as long as a small layer's kernel starts in."""
    values: NDArray[Any] = (x.detach() if x.requires_grad else x).numpy()
    return values


def cells_of(maps: Tensor) -> NDArray[Any]:
    """Maps (R, C, H, W) as (R, H, W, C): their own memory, where they lie channels last."""
    return np.ascontiguousarray(values_of(maps).transpose(0, 2, 3, 1))


def in_maps(cells: Array) -> Tensor:
    """What `cells_of` undoes."""
    return torch.from_numpy(cells.transpose(0, 3, 1, 2))


def allocate_list(shape: tuple[int, int, int, int]) -> tuple[Places, Places]:
    """Room for all of these maps to fire."""
    cells = shape[0] * shape[1] * shape[2]
    return np.empty(cells * shape[3] + SPARE, np.int32), np.empty(cells + 1, np.int32)


@compiled
def mark_starts(given: Places, starts: Places, maps: NDArray[Any]) -> None:  # pragma: no cover (machine code)
    """Write 1 where someone fired; maps (R, H * W * C) are 0."""
    cells = (starts.size - 1) // maps.shape[0]
    for r in range(maps.shape[0]):
        for i in range(starts[r * cells], starts[(r + 1) * cells]):
            maps[r, given[i]] = 1
