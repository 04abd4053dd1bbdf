"""Everything that can be wrong with a recording is found here, before anything is learned from it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.adaptation import clock
from neurove_core.adaptation import truth as truths
from neurove_core.adaptation.pieces import Pieces, divide, in_seconds
from neurove_core.adaptation.truth import Asked, Truth
from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import Estimates, estimate_recording
from neurove_core.geometry.motion import Twists
from neurove_core.io import Recording
from neurove_core.io.calibration import with_lens
from neurove_core.sources import open_source
from neurove_protocol import Sensor
from neurove_protocol.errors import InvalidField

_OPPOSITE: Final = -0.5  # correlation of a turning rate at which the frame of the truth must be wrong
_MOVES_M_S: Final = 0.5
_STREAM: Final = "adapt"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Input:
    """How to read the recordings."""

    sensor: Sensor | None = None
    events_topic: str | None = None
    time_unit: str | None = None
    calibration: str | None = None
    height_m: float | None = None
    offset_s: float | None = None  # of the truth's clock; None: estimated
    held_out: float = 0.2  # share of each recording


@dataclass(frozen=True)
class Prepared:
    """A recording that can be learned from."""

    source: str
    recording: Recording
    height_m: float
    truth: Truth  # on the clock of the events
    pieces: Pieces
    before: Estimates  # of the model that the adaptation begins from
    notes: tuple[str, ...]  # what was read, assumed and corrected, one sentence each


def opened(source: str, given: Input) -> tuple[Recording, Recording]:
    """Open a recording, plain and with the lens that the user gives.

    Raises:
        InvalidField: it never ends, or it has no lens or no height and the user gives none.
        UnknownSource, BrokenRecording, MissingGeometry, MissingExtra: as `open_source`.
    """
    plain = open_source(source, given.sensor, given.events_topic, given.time_unit)
    if plain.endless:
        raise InvalidField("adapt", "RECORDING", source, "it never ends: add ?seconds=S")
    seen = with_lens(plain, given.calibration, given.height_m)
    camera = seen.camera(_STREAM)
    if camera is None:
        why = (
            "it does not say the lens of its camera, without which no velocity can be learned: give --calibration FILE"
        )
        raise InvalidField("adapt", "--calibration", source, why)
    if camera.height_m is None:
        why = (
            "it does not say the height of its camera above the ground, and linear velocity is learned per metre of it"
        )
        raise InvalidField("adapt", "--height", source, why)
    return plain, seen


def prepare(
    source: str,
    given: Input,
    asked: Asked,
    estimator: Estimator,
    windows: tuple[int, int],
    on_events: Callable[[int], None] = lambda _: None,
) -> Prepared:
    """Read a recording and its truth, align their clocks, divide them, and estimate with the model before.

    Args:
        source: of the recording.
        given: how to read it.
        asked: where its truth is.
        estimator: the model before.
        windows: the least number of consecutive windows to learn from, and to validate with.
        on_events: called after each packet with the number of events so far.

    Raises:
        InvalidField: as `opened`, `truth.read`, `check_overlap` and `divide`, or the truth contradicts the events.
    """
    plain, seen = opened(source, given)
    camera = seen.camera(_STREAM)
    assert camera is not None
    assert camera.height_m is not None  # both checked by opened
    truth = truths.read(plain, asked)
    if given.offset_s is not None:
        truth = _moved(truth, round(given.offset_s * 1e6))
    before = estimate_recording(estimator, seen, camera, on_events)
    if not len(before.start_us):
        raise InvalidField("adapt", "RECORDING", source, "it has no complete window of events")
    duration_us = estimator.config.window.duration_us
    start_us, end_us = int(before.start_us[0]), int(before.start_us[-1]) + duration_us
    truths.check_overlap(seen.name, truth.twists, start_us, end_us, asked.unit)
    truth, about_clock = _aligned(truth, seen, before, given.offset_s)
    _check_frame(seen.name, before, truth.twists)
    first, last = max(start_us, int(truth.twists.t[0])), min(end_us, int(truth.twists.t[-1]))
    pieces = divide(seen.name, first, last, given.held_out, windows[0] * duration_us, windows[1] * duration_us)
    notes = (
        f"{seen.name}: truth: {truth.about}",
        about_clock,
        f"held out: {in_seconds(pieces.held, start_us)}; learned from: {in_seconds(pieces.training, start_us)}; "
        f"validated on: {in_seconds(pieces.validation, start_us)}; at least 1 s between them is not used",
    )
    return Prepared(source, seen, camera.height_m, truth, pieces, before, notes)


def stamps_and_twists(estimates: Estimates) -> tuple[NDArray[np.int64], Array]:
    """Centre of each bin [us] and its twist (N, 6)."""
    bins = estimates.twists.shape[1]
    t_us = estimates.start_us[:, None] + (np.arange(bins) + 0.5) * estimates.bin_us
    return t_us.astype(np.int64).ravel(), estimates.twists.reshape(-1, 6)


def check_output(out: Path, *, force: bool) -> None:
    """Refuse a bundle that cannot be written.

    Raises:
        InvalidField: its name does not end in .safetensors, or it exists and must not be replaced.
    """
    if out.suffix != ".safetensors":
        raise InvalidField("adapt", "--out", str(out), "must end in .safetensors")
    if out.exists() and not force:
        raise InvalidField("adapt", "--out", str(out), "the file exists; --force replaces it")


def _moved(truth: Truth, offset_us: int) -> Truth:
    return replace(truth, twists=Twists(truth.twists.t + offset_us, truth.twists.twist))


def _aligned(truth: Truth, seen: Recording, before: Estimates, given_s: float | None) -> tuple[Truth, str]:
    """The truth on the clock of the events, and what was done."""
    if given_s is not None:
        return truth, f"clock: --offset moves the truth by {given_s:+.3f} s"
    by_gyro = clock.seen_by_gyro(seen.imu())
    by_model = clock.seen_by_model(*stamps_and_twists(before))
    for shown in (by_gyro, by_model):
        found = None if shown is None else clock.find_offset(shown, truth.twists)
        if shown is None or found is None:
            continue
        if abs(found.us) < shown.least_us:
            least_s = shown.least_us / 1e6
            about = (
                f"clock: {shown.source} and the truth agree to within {least_s:g} s (correlation {found.agreement:.2f})"
            )
            return truth, about + ("" if shown is by_gyro else "; a smaller offset needs a gyro or --offset")
        change = f"correlation {found.before:.2f} without it, {found.agreement:.2f} with it"
        said = f"clock: by {shown.source} the truth is {found.us / 1e6:+.2f} s behind the events ({change}); corrected"
        return _moved(truth, found.us), said
    return truth, "clock: events and truth do not show the same motion clearly enough to compare their clocks"


def _check_frame(name: str, before: Estimates, truth: Twists) -> None:
    """Refuse a truth that shows the opposite motion of the events.

    Raises:
        InvalidField: the camera would move backwards, or turn to the other side.
    """
    t_us, estimate = stamps_and_twists(before)
    true = truth.at(t_us)
    bound = "is the truth in another frame? --frame base|camera, --extrinsics FILE or --mount ROLL,PITCH,YAW"
    moving = np.isfinite(true[:, 2]) & (np.abs(true[:, 2]) > _MOVES_M_S)
    if moving.sum() > 100:
        mean = float(estimate[moving, 2].mean()), float(true[moving, 2].mean())
        if mean[0] * mean[1] < 0 and min(map(abs, mean)) > _MOVES_M_S:
            raise InvalidField(name, "vz", f"{mean[1]:.2f} m/s, events show {mean[0]:.2f}", bound)
    known = np.isfinite(true[:, 4])
    if known.sum() > 100 and true[known, 4].std() > 0.05 and estimate[known, 4].std() > 0.05:
        same = float(np.corrcoef(estimate[known, 4], true[known, 4])[0, 1])
        if same < _OPPOSITE:
            raise InvalidField(name, "wy", f"correlation {same:.2f} with the events", bound)
