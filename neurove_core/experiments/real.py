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
from neurove_core.evaluation.estimates import estimate_recording
from neurove_core.evaluation.evaluate import NoTruth
from neurove_core.evaluation.metrics import SKIP_S
from neurove_core.experiments import save_text
from neurove_core.geometry.motion import Twists
from neurove_core.io.recording import Recording
from neurove_core.sim.render.camera import CAMERAS
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo, Events
from neurove_protocol.errors import NeuroVEError

Array = NDArray[np.float64]

STATIONARY_M_S: Final = 0.1
STATIONARY_RAD_S: Final = 0.05
"""Largest estimates for a stationary camera. The speed assumes a height of 1 m: no recording gives its height."""

_STATIONARY_S: Final = (0.1, 0.6)
"""When the camera of shapes_rotation_1.43s is stationary [s] after the first window.

It is stationary until 0.65 s; the estimator settles during the first two windows.
"""

_GYRO: Final = "ecd/shapes_rotation"
"""Folder of the gyro (imu.txt) of both recordings of shapes_rotation; it covers 0 to 1.6 s and 43.3 to 43.8 s."""

_PROFILE: Final = "ecd/shapes_rotation_1.43s.txt"
_EVBENCH: Final = ("evbench/seq_0001_e.mat", "evbench/seq_0002_e.mat")

_GYRO_REST_US: Final = 600_000
"""The camera of shapes_rotation is at rest up to this time: the mean of its gyro is its bias."""


class Measurement(NamedTuple):
    """The figure of a check, and the values it was computed from."""

    value: float
    made_of: dict[str, Any]


class Check(NamedTuple):
    """One requirement on a model for one recording."""

    recording: str  # its path in the folder of recordings
    what: str
    truth: str  # where the true value comes from
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
        one row per check: recording, what, truth, asked, value, met, made_of, skipped. `skipped` is the reason why a
        check was not run, and then value and met are None.
    """
    for check in CHECKS:
        row: dict[str, Any] = {name: getattr(check, name) for name in ("recording", "what", "truth", "asked")}
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
        "| recording | what | truth | asked | found | |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        found = f"skipped: {row['skipped']}" if row["skipped"] else f"{row['value']:.3g}"
        verdict = {True: "yes", False: "no", None: ""}[row["met"]]
        made_of = ", ".join(f"{name} {_shown(value)}" for name, value in row["made_of"].items())
        found += made_of and f" ({made_of})"
        about = " | ".join(row[name] for name in ("recording", "what", "truth", "asked"))
        lines.append(f"| {about} | {found} | {verdict} |")
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


class TurningRecording(NamedTuple):
    """A real recording of a camera that turns, with its truth."""

    name: str
    events: Events
    camera: CameraInfo
    truth: Twists  # nan where unknown
    axis: int  # the known one of vx vy vz wx wy wz


def turning_recordings(folder: Path) -> Iterator[TurningRecording]:
    """The recordings of the checks whose rate of turning is known: yaw of shapes_rotation_1.43s, and both of evbench.

    Args:
        folder: holds the recordings; missing ones are left out.
    """
    if (folder / _PROFILE).exists() and (folder / _GYRO).exists():
        recording = open_source(str(folder / _PROFILE))
        yield _turning("shapes_rotation yaw", recording, _gyro_twists(folder), 4)
    for name in _EVBENCH:
        if (folder / name).exists():
            recording = open_source(str(folder / name))
            truth = recording.twists()
            if truth is not None:
                yield _turning(f"evbench {_EVBENCH.index(name) + 1} about x", recording, _constant(recording, truth), 3)


def _constant(recording: Recording, truth: Twists) -> Twists:
    """The mean rate about x for the whole recording; the rest is nan."""
    t = np.arange(0, _last_us(recording) + 100_000, 10_000, dtype=np.int64)
    twist = np.full((t.size, 6), np.nan)
    twist[:, 3] = np.nanmean(truth.twist[:, 3])
    return Twists(t, twist)


def _turning(name: str, recording: Recording, truth: Twists, axis: int) -> TurningRecording:
    events = Events.join([Events.empty(), *recording.chunks()])
    return TurningRecording(name, events, _lens(recording, name), truth, axis)


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
    camera = _lens(recording, path.name)
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


def _lens(recording: Recording, name: str) -> CameraInfo:
    camera = recording.camera("real") or CAMERAS["davis346" if "davis346" in name else "davis240c"]
    if camera.sensor == recording.sensor:
        return camera
    wider, higher = recording.sensor.width / camera.width, recording.sensor.height / camera.height
    size = {"width": recording.sensor.width, "height": recording.sensor.height}
    lens = {"fx": camera.fx * wider, "fy": camera.fy * higher, "cx": camera.cx * wider, "cy": camera.cy * higher}
    return camera.model_copy(update=size | lens)


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
    true = _gyro(folder, series, slice(None)).mean(axis=0)
    found = series.twist[:, 3:].mean(axis=0)
    off = float(np.linalg.norm(found - true) / np.linalg.norm(true))
    return Measurement(off, {"estimate [rad/s]": found.tolist(), "gyro [rad/s]": true.tolist()})


def _profile(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    chosen = series.later(SKIP_S)
    return _correlation(series.twist[chosen, 4], _gyro(folder, series, chosen)[:, 1])


def _profile_error(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    chosen = series.later(SKIP_S)
    true = _gyro(folder, series, chosen)[:, 1]
    off = series.twist[chosen, 4] - true
    return Measurement(float(np.sqrt((off**2).mean())), {"RMS of the gyro": float(np.sqrt((true**2).mean()))})


def _gyro(folder: Path, series: _EstimateSeries, chosen: NDArray[np.bool_] | slice) -> Array:
    """Mean rates (W, 3) [rad/s] of the gyro of shapes_rotation over the chosen windows, without its bias."""
    truth = _gyro_twists(folder)
    return _window_means(truth.t, truth.twist[:, 3:], series, chosen)


def _gyro_twists(folder: Path) -> Twists:
    """Rates of the gyro of shapes_rotation without its bias; the linear part is nan."""
    t, rate = _imu(open_source(str(folder / _GYRO)))
    rest = t < _GYRO_REST_US
    if not rest.any():
        raise NoTruth(f"the gyro's bias is not known: {_GYRO}/imu.txt is missing, or has no sample before 0.6 s")
    return Twists(t, np.hstack([np.full_like(rate, np.nan), rate - rate[rest].mean(axis=0)]))


def _imu(recording: Recording) -> tuple[NDArray[np.int64], Array]:
    """Times (N,) [us] and rates (N, 3) [rad/s] of a recording's gyro."""
    samples = list(recording.imu())
    empty = np.zeros(0, np.int64), np.zeros((0, 3))
    t, rate = zip(empty, *((one.t, one.gyro_rad_s) for one in samples), strict=True)
    return np.concatenate(t), np.concatenate(rate)


def _window_means(
    t: NDArray[np.int64], rate: Array, series: _EstimateSeries, chosen: NDArray[np.bool_] | slice
) -> Array:
    """Mean (W, 3) of the samples within each chosen window."""
    spans = [t.searchsorted([start, start + series.window_us]) for start in series.start_us[chosen]]
    if any(first == stop for first, stop in spans):
        raise NoTruth("its gyro does not cover all windows")
    return np.array([rate[first:stop].mean(axis=0) for first, stop in spans])


def _stationary_rotation(name: str, estimator: Estimator, folder: Path) -> Measurement:
    """A hand holds the camera, which trembles: its gyro is the truth, not zero."""
    series = _estimate_series(estimator, folder / name)
    chosen = series.later(*_STATIONARY_S)
    true = _gyro(folder, series, chosen)
    off = np.linalg.norm(series.twist[chosen, 3:] - true, axis=1)
    speeds, rates = (np.linalg.norm(series.twist[chosen, part], axis=1) for part in (slice(0, 3), slice(3, 6)))
    made_of = {
        "median": float(np.median(off)),
        "speed at 1 m [m/s]": float(np.median(speeds)),
        "estimate at most [rad/s]": float(rates.max()),
        "gyro at most [rad/s]": float(np.linalg.norm(true, axis=1).max()),
    }
    return Measurement(float(off.max()), made_of)


def _gyro_sign(name: str, estimator: Estimator, folder: Path) -> Measurement:
    series = _estimate_series(estimator, folder / name)
    chosen = series.later(SKIP_S)
    true, found = _window_means(*_imu(series.recording), series, chosen)[:, 1].mean(), series.twist[chosen, 4].mean()
    return Measurement(float(found / true), {"estimate [rad/s]": float(found), "gyro [rad/s]": float(true)})


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


def _check(
    recording: str, what: str, truth: str, span: tuple[float, float], measure: Callable[..., Measurement]
) -> Check:
    return Check(recording, what, truth, *span, partial(measure, recording))


_UNIT, _SHAPES = "the pan-tilt unit", "the gyro, less its bias"
_TURNING, _SPEED = "turning at rest [rad/s]", "speed at rest at 1 m [m/s]"
STATIONARY_CHECKS: Final = (_TURNING, _SPEED)
"""Checks of the three recordings of a stationary camera, one for each."""

_REST: Final = "a stationary camera"

CHECKS: Final = (
    _check(_EVBENCH[0], "rotation about x over its truth", _UNIT, (0.7, 1.3), _pitch),
    _check(_EVBENCH[1], "rotation about x over its truth", _UNIT, (0.7, 1.3), _pitch),
    _check(
        "slider_depth/events_chunk.txt",
        "direction of motion, off by [deg]",
        "the poses of the slider",
        (-math.inf, 20),
        _direction,
    ),
    _check(
        "ecd/shapes_rotation/events.txt", "rate of turning at 43.5 s, relative error", _SHAPES, (-math.inf, 0.15), _rate
    ),
    _check(_PROFILE, "yaw, correlation", _SHAPES, (0.99, math.inf), _profile),
    _check(_PROFILE, "yaw, RMS error [rad/s]", _SHAPES, (-math.inf, 0.06), _profile_error),
    _check(
        _PROFILE,
        _TURNING,
        _SHAPES,
        (-math.inf, STATIONARY_RAD_S),
        _stationary_rotation,
    ),
    _check(
        "aedat2/IMU_translBoxes.aedat",
        "mean yaw over its truth (its sign)",
        "the gyro with its bias",
        (1e-6, math.inf),
        _gyro_sign,
    ),
    *(
        _check(f"aedat4/{name}.aedat4", what, _REST, span, measure)
        for name in ("davis346", "dvxplorer")
        for what, span, measure in (
            (_SPEED, (-math.inf, STATIONARY_M_S), _stationary_speed),
            ("share of windows flagged low activity", (0.5, math.inf), _low_activity),
        )
    ),
)
"""All checks, in the order of their rows."""
