"""Inertial state of one stream: samples in, and for each window what gyroscope and events say together.

All is a pure function of the samples and the windows: a recording gives the same result as the live stream, except
where samples arrived too late for a window.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.inertial import agreement, bias, buffer, gyro, moving, rest
from neurove_core.inertial.agreement import Agreement, Track
from neurove_core.inertial.bias import Bias
from neurove_core.inertial.gyro import Rates
from neurove_core.inertial.moving import Seen, Tilt
from neurove_protocol.imu import Imu

REST_M_S: Final = 0.2
"""At rest, the events give at most this speed, for a camera 1 m above the ground [m/s]."""

REST_LINEAR_M_S: Final = 0.01
REST_ANGULAR_RAD_S: Final = 0.002
"""Standard deviation of each axis of a camera that does not move."""

Array = NDArray[np.float64]


class InertialState(NamedTuple):
    """All that a stream with an inertial unit carries from packet to packet."""

    samples: Imu = Imu.empty()  # the newest ones
    bias: Bias = Bias()
    tilt: Tilt = Tilt()
    track: Track = Track()
    agreement: Agreement = Agreement()
    doubts: int = 0  # judgements in a row that disagree
    resting: bool = False

    @property
    def disagrees(self) -> bool:
        """Whether gyroscope and events have disagreed for a while."""
        return self.doubts >= 2


class Learned(NamedTuple):
    """What an `InertialState` holds apart from the samples: another process that has the samples can go on with it."""

    bias: Bias
    tilt: Tilt
    track: Track
    agreement: Agreement
    doubts: int
    resting: bool

    @classmethod
    def of(cls, state: InertialState) -> "Learned":
        """That of a state."""
        return cls(*state[1:])

    def into(self, state: InertialState) -> InertialState:
        """The state that goes on with this and its own samples."""
        return state._replace(**self._asdict())

    def is_sound(self) -> bool:
        """Whether the arrays have the shapes that the stage expects, and all numbers are finite."""
        bias, track = self.bias, self.track
        windows, angles = track.start_us.size, track.grid_us.size
        shapes = [
            (bias.mean_rad_s, (3,)),
            (bias.variance, (3,)),
            (track.start_us, (windows,)),
            (track.end_us, (windows,)),
            (track.events_rad_s, (windows, 3)),
            (track.refined, (windows,)),
            (track.grid_us, (angles,)),
            (track.angle_rad, (angles, 3)),
            (self.tilt.velocities_m_s, (len(self.tilt.velocities_m_s), 3)),
            *(((self.tilt.covariance, (9, 9)),) if self.tilt.covariance is not None else ()),
            *((vector, (3,)) for vector in (self.tilt.force_m_s2, self.tilt.average_m_s2) if vector is not None),
        ]
        return all(array.shape == shape and bool(np.isfinite(array).all()) for array, shape in shapes)


class Window(NamedTuple):
    """The estimate of one window by the events."""

    start_us: int
    end_us: int
    twists: Array  # (n, 6) [m/s, rad/s]
    covariance: Array | None  # (6, 6) of each of them
    low_activity: bool
    refined: bool
    scale_m: float = 1.0  # height of the camera that the linear part assumes or knows
    scaled: bool = False  # it is known
    vehicle: bool = False  # the camera is on a vehicle by the events of many windows


class Aided(NamedTuple):
    """The estimate of one window by events and gyroscope."""

    twists: Array  # (n, 6)
    covariance: Array | None  # (6, 6)
    used: bool  # the angular part is that of the gyroscope
    resting: bool


def push(state: InertialState, more: Imu) -> tuple[InertialState, int]:
    """Add samples; return the state and the number of samples that were left out because they are late."""
    pushed = buffer.push(state.samples, more)
    if pushed.restarted:  # another clock: what was compared in time is void, the bias is not
        bias_now = state.bias._replace(at_us=None if state.bias.at_us is None else int(more.t[0]))
        return InertialState(pushed.samples, bias_now), pushed.late
    return state._replace(samples=pushed.samples), pushed.late


def aid(state: InertialState, window: Window) -> tuple[Aided, InertialState]:
    """Use the samples at hand for a window; without them its estimate stands.

    The angular part becomes the mean of the gyroscope over each bin without its bias. At rest the twist is zero. Rest
    teaches the bias at once, and refined windows teach it slowly. While gyroscope and events disagree, the gyroscope is
    not used, and a bias that only motion has taught is dropped.

    Args:
        state: with the samples up to the end of the window, as far as they have arrived.
        window: the next one.
    """
    bins = len(window.twists)
    edges_us = np.linspace(window.start_us, window.end_us, bins + 1).round().astype(np.int64)
    known = state.samples.span(0, int(state.samples.t.searchsorted(window.end_us)))
    found = gyro.rates(known, edges_us, state.bias.noise_rad_s)
    state = _compared(state._replace(resting=False), window, known)
    if found is None:
        return Aided(window.twists, window.covariance, used=False, resting=False), state
    still = rest.still(known, window.end_us)
    if still is not None and _seems_at_rest(window) and not state.disagrees:
        mean = found.gyro_rad_s.mean(0) if state.bias.rested else still.gyro_rad_s
        samples = found.samples if state.bias.rested else still.samples
        learned = bias.learned(state.bias, mean, samples, still.noise_rad_s, window.end_us)
        state = state._replace(bias=learned, tilt=Tilt(), resting=True)
        return _at_rest(window), state
    if state.disagrees:
        state = state._replace(tilt=Tilt(), bias=state.bias if state.bias.rested else Bias())
        return Aided(window.twists, window.covariance, used=False, resting=False), state
    state = _learned_in_motion(state, window, known, found)
    twists = window.twists.copy()
    smooth = gyro.smooth_rates(known, edges_us, found, rested=state.bias.rested)
    twists[:, 3:] = smooth.gyro_rad_s - state.bias.mean_rad_s
    covariance = window.covariance
    if covariance is not None:
        covariance = covariance.copy()
        covariance[3:] = covariance[:, 3:] = 0.0
        covariance[range(3, 6), range(3, 6)] = smooth.variance + state.bias.error_variance_at(window.end_us)
    return Aided(twists, covariance, used=True, resting=False), state


def _learned_in_motion(state: InertialState, window: Window, known: Imu, found: Rates) -> InertialState:
    """The state with the bias after a window in which the unit moved."""
    if window.covariance is None:
        return state
    first = int(known.t.searchsorted(window.start_us))
    seen = Seen(
        window.end_us,
        window.end_us - window.start_us,
        found.gyro_rad_s.mean(0),
        known.accel_m_s2[first:].mean(0) if first < known.n else None,
        window.twists[:, :3].mean(0) if window.scaled and not window.low_activity else None,
        window.twists[:, 3:].mean(0) if window.refined else None,
        np.diagonal(window.covariance)[3:],
        window.vehicle,
    )
    now, tilt = moving.learned(state.bias, state.tilt, seen)
    return state._replace(bias=now, tilt=tilt)


def _seems_at_rest(window: Window) -> bool:
    """Whether the events allow that the camera does not move: few of them, or no speed."""
    speed_m_s = float(np.linalg.norm(window.twists[:, :3].mean(0)))
    return window.low_activity or speed_m_s <= REST_M_S * window.scale_m


def _at_rest(window: Window) -> Aided:
    sigma = np.array([REST_LINEAR_M_S * window.scale_m] * 3 + [REST_ANGULAR_RAD_S] * 3)
    covariance = None if window.covariance is None else np.diag(sigma**2)
    return Aided(np.zeros_like(window.twists), covariance, used=True, resting=True)


def _compared(state: InertialState, window: Window, known: Imu) -> InertialState:
    """The state after a window was compared with the gyroscope."""
    track = state.track
    first_us = -(-window.start_us // agreement.GRID_US) * agreement.GRID_US
    if track.grid_us.size:
        first_us = int(track.grid_us[-1]) if known.n and track.grid_us[-1] >= known.t[0] else first_us
    if known.n and known.t[0] <= first_us <= known.t[-1]:
        grid_us = np.arange(first_us, int(known.t[-1]) + 1, agreement.GRID_US)
        near = known.span(max(0, int(known.t.searchsorted(first_us, "right")) - 1), known.n)
        track = agreement.add_angles(track, grid_us, gyro.turned(near, grid_us))
    if not window.low_activity:
        mean = window.twists[:, 3:].mean(0)
        track = agreement.add_window(track, window.start_us, window.end_us, mean, refined=window.refined)
    if track.since < agreement.EVERY:
        return state._replace(track=track)
    found = agreement.judge(track)
    doubts = min(state.doubts + 1, 4) if found.why else max(0, state.doubts - 1)
    if found.correlation is None:  # nothing turned: the last judgement stands
        found, doubts = state.agreement, state.doubts
    return state._replace(track=track._replace(since=0), agreement=found, doubts=doubts)
