"""Estimator: a loaded model that turns the events of any number of camera streams into velocity estimates.

`push` takes a packet's events and answers each window that they complete; `push_many` does so for several streams in
one batch; `estimates` runs over a whole recording. Windows and encoding are the same as in training.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core import refined
from neurove_core.geometry.tables import TABLES
from neurove_core.ingest import windows
from neurove_core.ingest.channels import remembered
from neurove_core.ingest.windows import Pushed, Window, WindowsState
from neurove_core.io.packets import slices
from neurove_core.io.recording import Recording
from neurove_core.models.bounds import UNSET, Bounds
from neurove_core.models.bundle import PER_HEIGHT, Bundle, LinearUnit
from neurove_core.networks.arrays import Runner
from neurove_core.refine.view import View
from neurove_core.refined import Refined
from neurove_core.running import form_of, runner_of
from neurove_core.stream_state import StreamState, WindowEstimate
from neurove_core.timescales import Answer, Answered, Longer, Turn, answered
from neurove_core.warming import compile_refinement, warm_camera, warm_events
from neurove_protocol import CameraInfo, Events, Sensor
from neurove_protocol.errors import BadModel
from neurove_protocol.events import WireEvents

_STREAM = "cam0"
_METRES = np.ones(6)


class PushResult(NamedTuple):
    """Result of a push: an estimate for each window that was completed, and counts of events that were left out."""

    estimates: list[WindowEstimate]
    state: StreamState
    late_events: int
    outside_events: int
    skipped_windows: int


class Push(NamedTuple):
    """A packet of one stream; see Estimator.push for its parts."""

    events: Events | WireEvents
    state: StreamState
    horizon_us: int


@dataclass
class _Progress:
    """One stream during a push."""

    state: StreamState  # advances with each window
    windows: Sequence[Window]  # to answer
    lost: tuple[int, int, int] = (0, 0, 0)  # late events, events outside, skipped windows
    estimates: list[WindowEstimate] = field(default_factory=list)

    def refine(self, refine_one: Callable[..., Refined]) -> None:
        for index, window in enumerate(self.windows):
            self.estimates[index], self.state = refine_one(window, self.estimates[index], self.state)


class Estimator:
    """A loaded model that serves any number of streams. It holds no stream's state and is safe to share.

    Args:
        bundle: the model. Its weights are copied; later changes have no effect.
        runner: runs the network; by default the fastest one, which needs torch for baselines alone.
            `PlainRunner(bundle.network)` runs the network itself.
        bounds: absolute bounds of sigma for `uncertain`; they take precedence over those of the bundle.
        refine: whether to refine estimates by the events, see `refine.rotation` and `refine.ground`. It needs the
            CameraInfo of a stream and a bundle with an uncertainty that does not refuse it.
    """

    def __init__(
        self, bundle: Bundle, runner: Runner | None = None, bounds: Bounds = UNSET, *, refine: bool = False
    ) -> None:
        self.bundle = bundle
        self._refines = refine and bundle.uncertainty is not None and bundle.metadata.refine == "auto"
        self._bounds = bounds
        self.config = bundle.config
        self._runner: Runner = runner or runner_of(bundle)
        self.form = form_of(self._runner)  # of the engine, and why this one serves
        self._offset, self._scale = bundle.scaling

    def initial_state(self, sensor: Sensor, camera: CameraInfo | None = None) -> StreamState:
        """The state of a new stream, its network state zero.

        Args:
            sensor: the pixel array of its events.
            camera: its lens, where known.

        Raises:
            InvalidField: the camera info belongs to another sensor. NoTable: no memory for its look-up table.
        """
        lut = TABLES.of(self.config.canonical, sensor, camera)
        per_pixel = self.config.low_activity_per_pixel * np.count_nonzero(lut >= 0)
        least = max(float(self.config.low_activity_events), float(per_pixel))
        network = self._runner.initial_state()
        view = View.of(camera) if self._refines and camera is not None else None
        return StreamState(sensor, camera, lut, WindowsState(), network, 0, low_activity_below=least, view=view)

    def estimates(self, recording: Recording, camera: CameraInfo | None = None) -> Iterator[WindowEstimate]:
        """Estimates of all complete windows of a recording by its events alone, as the service answers its packets.

        Args:
            recording: source of events, see `open_source`.
            camera: its lens; by default the recording's own.

        Raises:
            InvalidField: the camera info belongs to another sensor.
        """
        state = self.initial_state(recording.sensor, camera or recording.camera(_STREAM))
        for piece in slices(recording.chunks()):
            result = self.push(piece.events, state, piece.t0_us)
            state = result.state
            yield from result.estimates

    def push(self, events: Events | WireEvents, state: StreamState, horizon_us: int) -> PushResult:
        """Add a packet's events to a stream and estimate every window that they complete.

        Some models give the linear part per metre of camera height. It is converted to m/s by the height of the
        stream's camera. Where that is not known, a height of 1 m is assumed.

        Args:
            events: ordered by time, on the stream's sensor.
            state: state of the stream; do not use it again after this call.
            horizon_us: sensor time reached even without events, such as the packet's t0_us.
        """
        return self.push_many([Push(events, state, horizon_us)])[0]

    def push_many(self, pushes: Sequence[Push]) -> list[PushResult]:
        """Add a packet to each of several streams, and estimate all windows that they complete, in common batches.

        The results are those of `push` for each, in less time where several streams complete a window, and equal bit
        for bit where the network runs on arrays.

        Args:
            pushes: at most one packet of each stream.
        """
        streams = [_begin(push, self.to_windows(*push)) for push in pushes]
        self._answer(streams)
        for stream in streams:
            stream.refine(self.refine)
        return [PushResult(stream.estimates, stream.state, *stream.lost) for stream in streams]

    def to_windows(self, events: Events | WireEvents, state: StreamState, horizon_us: int) -> Pushed:
        """The first half of push: the windows that some events complete, not yet processed by the network."""
        about = state.windows, state.lut, self.config.window, self.config.canonical
        return windows.push(events, horizon_us, *about, sampled=state.view is not None)

    def follow(self, complete: Iterable[Window], state: StreamState) -> tuple[list[WindowEstimate], StreamState]:
        """The second half of push: estimate windows that this model, or one with the same windows, has made.

        These are the network's estimates; `refine` is the last step of a push. Where a window does not begin at the end
        of the one before, the network state is reset, unless it is bridged.
        """
        return self.follow_many([(complete, state)])[0]

    def follow_many(
        self, streams: Iterable[tuple[Iterable[Window], StreamState]]
    ) -> list[tuple[list[WindowEstimate], StreamState]]:
        """As `follow`, for the complete windows of several streams with their states, in common batches."""
        found = [_Progress(state, tuple(complete)) for complete, state in streams]
        self._answer(found)
        return [(stream.estimates, stream.state) for stream in found]

    def refine(self, window: Window, estimate: WindowEstimate, state: StreamState) -> Refined:
        """The last step of push: an estimate, refined by the sample of its window and by those before.

        Args:
            window: the window; without a sample the estimate stays as it is.
            estimate: the network's.
            state: of the stream.
        """
        answer, after = refined.refine(window, estimate, state, self.config.window.duration_us)
        if answer is estimate:
            return answer, after
        return answer._replace(uncertain=self.is_uncertain(answer.twists, answer.covariance)), after

    def is_uncertain(self, twists: NDArray[np.float64], covariance: NDArray[np.float64] | None) -> bool:
        """Whether sigma exceeds the bounds, see `Uncertainty.is_uncertain`; False for a model without uncertainty."""
        unsure = self.bundle.uncertainty
        return unsure is not None and covariance is not None and unsure.is_uncertain(twists, covariance, self._bounds)

    def has_same_windows(self, other: "Estimator") -> bool:
        """Whether both models use the same windows and canonical camera, so that one can use the other's windows."""
        return (self.config.window, self.config.canonical) == (other.config.window, other.config.canonical)

    def _answer(self, streams: list[_Progress]) -> None:
        """Run all windows of some streams: the first window of each in one batch, then the second, and so on."""
        for turn in range(max((len(stream.windows) for stream in streams), default=0)):
            due = [stream for stream in streams if turn < len(stream.windows)]
            for stream in due:
                self._reset_after_gap(stream, stream.windows[turn])
            turns = [_turn(stream, stream.windows[turn]) for stream in due]
            found = answered(turns, self._runner, self.config, self._offset, self._scale)
            for stream, one in zip(due, found, strict=True):
                self._take(stream, stream.windows[turn], one)

    def _reset_after_gap(self, stream: _Progress, window: Window) -> None:
        """Reset the network state where a window does not follow the one before it."""
        if stream.state.end_us not in (None, window.start_us) and not window.bridged:
            fresh = self._runner.initial_state()
            stream.state = stream.state._replace(network=fresh, age=0, recent=(), longer=Longer())

    def _take(self, stream: _Progress, window: Window, found: Answered) -> None:
        state = stream.state
        stream.estimates.append(self._estimate(window, found.answer, state))
        end_us = window.start_us + self.config.window.duration_us
        recent = remembered(window.counts, state.recent, self.config)
        network, age, longer = found.network, state.age + 1, found.longer
        stream.state = state._replace(network=network, age=age, end_us=end_us, recent=recent, longer=longer)

    def warm_up(self) -> None:
        """Compile all code and run all parts, so that the first packet does not wait for it.

        Raises:
            BadModel: the model computes numbers that are not finite.
        """
        sensor = Sensor(self.config.canonical.width, self.config.canonical.height)
        if not _is_finite(self, self.initial_state(sensor, warm_camera(sensor) if self._refines else None)):
            raise BadModel(self.bundle.name, "it computes numbers that are not finite")

    def _covariance(self, answer: Answer, metres: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Covariance (6, 6) of the twists of an answer, in the units of the estimate."""
        unsure = self.bundle.uncertainty
        if unsure is None or (log_sigma := self._runner.log_sigma(answer.network)) is None:
            return None
        return unsure.covariance(log_sigma, self._scale * metres / answer.scale)

    def _estimate(self, window: Window, answer: Answer, before: StreamState) -> WindowEstimate:
        metres, age = _to_metres(before.camera, self.bundle.linear_unit), before.age
        twists, covariance = answer.twists * metres, self._covariance(answer, metres)
        return WindowEstimate(
            start_us=window.start_us,
            end_us=window.start_us + self.config.window.duration_us,
            twists=twists,
            events=window.events,
            first=age == 0,
            settled=age >= self.config.settle_windows,
            low_activity=window.events - window.outside < before.low_activity_below,
            saturated=bool(window.counts.max() == 255),
            covariance=covariance,
            uncertain=self.is_uncertain(twists, covariance),
        )


def _begin(push: Push, pushed: Pushed) -> _Progress:
    outside = sum(window.outside for window in pushed.windows)
    lost = (pushed.late_events, outside, pushed.skipped_windows)
    return _Progress(push.state._replace(windows=pushed.state), pushed.windows, lost)


def _turn(stream: _Progress, window: Window) -> Turn:
    return Turn(window.counts, stream.state.recent, stream.state.network, stream.state.longer)


def _is_finite(estimator: Estimator, state: StreamState) -> bool:
    """Whether the estimates of some events are finite; this compiles all code."""
    if state.view is not None:
        compile_refinement(state.view, warm_camera(state.sensor))
    for given in warm_events(state.sensor, estimator.config.window.duration_us):
        answer = estimator.push(given, state._replace(windows=WindowsState()), 0)
        state = answer.state
        finite = all(np.isfinite(estimate.twists).all() for estimate in answer.estimates)
        if not (finite and state.network.finite()):  # a membrane of nan never fires, so the answer does not show it
            return False
    return True


def _to_metres(camera: CameraInfo | None, unit: LinearUnit) -> NDArray[np.float64]:
    """Factor (6) of a twist that converts its linear part to m/s."""
    height_m = camera.height_m if camera is not None and unit == PER_HEIGHT else None
    return np.array([height_m] * 3 + [1.0] * 3) if height_m else _METRES
