"""Motion over the ground: the motion of a camera over a level plane at which the events of some windows are sharpest.

The camera moves at a known height over a plane of nearly known pitch. The events of the last SPAN_US are moved to the
middle of that time, along one motion. The unknowns are the velocity, the angular velocity, the pitch, and the distances
of walls on both sides. The search maximises the logarithm of the sharpness (see `ground_kernels.sharpness`) less the
squared distance from what is known before: the network's velocity with a wide sigma, little velocity into the ground,
the angular velocity, the pitch and the walls of the windows before. It starts from the network, from the last answer
and from rest, whichever is sharpest. A slow camera is seen for LONG_SPAN_US.

On the ground, only events near the path ahead count, near ones count more than far ones, and events in crowded places
count less. Events near and above the horizon, in the direction of the motion, are far away: they see the turning of the
camera. Each lies on the ground or on an upright wall parallel to the path, whichever is nearer.

Source: Gallego, Rebecq and Scaramuzza 2018 (contrast maximisation).
Differs: maximum a posteriori, band-passed, with walls; see decisions 85 and 94.
"""

import math
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.ingest.sample import Sample
from neurove_core.refine import ground_kernels as kernels
from neurove_core.refine import ground_newest, ground_pitch
from neurove_core.refine.ground_image import FAR_UP, image_of, own_sharpness
from neurove_core.refine.ground_kernels import Image, Rays
from neurove_core.refine.ground_search import UNKNOWNS, Climbed, Prior, climb, motion_of, objective
from neurove_core.refine.ground_sway import Sway, steady, swayed
from neurove_core.refine.late import ANSWERS, Answers, change
from neurove_core.refine.standing import Standing, answered, outweighs
from neurove_core.refine.view import View
from neurove_protocol import CameraInfo

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

Outcome = Literal["accepted", "turning", "tilting", "few events", "noise", "contradicted", "standing"]

SPAN_US: Final = 200_000
"""Time whose events are used. One constant motion is assumed."""

LONG_SPAN_US: Final = 400_000
"""The same for a slow camera."""

SLOW: Final = 0.7
"""Greatest speed over the height of a slow camera [1/s]."""

EVENTS: Final = 6000
"""Most events on the ground of a search."""

FAR_EVENTS: Final = 4000
"""Most far events of a search."""

WINDOW_EVENTS: Final = 3000
"""Most events on the ground that are kept of one window, and FAR_WINDOW far ones; 16 bytes each."""

FAR_WINDOW: Final = 2000

LEAST_EVENTS: Final = 200
"""With fewer events on the ground, and fewer far ones, there is no answer."""

LEAST_SHARE: Final = 0.4
"""Least number of events on the ground over that of far ones. It is .7 or more in streets, and at most .5 where the
ground has one colour."""

PITCH: Final = math.radians(5)
"""Pitch of a camera before anything is known [rad], positive downwards."""

PITCH_SIGMA: Final = math.radians(4)

MAX_TILT_RAD_S: Final = 0.15
"""Greatest rate of pitch and roll of a vehicle. Streets shake a camera at .03 rad/s."""

MIN_STRUCTURE: Final = (0.52, 0.23)
"""Least structure of few events, and what EVENTS add to it, by the square of their number. That of noise is .35 to .5
with 1000 events and .5 to .66 with EVENTS, that of a street at 0.3 m/s from 1 m is .63 or more with 1900."""

MAX_SIGMAS: Final = 5.0
"""Greatest distance from what was known before."""

MAX_RATE_SIGMAS: Final = 1.0
"""Greatest distance from an angular velocity that the events of the window gave without the ground."""

_FAR_ASIDE: Final = 0.4  # greatest |x/z| of far events
_FAR_WEIGHT: Final = 0.5  # of a far event; that of one on the ground is its height / depth
_WALL: Final = 0.15  # inverse distance of a wall, when nothing is known [1/m]
_WALL_SPAN: Final = (0.02, 0.4)  # bounds of what is learned [1/m]
_NEAREST_HORIZON: Final = 0.08  # least height / depth: farther ground is too near to the horizon
_ASIDE: Final = 2.0  # greatest distance to the side [heights]
_CROWD: Final = 2  # [cells]
_FEW: Final = 0.3  # crowding that makes no difference, as a share of the mean
_WEIGHT: Final = 0.02  # of the prior
_SIGMA_M_S: Final = (0.2, 0.3, 0.8)  # of the velocity: right, into the ground at most, ahead
_SIGMA_DOWN: Final = (0.05, 0.03)  # of the velocity into the ground [m/s], and its growth by the speed
_SIGMA_SHARE: Final = 0.1  # the same as a share of the speed, above 10 m/s
_SIGMA_YAW: Final = (0.05, 0.1)  # bounds of the sigma of the yaw rate [rad/s]
_SIGMA_TILT: Final = (0.02, 0.016, 0.1)  # of the rates of pitch and roll: at rest, growth by the speed, most [rad/s]
_SIGMA_WALL: Final = 0.1  # of the inverse distance of a wall [1/m]
_STEPS: Final = 14  # evaluations of a search
_TOLERANCE: Final = 0.02  # of a search [sigma]
_CALIBRATION: Final = np.array([0.6, 0.5, 1.0, 0.42, 0.7, 0.4, 0.7, 0.7, 0.7])  # of sigma
_TILT_SHARE: Final = 0.1  # of a new window in the mean square rate of pitch and roll


class GroundEvents(NamedTuple):
    """Events as undistorted rays (x, y, 1), ordered by time."""

    x: Floats  # (N,) x/z
    y: Floats  # (N,) y/z
    t_us: NDArray[np.int64]  # (N,) sensor clock


class GroundState(NamedTuple):
    """What a stream carries from window to window."""

    recent: tuple[GroundEvents, ...] = ()  # of the windows in the last LONG_SPAN_US, oldest first
    end_us: int | None = None  # end of the newest of them
    last: Array | None = None  # (6,) last answer: twist over the height, [1/s] and [rad/s]
    pitch: float = PITCH  # [rad]
    pitch_sigma: float = PITCH_SIGMA
    walls: tuple[float, float] = (_WALL, _WALL)  # inverse distances to the right and to the left [1/m]
    calm_us: int = SPAN_US  # time since the camera last pitched or rolled, at most SPAN_US
    sway: Sway = Sway()
    tilt: float = 0.0  # mean square rate of pitch and roll before the search [rad^2/s^2]
    standing: Standing = Standing()
    answers: Answers = ()  # accepted in a row, see `late`
    doubted: bool = False  # whether the network's rates were too great for a vehicle in the window before


class GroundMotion(NamedTuple):
    """The motion of a camera over the ground, in the last SPAN_US or LONG_SPAN_US."""

    twist: Array  # (6,) vx vy vz [m/s], wx wy wz [rad/s], optical frame
    covariance: Array  # (6, 6)
    pitch: float  # [rad], positive downwards
    gain: float  # logarithm of the sharpness, over that of the motion known before
    gain_moving: float  # the same, over that of turning without moving
    structure: float  # the same, over that of as many events that do not belong together
    distance: float  # from what was known before [sigma]
    events: int  # of the search


class Answer(NamedTuple):
    """Result of `refine`."""

    outcome: Outcome
    motion: GroundMotion | None  # also where it is not accepted, but for "few events" and "tilting"
    state: GroundState


def events_of(view: View, sample: Sample, start_us: int) -> GroundEvents:
    """The events of a window that begins at `start_us`, without those outside the lens model."""
    x, y = view.rays[:, sample.y, sample.x]
    kept = np.isfinite(x) & np.isfinite(y)
    return GroundEvents(x[kept], y[kept], start_us + sample.t_us[kept].astype(np.int64))


def compile_kernels(camera: CameraInfo) -> None:
    """Run all compiled code once, on made-up events."""
    x, y = (np.linspace(low, 0.4, LEAST_EVENTS, dtype=np.float32) for low in (-0.2, 0.2))
    events = GroundEvents(x, y, np.arange(LEAST_EVENTS, dtype=np.int64))
    refine(events, 0, SPAN_US, camera, np.zeros(6), np.full(3, 0.1), GroundState())


def refine(
    new: GroundEvents,
    start_us: int,
    end_us: int,
    camera: CameraInfo,
    twist: Array,
    sigma_rad_s: Array,
    state: GroundState,
    measured: Array | None = None,
) -> Answer:
    """The motion over the ground in the last SPAN_US before the end of a window.

    Args:
        new: events of the window.
        start_us: start of the window, sensor clock; a gap before it discards the events of older windows.
        end_us: its end.
        camera: lens and height. Without a height, the velocity is that of a camera at 1 m.
        twist: (6,) the estimate so far [m/s, rad/s], mean of the window.
        sigma_rad_s: (3,) sigma of its angular part.
        state: of the stream; `GroundState()` at first.
        measured: (3, 3) covariance of the angular part of `twist`, if the refinement by rotation gave it.

    Returns:
        an answer is accepted unless
        - the camera pitches or rolls faster than MAX_TILT_RAD_S, or has done so in the last SPAN_US ("tilting"): a
          camera in a hand is not at a known height and pitch. After ANSWERS accepted ones a single window that only the
          network says to tilt is searched about the last answer first;
        - there are fewer than LEAST_EVENTS on the ground and fewer far ones ("few events");
        - the ground has few events, as one of one colour: only the angular velocity is known ("turning");
        - its events do not belong together ("noise"), as those of a stationary camera;
        - it is more than MAX_SIGMAS from what was known before, or its angular velocity more than MAX_RATE_SIGMAS from
          the measured one ("contradicted"), as that of a camera whose height changes;
        - it is less certain than that the vehicle stands ("standing").
    """
    before = state
    recent = state.recent if state.end_us in (None, start_us) else ()
    window_us = end_us - start_us
    state = state._replace(
        recent=(*recent, _kept(new, state.pitch))[-_windows(LONG_SPAN_US, window_us) :], end_us=end_us
    )
    c, s = math.cos(state.pitch), math.sin(state.pitch)
    tilt_rad_s = math.hypot(twist[3], c * twist[5] - s * twist[4])
    state = state._replace(tilt=state.tilt + _TILT_SHARE * (tilt_rad_s**2 - state.tilt))
    if tilt_rad_s > MAX_TILT_RAD_S:
        if measured is None and state.last is not None and len(state.answers) == ANSWERS and not state.doubted:
            level = steady(twist, state.last, state.pitch)
            answer = refine(new, start_us, end_us, camera, level, sigma_rad_s, before)
            if answer.outcome == "accepted":
                return answer._replace(state=answer.state._replace(doubted=True))
        state = state._replace(recent=(), last=None, pitch_sigma=PITCH_SIGMA, calm_us=0, sway=Sway(), doubted=False)
        return Answer("tilting", None, state)
    state = state._replace(calm_us=min(state.calm_us + window_us, SPAN_US))
    if state.calm_us < SPAN_US:
        return Answer("tilting", None, state)
    height_m = camera.height_m or 1.0
    speed = float(np.linalg.norm(twist[:3] / height_m if state.last is None else state.last[:3]))
    used = state.recent[-_windows(LONG_SPAN_US if speed < SLOW else SPAN_US, window_us) :]
    seen = on_ground(used, state.pitch)
    near = int(np.count_nonzero(c * seen.y + s > _NEAREST_HORIZON))
    far = seen.t_us.size - near
    if max(near, far) < LEAST_EVENTS:
        return Answer("few events", None, state._replace(last=None))
    begin_us = end_us - window_us * len(used)
    found, motion, unknowns, by_events = _searched(seen, (begin_us + end_us) // 2, camera, twist, sigma_rad_s, state)
    if found.structure < MIN_STRUCTURE[0] + MIN_STRUCTURE[1] * (found.events / EVENTS) ** 2:
        return Answer("noise", found, state._replace(last=None))
    if found.distance > MAX_SIGMAS or _distance(found, twist, measured) > MAX_RATE_SIGMAS:
        return Answer("contradicted", found, state._replace(last=None))
    if outweighs(state.standing, math.sqrt(found.covariance[2, 2])):
        return Answer("standing", found, state._replace(last=None))
    if near < max(LEAST_EVENTS, LEAST_SHARE * far):
        twist, sway = swayed(found.twist, state.pitch, state.sway)
        return Answer("turning", found._replace(twist=twist), state._replace(last=None, sway=sway))
    known = ground_pitch.Pitch(state.pitch, state.pitch_sigma)
    pitch, pitch_sigma = ground_pitch.learned(known, by_events, 1 / len(used), PITCH_SIGMA)
    twist = found.twist
    if speed >= SLOW and np.linalg.norm(twist[:3]) > ground_newest.FROM_M_S:
        twist = _newest_roll(camera, unknowns, found, state, window_us)
    twist, sway = swayed(twist, found.pitch, state.sway, height_m)
    found, answers = _on_time(found._replace(twist=twist), state.answers, begin_us, end_us, window_us)
    ahead = math.sqrt(found.covariance[2, 2]) / height_m
    standing = answered(state.standing, end_us, float(np.linalg.norm(motion[:3])), ahead)
    walls = np.clip(np.array(state.walls) + motion[7:] / height_m, *_WALL_SPAN)
    state = state._replace(
        last=motion[:6],
        pitch=pitch,
        pitch_sigma=pitch_sigma,
        walls=(float(walls[0]), float(walls[1])),
        sway=sway,
        doubted=False,
        standing=standing,
        answers=answers,
    )
    return Answer("accepted", found, state)


def _on_time(
    found: GroundMotion, answers: Answers, begin_us: int, end_us: int, window_us: int
) -> tuple[GroundMotion, Answers]:
    """The motion in the middle of the newest window, not that of the span, and the answers after it; see `late`."""
    middle_s, newest_s = (begin_us + end_us) / 2e6, (2 * end_us - window_us) / 2e6
    if answers and middle_s - answers[-1][0] > 4 * window_us / 1e6:  # spans differ in length
        answers = ()
    ahead = np.array([0.0, -math.sin(found.pitch), math.cos(found.pitch)])
    answers = (*answers, (middle_s, float(ahead @ found.twist[:3]), float(found.twist[4])))[-ANSWERS:]
    more = change(answers, newest_s - middle_s)
    twist, covariance = found.twist.copy(), found.covariance.copy()
    twist[:3] += more.speed_m_s * ahead
    covariance[:3, :3] += more.sigma_m_s**2 * np.outer(ahead, ahead)
    twist[4] += more.yaw_rad_s
    covariance[4, 4] += more.sigma_rad_s**2
    return found._replace(twist=twist, covariance=covariance), answers


def _distance(found: GroundMotion, twist: Array, measured: Array | None) -> float:
    """Distance of the angular velocity from the measured one [sigma]; 0 without one."""
    if measured is None:
        return 0.0
    apart = found.twist[3:] - twist[3:]
    return math.sqrt(apart @ np.linalg.solve(found.covariance[3:, 3:] + measured, apart))


def _windows(span_us: int, window_us: int) -> int:
    return -(-span_us // window_us)


def _kept(new: GroundEvents, pitch: float) -> GroundEvents:
    """The events of a window that may be on the ground, or far away, for all likely pitches; thinned."""
    depth, margin = math.cos(pitch) * new.y + math.sin(pitch), _NEAREST_HORIZON / 2
    ground = (depth > margin) & (np.abs(new.x) < _ASIDE * (depth + margin))
    far = ~ground & (depth < _NEAREST_HORIZON + margin) & _ahead(new)
    return _joined(_taken(new, ground, WINDOW_EVENTS), _taken(new, far, FAR_WINDOW))


def _ahead(events: GroundEvents) -> NDArray[np.bool_]:
    return (np.abs(events.x) < _FAR_ASIDE) & (events.y > -FAR_UP)


def _joined(*parts: GroundEvents) -> GroundEvents:
    return GroundEvents(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _taken(events: GroundEvents, chosen: NDArray[np.bool_], most: int) -> GroundEvents:
    kept = np.flatnonzero(chosen)
    if kept.size > most:
        kept = kept[np.arange(most) * kept.size // most]
    return GroundEvents(events.x[kept], events.y[kept], events.t_us[kept])


def on_ground(recent: Sequence[GroundEvents], pitch: float) -> GroundEvents:
    """The events of some windows on the ground near the path ahead, and far ones; each evenly thinned."""
    every = _joined(*recent)
    depth = math.cos(pitch) * every.y + math.sin(pitch)
    near = (depth > _NEAREST_HORIZON) & (np.abs(every.x) < _ASIDE * depth)
    far = (depth <= _NEAREST_HORIZON) & _ahead(every)
    return _joined(_taken(every, near, EVENTS), _taken(every, far, FAR_EVENTS))


def _searched(
    seen: GroundEvents, reference_us: int, camera: CameraInfo, twist: Array, sigma_rad_s: Array, state: GroundState
) -> tuple[GroundMotion, Array, Array, ground_pitch.Pitch]:
    """The most probable motion, as a motion (9,) of `sharpness` and as unknowns (9,) too, and the pitch it teaches."""
    height_m = camera.height_m or 1.0
    rays, image = _rays_of(seen, reference_us, camera, state)
    prior = _prior(twist, height_m, sigma_rad_s, state)
    climbed = _search(rays, image, prior, state.last)
    z, information = climbed.z, climbed.information
    unknowns = prior.mean + prior.sigma * z
    motion = motion_of(unknowns, prior.pitch)
    covariance = _covariance(z, information, prior)
    metres = np.array([height_m] * 3 + [1.0] * 3)
    known = motion_of(np.append(prior.mean[:6], motion[6:]), prior.pitch)
    turning = np.concatenate([np.zeros(3), motion[3:]])
    sharp = climbed.value + 0.5 * prior.weight * float(z @ z)
    before, still = (kernels.sharpness(rays, one, image)[0] for one in (known, turning))
    found = GroundMotion(
        twist=motion[:6] * metres,
        covariance=covariance[:6, :6] * np.outer(metres, metres),
        pitch=prior.pitch + float(unknowns[6]),
        gain=sharp - before,
        gain_moving=sharp - still,
        structure=sharp - own_sharpness(rays, image),
        distance=float(np.linalg.norm(z[:6])),
        events=rays.x.size,
    )
    return found, motion, unknowns, ground_pitch.by_events(z, information, prior)


def _newest_roll(camera: CameraInfo, unknowns: Array, found: GroundMotion, state: GroundState, window_us: int) -> Array:
    """The twist of a search (6,) with the roll rate of the newest events, see `ground_newest`."""
    used = state.recent[-_windows(ground_newest.NEWEST_US, window_us) :]
    assert state.end_us is not None  # there is a window
    rays, image = _rays_of(on_ground(used, state.pitch), state.end_us - window_us * len(used) // 2, camera, state)
    newest_rad_s = ground_newest.rates(rays, image, unknowns, state.pitch, camera.height_m or 1.0)
    return ground_newest.with_roll(found.twist, newest_rad_s, found.pitch)


def _rays_of(seen: GroundEvents, reference_us: int, camera: CameraInfo, state: GroundState) -> tuple[Rays, Image]:
    """Some events before the walls that are known, and the image that they are moved into."""
    height_m, image = camera.height_m or 1.0, image_of(camera)
    walls = state.walls[0] * height_m, state.walls[1] * height_m
    return rays_of(seen, reference_us, state.pitch, image, walls), image


def rays_of(
    seen: GroundEvents, reference_us: int, pitch: float, image: Image, walls: tuple[float, float] = (_WALL, _WALL)
) -> Rays:
    """The events of `on_ground` with their depth on the plane or on a wall, their time and their weight.

    Args:
        seen: the events.
        reference_us: time that they are moved to.
        pitch: of the plane [rad].
        image: for the crowding.
        walls: height over distance of the walls to the right and to the left.
    """
    c, s = math.cos(pitch), math.sin(pitch)
    x, y = seen.x.astype(np.float64), seen.y.astype(np.float64)
    depth = c * y + s
    crowd = kernels.crowding(x, y, image, _CROWD)
    far = depth <= _NEAREST_HORIZON
    wall = np.where(x > 0, walls[0], -walls[1]) * x
    on_wall = far & (wall > depth)
    weight = np.where(far, _FAR_WEIGHT, depth) / np.sqrt(crowd + _FEW * crowd.mean())
    return Rays(
        x=x,
        y=y,
        depth=np.where(on_wall, wall, depth),
        tilt=np.where(on_wall, 0.0, c - s * y),
        side=np.where(on_wall, x, 0.0),
        time=(seen.t_us - reference_us) / 1e6,
        weight=weight,
    )


def _prior(twist: Array, height_m: float, sigma_rad_s: Array, state: GroundState) -> Prior:
    c, s = math.cos(state.pitch), math.sin(state.pitch)
    v = twist[:3] / height_m
    mean = np.array([v[0], 0.0, c * v[2] - s * v[1], *twist[3:], 0.0, 0.0, 0.0])
    speed_m_s = float(np.linalg.norm(twist[:3] if state.last is None else state.last[:3] * height_m))
    wide = max(1.0, _SIGMA_SHARE * float(np.linalg.norm(twist[:3]))) / height_m
    down = min(_SIGMA_DOWN[0] + _SIGMA_DOWN[1] * speed_m_s, _SIGMA_M_S[1])  # a vehicle heaves and shakes with its speed
    tilt = min(_SIGMA_TILT[0] + _SIGMA_TILT[1] * speed_m_s, _SIGMA_TILT[2])
    moving = np.array([_SIGMA_M_S[0], down, _SIGMA_M_S[2]]) * wide
    turning = tilt, float(np.clip(sigma_rad_s[1], *_SIGMA_YAW)), tilt
    sigma = [*moving, *turning, state.pitch_sigma, _SIGMA_WALL * height_m, _SIGMA_WALL * height_m]
    return Prior(mean, np.array(sigma), _WEIGHT, state.pitch)


def _search(rays: Rays, image: Image, prior: Prior, last: Array | None) -> Climbed:
    """The most probable distance from the prior's mean, and what the events say of it."""
    resting = np.concatenate([np.zeros(3), prior.mean[3:]])
    starts = [np.zeros(UNKNOWNS), (resting - prior.mean) / prior.sigma]
    if last is not None:
        c, s = math.cos(prior.pitch), math.sin(prior.pitch)
        along = np.array([last[0], c * last[1] + s * last[2], c * last[2] - s * last[1], *last[3:], 0.0, 0.0, 0.0])
        starts.append((along - prior.mean) / prior.sigma)
    values = [objective(start, rays, image, prior)[0] for start in starts]
    return climb(starts[int(np.argmax(values))], rays, image, prior, _STEPS, _TOLERANCE)


def _covariance(z: Array, information: Array, prior: Prior) -> Array:
    """Covariance (9, 9) of the motion: the inverse of the curvature, where a prior sigma counts as `prior.weight`.

    Its scales _CALIBRATION make 90 % intervals hold on streets.
    """
    inverse = prior.weight * np.linalg.inv(information + prior.weight * np.eye(UNKNOWNS))
    scale = prior.sigma * _CALIBRATION
    along = inverse * np.outer(scale, scale)
    turn = np.eye(UNKNOWNS)
    pitch = prior.pitch + float(prior.mean[6] + prior.sigma[6] * z[6])
    turn[1:3, 1:3] = [[math.cos(pitch), -math.sin(pitch)], [math.sin(pitch), math.cos(pitch)]]
    found = turn @ along @ turn.T
    return np.asarray((found + found.T) / 2)  # symmetric to the last bit, as the wire format requires
