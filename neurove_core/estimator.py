"""Estimator.push: the one entry for inference; windows and encoding as in training. push_many: many streams at once."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.engine.encoding import to_codes, to_counts
from neurove_core.engine.engine import Engine
from neurove_core.geometry.camera import lookup_table
from neurove_core.ingest import windows
from neurove_core.ingest.windows import Pushed, Window, WindowsState
from neurove_core.ingest.wire import read_packet
from neurove_core.models.bundle import PER_HEIGHT, Bundle
from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.kinds import State
from neurove_core.networks.neurove import NetworkState, NeuroVE
from neurove_protocol import CameraInfo, Events, Sensor
from neurove_protocol.errors import BadModel
from neurove_protocol.events import EventPacket, PacketLimits, WireEvents, encode_packet


class StreamState(NamedTuple):
    """All that one camera stream carries from packet to packet."""

    sensor: Sensor
    camera: CameraInfo | None
    lut: NDArray[np.int32]  # sensor pixel -> canonical cell
    windows: WindowsState
    network: State
    age: int  # windows since the network state began
    end_us: int | None = None  # end of the newest window that the network has seen
    low_activity_below: float = 0.0  # events that the model sees in a window


class WindowEstimate(NamedTuple):
    """The answer to one window."""

    start_us: int
    end_us: int
    twists: NDArray[np.float64]  # (n, 6): vx vy vz [m/s], wx wy wz [rad/s], optical frame, one row per bin; see push
    events: int
    first: bool  # the state began in this window
    settled: bool
    low_activity: bool
    saturated: bool
    covariance: NDArray[np.float64] | None = None  # (6, 6) of each of these twists, by the bundle's calibration
    uncertain: bool = False  # the linear part's sigma is a larger share of its speed than the bundle's bound


class PushResult(NamedTuple):
    """What came of some events: an estimate for each window that they completed, and what was left out."""

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
class _Course:
    """One stream in the course of a push."""

    state: StreamState  # moves on with each window
    windows: Sequence[Window]  # to answer
    lost: tuple[int, int, int] = (0, 0, 0)  # late events, events outside, skipped windows
    estimates: list[WindowEstimate] = field(default_factory=list)


class Estimator:
    """A loaded model, ready to answer any number of streams; holds no stream's state and is safe to share.

    Args:
        bundle: the model; its network is put into evaluation mode.
    """

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self.config = bundle.config
        self.network = bundle.network.eval().requires_grad_(requires_grad=False)
        # a baseline runs as it was trained: NeuroVE alone has a fast path
        fast = Engine(self.network) if isinstance(self.network, NeuroVE) else self.network
        self._engine: Callable[[Any, Any], tuple[Tensor, Any]] = fast
        self._encode: Callable[[Tensor, str], Any] = to_spikes
        if self.config.network.precision == "int8":
            self._encode = to_codes
        elif isinstance(fast, Engine) and fast.reads_counts:
            self._encode = to_counts
        self._offset, self._scale = bundle.offset.double().numpy(), bundle.scale.double().numpy()

    def initial_state(self, sensor: Sensor, camera: CameraInfo | None = None) -> StreamState:
        """A stream at rest.

        Args:
            sensor: of its events.
            camera: its lens, where known.

        Raises:
            InvalidField: the camera info is of another sensor.
        """
        lut = lookup_table(self.config.canonical, sensor, camera)
        per_pixel = self.config.low_activity_per_pixel * np.count_nonzero(lut >= 0)
        least = max(float(self.config.low_activity_events), float(per_pixel))
        network = self.network.initial_state()
        return StreamState(sensor, camera, lut, WindowsState(), network, 0, low_activity_below=least)

    def push(self, events: Events | WireEvents, state: StreamState, horizon_us: int) -> PushResult:
        """Take a packet's events and answer every window that they complete.

        A model whose linear part is per metre of camera height is told in m/s by the height of the stream's camera;
        where that is not known, as if it were 1 m.

        Args:
            events: ordered, on the stream's sensor.
            state: of the stream; used up by this call.
            horizon_us: sensor time reached even without events, such as the packet's t0_us.
        """
        return self.push_many([Push(events, state, horizon_us)])[0]

    def push_many(self, pushes: Sequence[Push]) -> list[PushResult]:
        """Take a packet of each of several streams, and answer all windows that they complete, in common batches.

        As `push` for each, in less time where several streams complete a window; see Engine.together for when the
        answers are the same bit for bit.

        Args:
            pushes: each of another stream: two packets of one stream do not fit into one call.
        """
        courses = [self._begin(push) for push in pushes]
        self._answer(courses)
        return [PushResult(course.estimates, course.state, *course.lost) for course in courses]

    def cut(self, events: Events | WireEvents, state: StreamState, horizon_us: int) -> Pushed:
        """The first half of push: the windows that some events complete; the network has not seen them yet."""
        return windows.push(events, horizon_us, state.windows, state.lut, self.config.window, self.config.canonical)

    def follow(self, complete: Iterable[Window], state: StreamState) -> tuple[list[WindowEstimate], StreamState]:
        """The second half of push: answer windows, from this model's own cutting or from another's that cuts alike.

        A window that does not begin where the one before ended begins the network's state anew.
        """
        course = _Course(state, tuple(complete))
        self._answer([course])
        return course.estimates, course.state

    def cuts_like(self, other: "Estimator") -> bool:
        """Whether both models cut and see alike, so that the windows of one are those of the other."""
        return (self.config.window, self.config.canonical) == (other.config.window, other.config.canonical)

    def _begin(self, push: Push) -> _Course:
        pushed = self.cut(*push)
        outside = sum(window.outside for window in pushed.windows)
        lost = (pushed.late_events, outside, pushed.skipped_windows)
        return _Course(push.state._replace(windows=pushed.state), pushed.windows, lost)

    def _answer(self, courses: list[_Course]) -> None:
        """All windows of some streams, the first of each together, then the second, and so on."""
        for turn in range(max((len(course.windows) for course in courses), default=0)):
            due = [course for course in courses if turn < len(course.windows)]
            for course in due:
                self._mind_the_hole(course, course.windows[turn].start_us)
            counts = [course.windows[turn].counts for course in due]
            steps = self._steps(counts, [course.state.network for course in due])
            for course, (twists, network) in zip(due, steps, strict=True):
                self._take(course, course.windows[turn], twists, network)

    def _mind_the_hole(self, course: _Course, start_us: int) -> None:
        """Begin anew where the window at `start_us` does not follow the one before it."""
        if course.state.end_us not in (None, start_us):
            course.state = course.state._replace(network=self.network.initial_state(), age=0)

    def _take(self, course: _Course, window: Window, twists: NDArray[np.float64], network: State) -> None:
        state = course.state
        course.estimates.append(self._estimate(window, twists, network, state))
        end_us = window.start_us + self.config.window.duration_us
        course.state = state._replace(network=network, age=state.age + 1, end_us=end_us)

    def warm_up(self) -> None:
        """Compile and touch all that the first packet would otherwise wait for.

        Raises:
            BadModel: the model computes numbers that are not finite.
        """
        sensor = Sensor(self.config.canonical.width, self.config.canonical.height)
        duration = self.config.window.duration_us
        t = np.arange(0, 4 * duration, max(1, duration // 500))
        rng = np.random.default_rng(0)
        x, y, p = (rng.integers(0, high, t.size) for high in (sensor.width, sensor.height, 2))
        events = Events.from_columns(t, x, y, p)
        packet = EventPacket("warm", 0, sensor, 0, events)
        from_wire = read_packet(
            encode_packet(packet), PacketLimits(max_side_px=max(sensor.width, sensor.height))
        ).events
        state = self.initial_state(sensor)
        for given in (events, from_wire):
            answer = self.push(given, state._replace(windows=WindowsState()), 0)
            state = answer.state
            finite = all(np.isfinite(estimate.twists).all() for estimate in answer.estimates)
            if not (finite and state.network.finite()):  # a membrane of nan never fires: the answer would not show it
                raise BadModel(self.bundle.name, "it computes numbers that are not finite")

    def _metres(self, camera: CameraInfo | None) -> NDArray[np.float64]:
        """What a twist (6) is multiplied by, to have its linear part in m/s."""
        height_m = camera.height_m if camera is not None and self.bundle.linear_unit == PER_HEIGHT else None
        return np.array([height_m or 1.0] * 3 + [1.0] * 3)

    @torch.inference_mode()
    def _steps(self, counts: list[NDArray[np.uint8]], states: list[State]) -> list[tuple[NDArray[np.float64], State]]:
        """One window of each stream: its twists (n, 6) and its next state."""
        together = torch.from_numpy(counts[0] if len(counts) == 1 else np.stack(counts))
        spikes = self._encode(together.view(1, len(counts), *counts[0].shape), self.config.network.encoding)
        answers = self._together(spikes, states)
        return [(twists[0, 0].double().numpy() * self._scale + self._offset, state) for twists, state in answers]

    def _together(self, spikes: Any, states: list[Any]) -> list[tuple[Tensor, State]]:
        if len(states) > 1 and isinstance(self._engine, Engine):
            return list(self._engine.together(spikes, states))
        if len(states) == 1:
            return [self._engine(spikes, states[0])]
        return [self._engine(spikes[:, b : b + 1], state) for b, state in enumerate(states)]

    def _covariance(self, state: State, metres: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Of the twists of the window that led to this state; as them scaled by the camera's height."""
        if not isinstance(self.network, NeuroVE) or not isinstance(state, NetworkState):
            return None
        log_sigma = self.network.log_sigma(state)
        if self.bundle.uncertainty is None or log_sigma is None:
            return None
        return self.bundle.uncertainty.covariance(log_sigma[0].double().numpy(), self._scale * metres)

    def _estimate(
        self, window: Window, twists: NDArray[np.float64], network: State, before: StreamState
    ) -> WindowEstimate:
        metres, age = self._metres(before.camera), before.age
        twists, covariance = twists * metres, self._covariance(network, metres)
        unsure = self.bundle.uncertainty
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
            uncertain=covariance is not None and unsure is not None and unsure.is_uncertain(twists, covariance),
        )
