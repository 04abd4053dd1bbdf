"""Checks of a model on real events that it was not tuned on: each compares one figure with a bound.

The recordings belong to third parties and are not part of the project. A check whose recording is missing is skipped
with that reason.
"""

import json
import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.estimator import Estimator
from neurove_core.evaluation.contrast import angular
from neurove_core.evaluation.evaluate import NoTruth, estimate_recording
from neurove_core.evaluation.metrics import SKIP_S
from neurove_core.experiments import save_text
from neurove_core.io.recording import Recording
from neurove_core.sim.render.camera import CAMERAS
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import Events

Array = NDArray[np.float64]

STATIONARY_M_S: Final = 0.1
STATIONARY_RAD_S: Final = 0.05
"""Largest estimates for a stationary camera. The speed assumes a height of 1 m: no recording gives its height."""

_STATIONARY_S: Final = (0.1, 0.6)
"""When the camera of shapes_rotation_1.43s is stationary [s] after the first window.

It is stationary until 0.65 s; the estimator settles during the first two windows.
"""

_MIN_EVENTS: Final = 500  # per window for contrast maximisation; with fewer the camera counts as stationary


class Measurement(NamedTuple):
    """The figure of a check, and the values it was computed from."""

    value: float
    made_of: dict[str, Any]


class Check(NamedTuple):
    """One requirement on a model for one recording."""

    recording: str  # its path in the folder of recordings
    what: str
    least: float
    most: float
    measure: Callable[[Estimator, Path], Measurement]

    @property
    def asked(self) -> str:
        """The bound as text."""
        if math.isinf(self.most):
            return "above 0" if self.least < 1e-3 else f"at least {self.least:g}"
        return f"at most {self.most:g}" if math.isinf(self.least) else f"{self.least:g} to {self.most:g}"


def run(estimator: Estimator, folder: Path) -> Iterator[dict[str, Any]]:
    """Run all checks of a model.

    Args:
        estimator: runs the model.
        folder: holds the recordings.

    Yields:
        one row per check: recording, what, asked, value, met, made_of, skipped. `skipped` is the reason why a check was
        not run, and then value and met are None.
    """
    for check in CHECKS:
        row: dict[str, Any] = {"recording": check.recording, "what": check.what, "asked": check.asked}
        empty: dict[str, Any] = {"value": None, "met": None, "made_of": {}}
        if not (folder / check.recording).exists():
            yield row | empty | {"skipped": "the recording is missing"}
            continue
        try:
            found = check.measure(estimator, folder)
        except NeuroVEError as error:
            yield row | empty | {"skipped": error.message}
            continue
        met = check.least <= found.value <= check.most
        yield row | {"value": found.value, "met": met, "made_of": found.made_of, "skipped": None}


def markdown(rows: list[dict[str, Any]], model: str) -> str:
    """The rows as a table in Markdown."""
    lines = [
        f"Real events, no tuning on them, {model}",
        "",
        "| recording | what | asked | found | |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        found = f"skipped: {row['skipped']}" if row["skipped"] else f"{row['value']:.3g}"
        verdict = {True: "yes", False: "no", None: ""}[row["met"]]
        made_of = ", ".join(f"{name} {_shown(value)}" for name, value in row["made_of"].items())
        found += made_of and f" ({made_of})"
        lines.append(f"| {row['recording']} | {row['what']} | {row['asked']} | {found} | {verdict} |")
    return "\n".join(lines) + "\n"


def save(rows: list[dict[str, Any]], about: dict[str, Any], out: Path) -> list[Path]:
    """Write real.json and real.md into a folder and return their paths.

    Args:
        rows: rows of `run`.
        about: the ModelInfo of the model as `model`, the command and the commit.
        out: folder, created if missing.

    Raises:
        InvalidField: a file cannot be written.
    """
    text = json.dumps(about | {"checks": rows}, indent=1) + "\n"
    return [save_text(text, out / "real.json"), save_text(markdown(rows, title(about)), out / "real.md")]


def title(about: dict[str, Any]) -> str:
    """The name of the model and the start of its digest, for the title of the table."""
    return f"model `{about['model']['name']}` ({about['model']['digest'][:12]})"


def _shown(value: float | list[float]) -> str:
    return " ".join(f"{one:.3g}" for one in value) if isinstance(value, list) else f"{value:.3g}"


# --- what each check measures -----------------------------------------------------------------------------------------


class _EstimateSeries(NamedTuple):
    """The estimates of a model for the W complete windows of a recording."""

    recording: Recording
    camera: CameraInfo
    start_us: NDArray[np.int64]  # (W,) starts of the windows
    since_s: Array  # (W,) starts of the windows, relative to the first
    twist: Array  # (W, 6) mean over a window's bins
    events: NDArray[np.int64]  # (W,)
    low_activity: NDArray[np.bool_]  # (W,)
    window_us: int

    @property
    def end_us(self) -> int:
        """End of the last window."""
        return int(self.start_us[-1]) + self.window_us

    def later(self, start_s: float, stop_s: float = math.inf) -> NDArray[np.bool_]:
        """Mask (W,) of the windows that start in this span, relative to the first window."""
        return (self.since_s >= start_s) & (self.since_s < stop_s)


def _estimate_series(estimator: Estimator, path: Path) -> _EstimateSeries:
    """Estimate all complete windows of a recording; without a known lens, assume that of a DAVIS.

    For shapes_rotation_1.43s the assumed lens is the right one. A DVXplorer gets the lens of a DAVIS240C, scaled to its
    sensor; that camera is stationary.
    """
    recording = open_source(str(path))
    camera = recording.camera("real") or CAMERAS["davis346" if "davis346" in path.name else "davis240c"]
    if camera.sensor != recording.sensor:
        wider, higher = recording.sensor.width / camera.width, recording.sensor.height / camera.height
        size = {"width": recording.sensor.width, "height": recording.sensor.height}
        lens = {"fx": camera.fx * wider, "fy": camera.fy * higher, "cx": camera.cx * wider, "cy": camera.cy * higher}
        camera = camera.model_copy(update=size | lens)
    answers = estimate_recording(estimator, recording, camera)
    window_us = answers.bin_us * answers.twists.shape[1]
    first_us, last_us = int(next(recording.chunks()).t[0]), _last_us(recording)
    complete = (answers.start_us >= first_us) & (answers.start_us + window_us <= last_us)
    if not complete.any():
        raise NoTruth(f"{path.name}: it has no complete window of {window_us / 1e3:g} ms")
    start_us = answers.start_us[complete]
    twist, low = answers.twists.mean(axis=1)[complete], answers.low_activity[complete]
    return _EstimateSeries(
        recording, camera, start_us, (start_us - start_us[0]) / 1e6, twist, answers.events[complete], low, window_us
    )


def _last_us(recording: Recording) -> int:
    last_us = 0
    for chunk in recording.chunks():
        last_us = int(chunk.t[-1])
    return last_us


def _pitch(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    truth = series.recording.twists()
    if truth is None:
        raise NoTruth("its ground-truth_3Dcam.txt is missing from the folder")
    true, found = float(np.nanmean(truth.twist[:, 3])), float(series.twist[series.later(SKIP_S), 3].mean())
    return Measurement(found / true, {"estimate [rad/s]": found, "truth [rad/s]": true})


def _direction(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    truth = series.recording.twists()
    if truth is None:
        raise NoTruth("its groundtruth.txt is missing from the folder")
    true = truth.at(series.start_us + series.window_us // 2)
    known = np.isfinite(true).all(axis=1)
    a, b = series.twist[known, :3].mean(0), true[known, :3].mean(0)
    cosine = float(a @ b / max(1e-12, float(np.linalg.norm(a) * np.linalg.norm(b))))
    angle = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    return Measurement(angle, {"estimate at 1 m [m/s]": a.tolist(), "truth [m/s]": b.tolist()})


def _rate(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    true = angular(_between(series.recording, int(series.start_us[0]), series.end_us), series.camera).w_rad_s
    found = series.twist[:, 3:].mean(axis=0)
    off = float(np.linalg.norm(found - true) / np.linalg.norm(true))
    return Measurement(off, {"estimate [rad/s]": found.tolist(), "contrast maximisation [rad/s]": true.tolist()})


def _profile(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    chosen = series.later(SKIP_S)
    starts = series.start_us[chosen].tolist()
    true = np.array([_yaw(_between(series.recording, t, t + series.window_us), series.camera) for t in starts])
    return _correlation(series.twist[chosen, 4], true)


def _yaw(events: Events, lens: CameraInfo) -> float:
    return float(angular(events, lens).w_rad_s[1]) if events.n >= _MIN_EVENTS else 0.0


def _stationary_rotation(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    rates = np.linalg.norm(series.twist[series.later(*_STATIONARY_S), 3:], axis=1)
    return Measurement(float(rates.max()), {"median": float(np.median(rates))})


def _gyro_profile(name: str, estimator: Estimator, folder: Path) -> Measurement:
    true, found = _yaw_rates(name, estimator, folder)
    return _correlation(found, true)


def _gyro_sign(name: str, estimator: Estimator, folder: Path) -> Measurement:
    true, found = _yaw_rates(name, estimator, folder)
    made_of = {"estimate [rad/s]": float(found.mean()), "gyro [rad/s]": float(true.mean())}
    return Measurement(float(found.mean() / true.mean()), made_of)


def _yaw_rates(name: str, estimator: Estimator, folder: Path) -> tuple[Array, Array]:
    """Yaw rates of the gyro and of the model, (W,) each [rad/s]."""
    series = _estimate_series(estimator, folder / name)
    samples = list(series.recording.imu())
    t, yaw = np.concatenate([one.t for one in samples]), np.concatenate([one.gyro_rad_s[:, 1] for one in samples])
    chosen = series.later(SKIP_S)
    spans = [t.searchsorted([start, start + series.window_us]) for start in series.start_us[chosen]]
    return np.array([yaw[a:b].mean() for a, b in spans]), series.twist[chosen, 4]


def _stationary_speed(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    chosen = series.later(_STATIONARY_S[0])
    speed, rate = (np.linalg.norm(series.twist[chosen, part], axis=1) for part in (slice(0, 3), slice(3, 6)))
    return Measurement(float(np.median(speed)), {"turning [rad/s]": float(np.median(rate))})


def _low_activity(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    return Measurement(float(series.low_activity.mean()), {"events in a window": float(np.median(series.events))})


def _correlation(found: Array, true: Array) -> Measurement:
    """The correlation of two series (W,), and the slope of the estimate over the truth."""
    spread = float(found.std() * true.std())
    covariance = float(((found - found.mean()) * (true - true.mean())).mean())
    return Measurement(
        covariance / max(spread, 1e-12), {"slope": covariance / float(true.var()), "windows": found.size}
    )


def _between(recording: Recording, start_us: int, stop_us: int) -> Events:
    events = Events.join([Events.empty(), *recording.since(start_us)])
    return events.span(0, int(events.t.searchsorted(stop_us)))


def _check(recording: str, what: str, span: tuple[float, float], measure: Callable[..., Measurement]) -> Check:
    return Check(recording, what, *span, partial(measure, recording))


CHECKS: Final = (
    _check("evbench/seq_0001_e.mat", "rotation about x over its truth", (0.7, 1.3), _pitch),
    _check("evbench/seq_0002_e.mat", "rotation about x over its truth", (0.7, 1.3), _pitch),
    _check("slider_depth/events_chunk.txt", "direction of motion, off by [deg]", (-math.inf, 20), _direction),
    _check(
        "ecd/shapes_rotation/events.txt", "rate of turning, off contrast maximisation's by", (-math.inf, 0.25), _rate
    ),
    _check("ecd/shapes_rotation_1.43s.txt", "yaw, correlation with contrast maximisation", (0.8, math.inf), _profile),
    _check(
        "ecd/shapes_rotation_1.43s.txt", "turning at rest [rad/s]", (-math.inf, STATIONARY_RAD_S), _stationary_rotation
    ),
    _check("aedat2/IMU_translBoxes.aedat", "yaw, correlation with the gyro", (0.8, math.inf), _gyro_profile),
    _check("aedat2/IMU_translBoxes.aedat", "mean yaw over the gyro's (its sign)", (1e-6, math.inf), _gyro_sign),
    _check("aedat4/davis346.aedat4", "speed at rest at 1 m [m/s]", (-math.inf, STATIONARY_M_S), _stationary_speed),
    _check("aedat4/davis346.aedat4", "share of windows flagged low activity", (0.5, math.inf), _low_activity),
    _check("aedat4/dvxplorer.aedat4", "speed at rest at 1 m [m/s]", (-math.inf, STATIONARY_M_S), _stationary_speed),
    _check("aedat4/dvxplorer.aedat4", "share of windows flagged low activity", (0.5, math.inf), _low_activity),
)
"""All checks, in the order of their rows."""
