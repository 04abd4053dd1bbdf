"""Golden test of a model: windows that travel in its bundle, and what its maker's machine answered to them.

The digest of a bundle shows that the bytes are those that were sent. Whether this machine, this torch and this version
of the program compute with them what their maker's did is another question, and this is its answer.
"""

from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.config import ModelConfig
from neurove_protocol.errors import BadModel

WINDOWS: Final = 12
"""T of a golden test where nothing else is asked for."""

TOLERANCE: Final = 0.02
"""Of an answer, as a share of the model's output scale; see `Golden`."""

MAX_CELLS: Final = 1 << 26
"""Cap of T * 2n * H * W: so many bytes are the counts of a golden test in memory."""

_SEEN, _COUNTS, _TWISTS = "golden.seen", "golden.counts", "golden.twists"


class Golden(NamedTuple):
    """Windows and the answers to them, from a state at rest."""

    counts: NDArray[np.uint8]  # (T, 2n, H, W)
    twists: NDArray[np.float32]  # (T, n, 6) in the bundle's linear unit and rad/s
    tolerance: float = TOLERANCE  # an axis may be off by this times the bundle's scale of that axis


def to_tensors(golden: Golden) -> dict[str, Tensor]:
    """A golden test as the tensors of a bundle: most cells see nothing, and cost a bit each.

    `golden.seen` has a bit for each cell of (T, 2n, H, W), the first one highest, 1 where there were events;
    `golden.counts` the counts of these cells, in their order; `golden.twists` the answers (T, n, 6).
    """
    flat = golden.counts.reshape(-1)
    return {
        _SEEN: torch.from_numpy(np.packbits(flat != 0)),
        _COUNTS: torch.from_numpy(flat[flat != 0]),
        _TWISTS: torch.from_numpy(np.ascontiguousarray(golden.twists)),
    }


def stored_bytes(counts: NDArray[np.uint8]) -> int:
    """By how much windows (T, 2n, H, W) make a bundle's file larger, without their answers."""
    return (counts.size + 7) // 8 + int(np.count_nonzero(counts))


def from_tensors(tensors: dict[str, Tensor], config: ModelConfig, tolerance: float | None, name: str) -> Golden | None:
    """Take the golden test out of a bundle's tensors; none where it has none.

    Args:
        tensors: of the bundle; those of the golden test are removed.
        config: of the model.
        tolerance: that the bundle's header says.
        name: whose tensors these are, for errors.

    Raises:
        BadModel: a part is missing, of a wrong shape or type, or parts do not go together.
    """
    found = {key: tensors.pop(key) for key in (_SEEN, _COUNTS, _TWISTS) if key in tensors}
    if not found and tolerance is None:
        return None
    for key in (_SEEN, _COUNTS, _TWISTS):
        if key not in found:
            raise BadModel(name, f"tensor {key!r} is missing: a golden test has three tensors and a tolerance")
    if tolerance is None:
        raise BadModel(name, "header field golden_tolerance=missing: it holds the tensors of a golden test")
    twists, grid = found[_TWISTS], (2 * config.window.bins, config.canonical.height, config.canonical.width)
    windows = len(twists) if twists.dim() else 0
    cells = windows * int(np.prod(grid))
    if not 0 < cells <= MAX_CELLS:
        raise BadModel(name, f"golden test of {windows} windows: {cells} cells, it may have 1 to {MAX_CELLS}")
    _require(found, _TWISTS, torch.float32, (windows, config.window.bins, 6), name)
    if not bool(torch.isfinite(twists).all()):
        raise BadModel(name, f"tensor {_TWISTS!r} holds values that are not finite")
    _require(found, _SEEN, torch.uint8, ((cells + 7) // 8,), name)
    seen = np.unpackbits(found[_SEEN].numpy())
    _require(found, _COUNTS, torch.uint8, (int(seen.sum()),), name)
    counts = found[_COUNTS].numpy()
    if seen[cells:].any() or not counts.all():
        raise BadModel(name, "golden test: a count of 0, or a bit behind the last cell")
    flat = np.zeros(cells, np.uint8)
    flat[seen[:cells] != 0] = counts
    return Golden(flat.reshape(windows, *grid), twists.numpy(), tolerance)


def _require(found: dict[str, Tensor], key: str, dtype: torch.dtype, shape: tuple[int, ...], name: str) -> None:
    tensor = found[key]
    if tensor.dtype != dtype or tuple(tensor.shape) != shape:
        got = f"{tensor.dtype} {tuple(tensor.shape)}"
        raise BadModel(name, f"tensor {key!r} is {got}, this golden test needs {dtype} {shape}")
