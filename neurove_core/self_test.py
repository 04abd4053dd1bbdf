"""Self-test of a model: run its golden windows through the estimator on this machine and compare the estimates."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from neurove_core.config import ModelConfig
from neurove_core.estimator import Estimator
from neurove_core.models.bundle import Bundle, from_bytes
from neurove_core.models.golden import TOLERANCE, Golden
from neurove_protocol import Events, Sensor
from neurove_protocol.errors import BadModel, InvalidField
from neurove_protocol.fields import WrongField

_INT8_GREW: Final = "; an int8 model made before the projection was in int8 too may give other estimates (decision 38)"

_AXES: Final = ("vx", "vy", "vz", "wx", "wy", "wz")


def check(estimator: Estimator) -> None:
    """Run the golden windows of a model and compare the estimates; a model without golden windows passes.

    The windows are processed like a camera's events: by windowing, encoding and engine.

    Args:
        estimator: estimator of the model; none of its streams is affected.

    Raises:
        BadModel: an estimate differs by more than the tolerance, or is not finite; window, bin and axis are named.
    """
    golden = estimator.bundle.golden
    if golden is None:
        return
    got, want = answers(estimator, golden.counts), golden.twists.astype(np.float64)
    allowed = golden.tolerance * np.abs(estimator.bundle.scaling[1])
    off = np.abs(got - want) / np.maximum(allowed, np.finfo(np.float64).tiny)
    off[~np.isfinite(got)] = np.inf
    window, bin_, axis = (int(at) for at in np.unravel_index(int(np.argmax(off)), off.shape))
    if off[window, bin_, axis] > 1:
        raise BadModel(
            estimator.bundle.name,
            f"golden test: window {window}, bin {bin_}: {_AXES[axis]}={got[window, bin_, axis]:.6g}, expected "
            f"{want[window, bin_, axis]:.6g}; the tolerance is {allowed[axis]:.2g}"
            + (_INT8_GREW if estimator.config.network.precision == "int8" else ""),
        )


def record(estimator: Estimator, counts: NDArray[np.uint8], tolerance: float = TOLERANCE) -> Golden:
    """The golden test of a model with these windows.

    Args:
        estimator: estimator of the model as it will be saved.
        counts: (T, 2n, H, W) consecutive windows.
        tolerance: see `Golden`.
    """
    return Golden(counts, answers(estimator, counts).astype(np.float32), tolerance)


def with_scales(model: Bundle, scales: tuple[int, ...], bounds: tuple[float, float]) -> Bundle:
    """A model that also runs on longer windows, with a new golden test if it has one; see `timescales`.

    Args:
        model: of any kind without a history; its weights and its uncertainty stay the same.
        scales: `scales` of ModelConfig.
        bounds: `scale_bounds` of ModelConfig.

    Raises:
        InvalidField: a value is wrong; the error names it.
    """
    try:
        config = ModelConfig.model_validate(model.config.model_dump() | {"scales": scales, "scale_bounds": bounds})
    except ValidationError as error:
        wrong = WrongField.of(error)
        raise InvalidField("model", wrong.name or "scales", wrong.value, wrong.why) from None
    made = from_bytes(replace(model, config=config, golden=None).to_bytes(), model.name)
    if model.golden is not None:
        made = replace(made, golden=record(Estimator(made), model.golden.counts, model.golden.tolerance))
    return made.with_digest()


def answers(estimator: Estimator, counts: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Twists (T, n, 6) of a model for windows (T, 2n, H, W), from the zero state."""
    config = estimator.config
    fine = config.canonical.fine
    sensor = Sensor(fine.width, fine.height)  # each pixel is one part of a cell of the grid
    state = estimator.push(Events.empty(), estimator.initial_state(sensor), 0).state  # windows begin at time 0
    twists = []
    for index, window in enumerate(counts):
        events = _events(window, index * config.window.duration_us, config)
        answer = estimator.push(events, state, (index + 1) * config.window.duration_us)
        state = answer.state
        twists += [estimate.twists for estimate in answer.estimates]
    return np.stack(twists)


def _events(counts: NDArray[np.uint8], start_us: int, config: ModelConfig) -> Events:
    """Events that give these counts of a window, all at the beginning of their bins."""
    at, y, x = np.nonzero(counts)
    times, n = counts[at, y, x], config.canonical.subcells
    channel, part = np.divmod(at, config.canonical.parts)
    place = (x * n + part % n, y * n + part // n)
    columns: list[NDArray[Any]] = [start_us + channel // 2 * config.window.bin_us, *place, channel % 2]
    return Events.from_columns(*(np.repeat(column, times) for column in columns))
