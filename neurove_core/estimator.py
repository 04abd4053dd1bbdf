"""Estimator: a loaded model that turns the events of any number of camera streams into velocity estimates.

`push` takes a packet's events and answers each window that they complete; `push_many` does so for several streams in
one batch; `estimates` runs over a whole recording. Windows and encoding are the same as in training.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.tables import TABLES
from neurove_core.ingest import windows
from neurove_core.ingest.channels import Recent, remembered
from neurove_core.ingest.windows import Pushed, Window, WindowsState
from neurove_core.io.packets import slices
from neurove_core.io.recording import Recording
from neurove_core.models.bounds import UNSET, Bounds
from neurove_core.models.bundle import PER_HEIGHT, Bundle, LinearUnit
from neurove_core.networks.arrays import Runner, State
from neurove_core.refine import errors, ground, standing
from neurove_core.refine import stages as refining
from neurove_core.refine.ground import GroundState
from neurove_core.refine.rotation import Given, Rate
from neurove_core.refine.rotation import Refined as RotationFound
from neurove_core.refine.view import View
from neurove_core.running import form_of, runner_of
from neurove_core.timescales import Answer, Answered, Longer, Turn, answered
from neurove_core.warming import compile_refinement, warm_camera, warm_events
from neurove_protocol import CameraInfo, Events, Sensor
from neurove_protocol.errors import BadModel
from neurove_protocol.events import WireEvents
from neurove_protocol.velocity import Source

_STREAM = "cam0"
_METRES = np.ones(6)


class StreamState(NamedTuple):
    """All that one camera stream carries from packet to packet."""

    sensor: Sensor
    camera: CameraInfo | None
    lut: NDArray[np.int32]  # sensor pixel -> canonical cell
    windows: WindowsState
    network: State
    age: int  # windows since the network state began
    end_us: int | None = None  # end of the newest window that the network has processed
    low_activity_below: float = 0.0  # a window with fewer visible events is flagged low_activity
    view: View | None = None  # for the refinement; None where estimates are not refined
    stages: refining.State = refining.State()  # of the refinement
    ground: GroundState = GroundState()  # of the refinement of the linear part
    recent: Recent = ()  # counts of earlier windows, for models with a history
    longer: Longer = Longer()  # for models with longer windows

    def without_refinement(self) -> "StreamState":
        """The state in which the refinement begins again."""
        return self._replace(stages=refining.State(), ground=GroundState())


class WindowEstimate(NamedTuple):
    """The estimate of one window."""

    start_us: int
    end_us: int
    twists: NDArray[np.float64]  # (n, 6): vx vy vz [m/s], wx wy wz [rad/s], optical frame, one row per bin; see push
    events: int
    first: bool  # the network state began in this window
    settled: bool
    low_activity: bool
    saturated: bool
    covariance: NDArray[np.float64] | None = None  # (6, 6) of each of these twists, from the bundle's calibration
    uncertain: bool = False  # the linear or the angular sigma exceeds both its bounds, see Uncertainty.is_uncertain
    source: Source = "network"  # of the angular part
    gyro_disagrees: bool = False  # the events and the gyroscope of the camera disagree
    vehicle: bool = False  # the camera is on a vehicle by the events of many windows


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


Refined = tuple[WindowEstimate, StreamState]
"""A refined estimate, and the state of the stream after it."""


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
        estimate, state = _held(window, estimate, state)
        if window.sample is None or state.view is None or estimate.covariance is None:
            return estimate, state
        known_m = state.camera.height_m if state.camera else None
        about = window.start_us, self.config.window.duration_us, window.sample, state.view, estimate.twists.mean(axis=0)
        given = Given(*about, estimate.covariance, estimate.low_activity, None, known_m or 1.0, known_m is not None)
        found = refining.refine(given, state.stages)
        state = state._replace(stages=found.state, ground=state.ground if found.level else GroundState())
        estimate = _turned(estimate, found.turn, found.velocity)
        answer, state = _over_ground(window, estimate, state, found)
        if answer is estimate:
            answer = _with_errors(estimate, found, given.height_m)
        uncertain, vehicle = self.is_uncertain(answer.twists, answer.covariance), state.stages.on_vehicle
        return answer._replace(uncertain=uncertain, vehicle=vehicle), state

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


def _with_rate(
    twists: NDArray[np.float64], covariance: NDArray[np.float64], rate: Rate, change_rad_s: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Twists (n, 6) and covariance (6, 6) with another angular part, which does not correlate with the linear part.

    The angular part changes by `change_rad_s` (3,) within the window.
    """
    twists, joint = twists.copy(), np.zeros((6, 6))
    twists[:, 3:] = rate.w_rad_s + np.outer((np.arange(len(twists)) + 0.5) / len(twists) - 0.5, change_rad_s)
    joint[:3, :3], joint[3:, 3:] = covariance[:3, :3], (rate.covariance + rate.covariance.T) / 2
    return twists, joint


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


def _held(window: Window, estimate: WindowEstimate, state: StreamState) -> Refined:
    """The network's estimate by what is known of a stop too, see `refine.standing`."""
    if window.sample is None or state.view is None or state.camera is None or estimate.covariance is None:
        return estimate, state
    if state.camera.height_m is None:
        return estimate, state
    share = (window.events - window.outside) / max(state.low_activity_below, 1.0)
    about = estimate.end_us, share, state.camera.height_m, state.ground.standing
    found = standing.hold(estimate.twists, estimate.covariance, *about)
    state = state._replace(ground=state.ground._replace(standing=found.standing))
    if found.standing.sigma_m_s is None:
        return estimate, state
    return estimate._replace(twists=found.twists, covariance=found.covariance, source="refined"), state


def _turned(estimate: WindowEstimate, found: RotationFound, velocity: refining.Velocity | None) -> WindowEstimate:
    """The estimate with the angular part of the refinement, and the linear one if it has one, where it is accepted."""
    if estimate.covariance is None or found.outcome != "accepted":
        return estimate
    twists, covariance = _with_rate(estimate.twists, estimate.covariance, found.rate, found.change_rad_s)
    if velocity is not None:
        twists[:, :3], covariance[:3, :3] = velocity
    return estimate._replace(twists=twists, covariance=covariance, source="refined")


def _with_errors(estimate: WindowEstimate, found: refining.Stages, height_m: float) -> WindowEstimate:
    """An estimate without the ground, with the terms of `refine.errors`, and less of a speed that is not seen."""
    if estimate.covariance is None:
        return estimate
    twists, covariance, turn = estimate.twists, estimate.covariance.copy(), found.turn
    if turn.errors is not None:
        covariance[3:, 3:] = (turn.errors + turn.errors.T) / 2
    if found.velocity is None:
        twists = standing.towards_zero(twists, estimate.covariance)
        rate_rad_s = float(np.linalg.norm(twists.mean(axis=0)[3:]))
        covariance = errors.of_unknown_depth(covariance, turn.shift, rate_rad_s, height_m)
    return estimate._replace(twists=twists, covariance=covariance)


def _over_ground(
    window: Window,
    estimate: WindowEstimate,
    state: StreamState,
    found: refining.Stages,
) -> Refined:
    """The estimate with the motion over level ground, where it is accepted; see `refine.ground`.

    Args:
        window: with the sample of its events.
        estimate: so far; it stays the same object if the answer is not accepted.
        state: of the stream.
        found: the stages before; a camera that is on no vehicle has no ground.
    """
    if not found.level:
        return estimate, state
    if window.sample is None or state.view is None or state.camera is None or estimate.covariance is None:
        return estimate, state
    height_m = state.camera.height_m
    if height_m is None:
        return estimate, state  # nothing says that the camera looks at level ground
    events = ground.events_of(state.view, window.sample, window.start_us)
    sigma = found.turn.sigma_rad_s
    sigma = np.sqrt(np.diagonal(estimate.covariance)[3:]) if sigma is None else sigma
    known = estimate.twists.mean(axis=0), sigma, state.ground
    turned = estimate.source == "refined" and not estimate.low_activity
    measured = estimate.covariance[3:, 3:] if turned else None
    answer = ground.refine(events, estimate.start_us, estimate.end_us, state.camera, *known, measured)
    state = state._replace(ground=answer.state, stages=state.stages.after_ground(answer.outcome))
    if answer.outcome not in ("accepted", "turning") or answer.motion is None:
        return estimate, state
    twist, after = answer.motion.twist, answer.state
    seen = after.tilt, after.pitch_sigma, height_m, state.stages.odds
    covariance = errors.of_ground(twist, answer.motion.covariance, *seen)
    twists = np.tile(twist, (len(estimate.twists), 1))
    if answer.outcome == "turning":
        rate = Rate(twist[3:], covariance[3:, 3:])
        twists, covariance = _with_rate(estimate.twists, estimate.covariance, rate, np.zeros(3))
    if state.stages.is_free:
        twists, covariance = _without_rate(twists, covariance, _with_errors(estimate, found, height_m))
    return estimate._replace(twists=twists, covariance=covariance, source="refined"), state


def _without_rate(
    twists: NDArray[np.float64], covariance: NDArray[np.float64], before: WindowEstimate
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The linear part of a motion over the ground, with the angular part of the estimate before it."""
    joint = covariance.copy()
    joint[:3, 3:], joint[3:, :3] = 0.0, 0.0
    if before.covariance is not None:
        joint[3:, 3:] = before.covariance[3:, 3:]
    return np.hstack([twists[:, :3], before.twists[:, 3:]]), joint


def _to_metres(camera: CameraInfo | None, unit: LinearUnit) -> NDArray[np.float64]:
    """Factor (6) of a twist that converts its linear part to m/s."""
    height_m = camera.height_m if camera is not None and unit == PER_HEIGHT else None
    return np.array([height_m] * 3 + [1.0] * 3) if height_m else _METRES
