"""The stored golden test of a model: windows in its bundle, and the twists that its maker's machine computed for them.

The digest of a bundle proves that the bytes are unchanged. The golden test shows that this machine and this
version of the program compute the same twists as the maker's. `neurove_core.self_test` records and runs it.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.config import ModelConfig
from neurove_protocol.errors import BadModel

WINDOWS: Final = 12
"""Default number of windows T of a golden test."""

TOLERANCE: Final = 0.02
"""Default tolerance of a twist, as a fraction of the model's output scale; see `Golden`."""

MAX_CELLS: Final = 1 << 26
"""Largest T * 2n * H * W: the bytes that the counts of a golden test take in memory."""

_SEEN, _COUNTS, _TWISTS = "golden.seen", "golden.counts", "golden.twists"


class Golden(NamedTuple):
    """Windows and their expected twists, from the zero state."""

    counts: NDArray[np.uint8]  # (T, C, H, W), C of `ModelConfig.window_shape`: 2n without subcells
    twists: NDArray[np.float32]  # (T, n, 6) expected, in the bundle's linear unit and rad/s
    tolerance: float = TOLERANCE  # largest error of an axis, as a fraction of the bundle's scale of that axis


def to_tensors(golden: Golden) -> dict[str, NDArray[Any]]:
    """Store a golden test as tensors of a bundle. Most cells have no events and take one bit each.

    `golden.seen` has one bit per cell of (T, 2n, H, W), most significant bit first; it is 1 where there were events.
    `golden.counts` holds the counts of these cells in order, `golden.twists` the expected twists (T, n, 6).
    """
    flat = golden.counts.reshape(-1)
    return {
        _SEEN: np.packbits(flat != 0),
        _COUNTS: flat[flat != 0],
        _TWISTS: np.ascontiguousarray(golden.twists),
    }


def stored_bytes(counts: NDArray[np.uint8]) -> int:
    """Bytes that the windows (T, 2n, H, W) add to the file of a bundle, without their twists."""
    return (counts.size + 7) // 8 + int(np.count_nonzero(counts))


def from_tensors(
    tensors: dict[str, NDArray[Any]], config: ModelConfig, tolerance: float | None, name: str
) -> Golden | None:
    """Take the golden test out of a bundle's tensors; None if it has no golden test.

    Args:
        tensors: tensors of the bundle; those of the golden test are removed.
        config: configuration of the model.
        tolerance: `golden_tolerance` of the bundle's header.
        name: of the bundle, for errors.

    Raises:
        BadModel: a tensor or the tolerance is missing, a tensor has a wrong shape or type, or the parts do not match.
    """
    found = {key: tensors.pop(key) for key in (_SEEN, _COUNTS, _TWISTS) if key in tensors}
    if not found and tolerance is None:
        return None
    for key in (_SEEN, _COUNTS, _TWISTS):
        if key not in found:
            raise BadModel(name, f"tensor {key!r} is missing: a golden test has three tensors and a tolerance")
    if tolerance is None:
        raise BadModel(name, "header field golden_tolerance=missing: the bundle has the tensors of a golden test")
    twists, grid = found[_TWISTS], config.window_shape
    windows = len(twists) if twists.ndim else 0
    cells = windows * int(np.prod(grid))
    if not 0 < cells <= MAX_CELLS:
        raise BadModel(name, f"golden test of {windows} windows: {cells} cells, allowed are 1 to {MAX_CELLS}")
    _require(found, _TWISTS, np.float32, (windows, config.window.bins, 6), name)
    if not bool(np.isfinite(twists).all()):
        raise BadModel(name, f"tensor {_TWISTS!r} holds values that are not finite")
    _require(found, _SEEN, np.uint8, ((cells + 7) // 8,), name)
    seen = np.unpackbits(found[_SEEN])
    _require(found, _COUNTS, np.uint8, (int(seen.sum()),), name)
    counts = found[_COUNTS]
    if seen[cells:].any() or not counts.all():
        raise BadModel(name, "golden test: a count is 0, or a bit after the last cell is set")
    flat = np.zeros(cells, np.uint8)
    flat[seen[:cells] != 0] = counts
    return Golden(flat.reshape(windows, *grid), twists.copy(), tolerance)


def _require(
    found: dict[str, NDArray[Any]], key: str, dtype: type[np.generic], shape: tuple[int, ...], name: str
) -> None:
    tensor = found[key]
    if tensor.dtype != dtype or tensor.shape != shape:
        got = f"{tensor.dtype} {tensor.shape}"
        raise BadModel(name, f"tensor {key!r} is {got}, this golden test needs {np.dtype(dtype)} {shape}")
