"""Run a model on recordings as the service does, packet by packet, one after the other or many in common batches."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.aided import aided
from neurove_core.estimator import Estimator
from neurove_core.inertial.state import InertialState, push
from neurove_core.ingest.windows import Window
from neurove_core.io.imu_feed import ImuFeed
from neurove_core.io.packets import Slice, slices
from neurove_core.io.recording import Recording
from neurove_core.networks.arrays import ArrayState, State
from neurove_core.stream_state import StreamState, WindowEstimate
from neurove_protocol.camera import CameraInfo
from neurove_protocol.velocity import Source

AT_ONCE: Final = 64
"""Recordings whose windows go through the network in one batch."""

_STREAM = "evaluate"


@dataclass(frozen=True)
class Estimates:
    """The estimates of a model for one recording; W windows of n bins."""

    name: str
    start_us: NDArray[np.int64]  # (W,) of the windows
    bin_us: int
    twists: NDArray[np.float64]  # (W, n, 6) [m/s, rad/s]
    events: NDArray[np.int64]  # (W,)
    low_activity: NDArray[np.bool_]  # (W,) flagged as in the service
    latency_ms: NDArray[np.float64]  # (W,) duration of the push that completed the window
    firing_rate: dict[
        str, float
    ]  # share of neurons that fire per step, by layer and overall; empty for a network without spikes
    scaled: bool  # the camera height is known; otherwise the linear part assumes 1 m
    sigma: NDArray[np.float64] | None = (
        None  # (W, 6) of the twists of each window; None if the model has no uncertainty
    )
    uncertain: NDArray[np.bool_] | None = None  # (W,) windows flagged as uncertain
    sources: tuple[Source, ...] = ()  # (W,) origin of the angular part of each window


def estimate_recording(
    estimator: Estimator,
    recording: Recording,
    camera: CameraInfo | None = None,
    on_events: Callable[[int], None] = lambda _: None,
    *,
    inertial: bool = False,
) -> Estimates:
    """Run a model on a recording, packet by packet as a driver sends it.

    Args:
        estimator: the model.
        recording: its input.
        camera: lens of the recording; by default the one that the recording gives.
        on_events: called after each packet with the number of events so far.
        inertial: use the recording's inertial samples too, as the service does.

    Raises:
        InvalidField: the lens belongs to another sensor.
    """
    run = _Run(estimator, recording, camera, on_events, inertial=inertial)
    while run.advance():
        _answer(estimator, [run])
    return run.estimates()


def estimate_recordings(
    estimator: Estimator,
    recordings: Sequence[Recording],
    on_events: Callable[[int], None] = lambda _: None,
    *,
    inertial: bool = False,
    at_once: int = AT_ONCE,
) -> list[Estimates]:
    """Run a model on several recordings together: the next window of each goes through the network in one batch.

    The results are those of `estimate_recording` for each, as far as the runner of the estimator gives equal answers
    to a batch; that of the engine does. `latency_ms` has the share of a window in the time of its batch.

    Args:
        estimator: the model.
        recordings: its inputs.
        on_events: called after each packet with the number of events of all recordings so far.
        inertial: see `estimate_recording`.
        at_once: number of recordings in a batch; another one takes the place of one that ends.

    Raises:
        InvalidField: a lens belongs to another sensor.
    """
    counted = [0] * len(recordings)

    def count(number: int, events: int) -> None:
        counted[number] = events
        on_events(sum(counted))

    def run_of(number: int) -> _Run:
        return _Run(estimator, recordings[number], None, lambda n: count(number, n), inertial=inertial)

    found: dict[int, Estimates] = {}
    waiting = iter(range(len(recordings)))
    running = {number: run_of(number) for number in islice(waiting, at_once)}
    while running:
        for number in list(running):
            run: _Run | None = running[number]
            while run is not None and not run.advance():
                found[number] = running.pop(number).estimates()
                number = next(waiting, -1)
                run = running.setdefault(number, run_of(number)) if number >= 0 else None
        if running:
            _answer(estimator, list(running.values()))
    return [found[number] for number in range(len(recordings))]


def _answer(estimator: Estimator, due: "Sequence[_Run]") -> None:
    """Answer the complete windows of some recordings, in common batches."""
    began = time.perf_counter()
    answers = estimator.follow_many([(run.windows, run.state) for run in due])
    share_s = (time.perf_counter() - began) / len(due)
    for run, (estimates, state) in zip(due, answers, strict=True):
        run.take(estimates, state, share_s)


class _Run:
    """One recording on its way through a model."""

    def __init__(
        self,
        estimator: Estimator,
        recording: Recording,
        camera: CameraInfo | None,
        on_events: Callable[[int], None],
        *,
        inertial: bool,
    ) -> None:
        self._estimator, self._recording, self._on_events = estimator, recording, on_events
        self._camera = camera or recording.camera(_STREAM)
        self.state = estimator.initial_state(recording.sensor, self._camera)
        self.windows: list[Window] = []  # complete, to be answered
        self._pieces: Iterator[Slice] = slices(recording.chunks())
        self._feed = ImuFeed(recording) if inertial and "imu" in recording.streams else None
        self._unit = InertialState()
        self._found: list[WindowEstimate] = []
        self._latencies_ms: list[float] = []
        self._firing_rate = _FiringRate()
        self._events = 0
        self._took_s = 0.0  # of this packet

    def advance(self) -> bool:
        """Read packets until one completes windows; False at the end of the recording."""
        for piece in self._pieces:
            if self._feed is not None:
                self._unit, _ = push(self._unit, self._feed.until(piece.end_us))
            began = time.perf_counter()
            pushed = self._estimator.to_windows(piece.events, self.state, piece.t0_us)
            self.state, self.windows = self.state._replace(windows=pushed.state), pushed.windows
            self._took_s = time.perf_counter() - began
            self._events += piece.events.n
            self._on_events(self._events)
            if pushed.windows:
                return True
        return False

    def take(self, estimates: list[WindowEstimate], state: StreamState, network_s: float) -> None:
        """Take the network's answers to the windows, refine them and keep them.

        Args:
            estimates: one for each window.
            state: of the stream after them.
            network_s: what they took.
        """
        began = time.perf_counter()
        for window, answer in zip(self.windows, estimates, strict=True):
            estimate, state = self._estimator.refine(window, answer, state)
            if self._feed is not None:
                estimate, self._unit = aided(self._estimator, estimate, self._unit, self._camera)
            self._found.append(estimate)
        self.state = state
        took_ms = (self._took_s + network_s + time.perf_counter() - began) * 1e3
        self._latencies_ms += [took_ms / len(estimates)] * len(estimates)
        self._firing_rate.add(state.network)

    def estimates(self) -> Estimates:
        """All answers."""
        found, config = self._found, self._estimator.config.window
        sigma = _sigmas(found)
        return Estimates(
            name=self._recording.name,
            start_us=np.array([one.start_us for one in found], np.int64),
            bin_us=config.bin_us,
            twists=np.stack([one.twists for one in found]) if found else np.zeros((0, config.bins, 6)),
            events=np.array([one.events for one in found], np.int64),
            low_activity=np.array([one.low_activity for one in found], np.bool_),
            latency_ms=np.array(self._latencies_ms),
            firing_rate=self._firing_rate.rates(),
            scaled=self._camera is not None and self._camera.height_m is not None,
            sigma=sigma,
            uncertain=None if sigma is None else np.array([one.uncertain for one in found], np.bool_),
            sources=tuple(one.source for one in found),
        )


def _sigmas(found: list[WindowEstimate]) -> NDArray[np.float64] | None:
    covariances = [one.covariance for one in found if one.covariance is not None]
    return np.sqrt(np.stack([np.diagonal(one) for one in covariances])) if covariances else None


class _FiringRate:
    """Counts spikes and neurons by layer, from the state of the network."""

    def __init__(self) -> None:
        self._spikes, self._neurons = dict[str, int](), dict[str, int]()

    def add(self, state: State) -> None:
        for layer, spikes in _fired(state).items():
            self._spikes[layer] = self._spikes.get(layer, 0) + int(spikes.sum())
            self._neurons[layer] = self._neurons.get(layer, 0) + spikes.size

    def rates(self) -> dict[str, float]:
        if not self._spikes:
            return {}
        rates = {layer: spikes / self._neurons[layer] for layer, spikes in self._spikes.items()}
        return rates | {"all": sum(self._spikes.values()) / sum(self._neurons.values())}


def _fired(state: State) -> dict[str, NDArray[np.bool_]]:
    """Which neurons fired in the last step, by layer."""
    if isinstance(state, ArrayState):
        return state.fired()
    from neurove_core.networks import kinds

    return {layer: spikes.cpu().numpy() for layer, spikes in kinds.fired(state).items()}  # type: ignore[arg-type]  # of torch
