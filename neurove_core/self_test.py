"""A model's self-test: run its golden windows through this machine's estimator and compare."""

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_protocol import Events, Sensor
from neurove_protocol.errors import BadModel

if TYPE_CHECKING:  # an estimator has a bundle, and a bundle a golden test
    from neurove_core.config import ModelConfig
    from neurove_core.estimator import Estimator
from neurove_core.models.golden import TOLERANCE, Golden

_INT8_GREW: Final = "; an int8 model made before the projection was in int8 too may answer otherwise (decision 38)"


_AXES: Final = ("vx", "vy", "vz", "wx", "wy", "wz")


def check(estimator: "Estimator") -> None:
    """Push the golden windows of a model through it and compare; a model without them passes.

    They go the way of a camera's events: through windows, encoding and engine.

    Args:
        estimator: of the model; no state of it is touched.

    Raises:
        BadModel: an answer is off by more than the tolerance, or not finite; window, bin and axis are named.
    """
    golden = estimator.bundle.golden
    if golden is None:
        return
    got, want = answers(estimator, golden.counts), golden.twists.astype(np.float64)
    allowed = golden.tolerance * np.abs(estimator.bundle.scale.double().numpy())
    off = np.abs(got - want) / np.maximum(allowed, np.finfo(np.float64).tiny)
    off[~np.isfinite(got)] = np.inf
    window, bin_, axis = (int(at) for at in np.unravel_index(int(np.argmax(off)), off.shape))
    if off[window, bin_, axis] > 1:
        raise BadModel(
            estimator.bundle.name,
            f"golden test: window {window}, bin {bin_}: {_AXES[axis]}={got[window, bin_, axis]:.6g}, where its maker "
            f"had {want[window, bin_, axis]:.6g}; the tolerance is {allowed[axis]:.2g}"
            + (_INT8_GREW if estimator.config.network.precision == "int8" else ""),
        )


def record(estimator: "Estimator", counts: NDArray[np.uint8], tolerance: float = TOLERANCE) -> Golden:
    """The golden test that these windows make with this model.

    Args:
        estimator: of the model as it will be saved.
        counts: (T, 2n, H, W) consecutive windows.
        tolerance: see `Golden`.
    """
    return Golden(counts, answers(estimator, counts).astype(np.float32), tolerance)


def answers(estimator: "Estimator", counts: NDArray[np.uint8]) -> NDArray[np.float64]:
    """What a model answers to windows (T, 2n, H, W), from a state at rest: (T, n, 6)."""
    config = estimator.config
    sensor = Sensor(config.canonical.width, config.canonical.height)  # scaled plainly onto a grid of its own size
    at_rest = estimator.initial_state(sensor)
    state, twists = (
        estimator.push(Events.empty(), at_rest, 0).state,
        [],
    )  # windows begin at 0, the first one may be empty
    for index, window in enumerate(counts):
        events = _events(window, index * config.window.duration_us, config)
        answer = estimator.push(events, state, (index + 1) * config.window.duration_us)
        state = answer.state
        twists += [estimate.twists for estimate in answer.estimates]
    return np.stack(twists)


def _events(counts: NDArray[np.uint8], start_us: int, config: "ModelConfig") -> Events:
    """Events that are counted as these counts (2n, H, W): all of a bin at its beginning."""
    channel, y, x = np.nonzero(counts)
    times = counts[channel, y, x]
    columns: list[NDArray[Any]] = [start_us + channel // 2 * config.window.bin_us, x, y, channel % 2]
    return Events.from_columns(*(np.repeat(column, times) for column in columns))
