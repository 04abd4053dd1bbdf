"""Random trajectories from a seed: a drive through streets, and a hand-held camera in a room."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.sim.motion.curves import SplineTrajectory, Trajectory

Array = NDArray[np.float64]

_DRIVE_STEP_S: Final = 0.1
_HAND_STEP_S: Final = 0.02
_ROBOT_STEP_S: Final = 0.05
_TAIL_S: Final = 10.0  # generated and dropped, so that a longer drive of the same seed begins like the shorter one

TOP_M_S: Final = 12.0
"""Greatest speed of a drive."""

MAX_HEADING: Final = 1.6
"""Greatest heading of a drive relative to its first direction [rad], without the motion of the suspension."""

LEVER_M: Final = 1.5
"""Distance of the camera ahead of the unsteered axle; it gives the camera a sideways velocity in corners."""


def driving(seed: int, seconds: float = 600.0) -> SplineTrajectory:
    """Generate the trajectory of a car on level ground: 0 to 12 m/s, with stops, bends, corners, pitch, roll and heave.

    Accelerations are those of calm driving (1.6 m/s2 forward, 2.2 m/s2 braking, 2.5 m/s2 sideways). The heading stays
    within MAX_HEADING of z, so that the path does not cross itself. The body pitches and rolls with the acceleration
    and shakes with the speed; a standing car does not move. The model is MVSEC's outdoor_day: forward speed 5 (3) m/s,
    yaw rate 0.12 to 0.16 rad/s root mean square, at most about 0.6.
    """
    rng, shaking = np.random.default_rng((seed, 1)), np.random.default_rng((seed, 2))
    n = math.ceil(seconds / _DRIVE_STEP_S) + 1
    tail = round(_TAIL_S / _DRIVE_STEP_S)
    speed, yaw_rate = (_eased(values) for values in _manoeuvres(rng, n + tail))
    yaw = np.cumsum(yaw_rate) * _DRIVE_STEP_S
    # 0.006 rad per m/s2: nose up in acceleration, nose down in braking, and roll to the outside of a bend
    lean = 0.006 * np.stack([_rate(speed), 0 * speed, -yaw_rate * speed], axis=1)
    shake = noise(shaking, n + tail, 3, 0.4, 1.5, _DRIVE_STEP_S) * np.minimum(speed / 5, 1)[:, None]
    tilt = lean + shake * np.array([0.0025, 0.0, 0.0025])
    heading = rotations.exp(np.stack([0 * yaw, yaw, 0 * yaw], axis=1))
    step = np.stack([np.sin(yaw) * speed, 0 * yaw, np.cos(yaw) * speed], axis=1) * _DRIVE_STEP_S
    position = np.concatenate([np.zeros((1, 3)), np.cumsum((step[1:] + step[:-1]) / 2, axis=0)])
    position += LEVER_M * rotations.turn(heading, np.array([0.0, 0.0, 1.0]))  # the camera swings out in corners
    position = position - position[:1]
    position[:, 1] = 0.01 * shake[:, 1]
    orientation = rotations.product(heading, rotations.exp(tilt))
    return SplineTrajectory.through(f"driving {seed}", _DRIVE_STEP_S, position[:n], orientation[:n], seconds)


def _manoeuvres(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Speed (n,) [m/s] within the accelerations, and yaw rate (n,) [rad/s], positive to the right; not smoothed yet."""
    speed, yaw_rate = np.zeros(n), np.zeros(n)
    v, heading, i = float(rng.uniform(3, 9)), 0.0, 0
    while i < n:
        kind = rng.choice(["straight", "bend", "corner", "stop"], p=[0.35, 0.3, 0.2, 0.15])
        kind = kind if i else "straight"  # a drive begins straight
        side = -math.copysign(1.0, heading) if abs(heading) > 0.3 else float(rng.choice([-1.0, 1.0]))
        target, curvature, angle = float(rng.uniform(4, TOP_M_S)), 0.0, 0.0
        duration_s = float(rng.uniform(4, 12))
        if kind == "bend":
            curvature, angle = 1 / rng.uniform(30, 120), rng.uniform(0.1, 0.5)
        elif kind == "corner":
            target, duration_s = float(rng.uniform(3.5, 6)), 30.0
            curvature, angle = 1 / rng.uniform(8, 14), min(rng.uniform(1.2, 1.6), MAX_HEADING - side * heading)
        elif kind == "stop":
            target, duration_s = 0.0, float(rng.uniform(2, 7)) + v / 2.2
        turned = 0.0
        for _ in range(round(duration_s / _DRIVE_STEP_S)):
            if i == n or (kind == "corner" and turned >= angle - 1e-9):
                break
            v += float(np.clip(target - v, -0.22, 0.16))
            # a corner begins when the car is slow enough
            ready = turned < angle and (kind != "corner" or v <= target + 0.5)
            rate = min(curvature * v, 2.5 / max(v, 1.0), (angle - turned) / _DRIVE_STEP_S) if ready else 0.0
            turned += rate * _DRIVE_STEP_S
            speed[i], yaw_rate[i] = v, side * rate
            i += 1
        heading += side * turned
    return speed, yaw_rate


def _eased(values: Array) -> Array:
    """Smooth values: the weighted mean over the following 1.2 s; no overshoot, and standstill stays standstill."""
    kernel = np.hanning(15)[1:-1]
    padded = np.concatenate([values, np.full(kernel.size - 1, values[-1])])
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


def _rate(values: Array) -> Array:
    return np.asarray(np.gradient(values, _DRIVE_STEP_S))


def robot(
    seed: int,
    seconds: float = 60.0,
    speed_m_s: tuple[float, float] = (0.1, 3.0),
    rate_rad_s: tuple[float, float] = (0.05, 1.2),
) -> SplineTrajectory:
    """Generate the trajectory of a small robot on level ground that stops, turns in place, and drives straight or arcs.

    Each manoeuvre lasts 0.6 to 4 s at a constant speed and a constant rate. One in ten runs backwards. The heading
    stays within MAX_HEADING of z. The camera is up to 0.3 m ahead of the axle.

    Args:
        seed: of the trajectory.
        seconds: duration.
        speed_m_s: range of the forward speeds, log-uniform.
        rate_rad_s: range of the turning rates, log-uniform.
    """
    rng = np.random.default_rng((seed, 4))
    n, ease = math.ceil(seconds / _ROBOT_STEP_S) + 1, np.hanning(11)[1:-1]
    lever_m = float(rng.uniform(0, 0.3))
    speed, rate = np.zeros(n + ease.size - 1), np.zeros(n + ease.size - 1)
    i, heading = 0, 0.0
    while i < speed.size:
        kind = rng.choice(["rest", "turn", "straight", "arc"], p=[0.1, 0.25, 0.3, 0.35])
        v, w = (math.exp(rng.uniform(*np.log(span))) for span in (speed_m_s, rate_rad_s))
        v, w = v * float(rng.choice([1.0, -1.0], p=[0.9, 0.1])), w * float(rng.choice([1.0, -1.0]))
        steps = round(float(rng.uniform(0.6, 4.0)) / _ROBOT_STEP_S)
        if abs(heading + w * steps * _ROBOT_STEP_S) > MAX_HEADING:
            w = -math.copysign(w, heading)
            steps = min(steps, int(MAX_HEADING / abs(w) / _ROBOT_STEP_S))
        stop = min(i + steps, speed.size)
        speed[i:stop] = v if kind in ("straight", "arc") else 0.0
        rate[i:stop] = w if kind in ("turn", "arc") else 0.0
        heading += float(rate[i:stop].sum()) * _ROBOT_STEP_S
        i = stop
    speed, rate = (np.convolve(values, ease / ease.sum(), mode="valid") for values in (speed, rate))
    yaw = np.cumsum(rate) * _ROBOT_STEP_S
    step = np.stack([np.sin(yaw) * speed, 0 * yaw, np.cos(yaw) * speed], axis=1) * _ROBOT_STEP_S
    position = np.concatenate([np.zeros((1, 3)), np.cumsum((step[1:] + step[:-1]) / 2, axis=0)])
    heading_q = rotations.exp(np.stack([0 * yaw, yaw, 0 * yaw], axis=1))
    position += lever_m * rotations.turn(heading_q, np.array([0.0, 0.0, 1.0]))
    return SplineTrajectory.through(f"robot {seed}", _ROBOT_STEP_S, position - position[:1], heading_q, seconds)


def rocked(trajectory: Trajectory, seed: int, rate_rad_s: float, seconds: float) -> SplineTrajectory:
    """Add a rocking rotation about all axes to a trajectory, as of a robot on legs or on rough ground.

    Args:
        trajectory: it must last `seconds`.
        seed: of the rocking.
        rate_rad_s: root mean square of the added pitch rate, and on average of the roll rate; yaw has a third of it.
        seconds: duration of the result.
    """
    n = math.ceil(seconds / _HAND_STEP_S) + 1
    step_s = seconds / (n - 1)
    position, q = trajectory.position_orientation(np.linspace(0, seconds, n))
    tilt = noise(np.random.default_rng((seed, 5)), n, 3, 0.4, 2.0, step_s)
    tilt *= rate_rad_s / max(1e-9, float(np.sqrt(np.mean(np.gradient(tilt[:, 0], step_s) ** 2))))
    turned = rotations.product(q, rotations.exp(tilt * np.array([1.0, 0.33, 1.0])))
    return SplineTrajectory.through(f"{trajectory.name}, rocked", step_s, position, turned, seconds)


def hand_held(seed: int, seconds: float = 60.0, moved: float = 1.0, turned: float = 1.0) -> SplineTrajectory:
    """Generate the trajectory of a hand-held camera in six degrees of freedom, alternately calm and fast.

    The camera stays within about half a metre of its start and looks along z within about 40 degrees. Spectra and
    speeds follow poster_6dof of the Event Camera Dataset: speed 0.9 m/s median and 2.4 at the 99th percentile, angular
    speed 1.2 rad/s median and 12 at the 99th percentile.

    Args:
        seed: of the trajectory; `moved` and `turned` only scale it.
        seconds: duration.
        moved: factor of the translation; 0 gives a camera that turns in place.
        turned: factor of the rotation; 0 gives a camera that moves without turning.
    """
    n = math.ceil(seconds / _HAND_STEP_S) + 1
    rng = [np.random.default_rng((seed, 3, k)) for k in range(4)]
    # the intensity of the motion varies over some seconds
    wild = np.exp(np.clip(0.35 * noise(rng[0], n, 1, 0.02, 0.06, _HAND_STEP_S) - 0.1, -1.0, 0.5))
    wild_turns = np.exp(np.clip(1.0 * noise(rng[1], n, 1, 0.02, 0.06, _HAND_STEP_S) - 0.5, -2.0, 1.2))
    position = moved * 0.12 * wild * noise(rng[2], n, 3, 0.3, 0.9, _HAND_STEP_S)
    turns = turned * 0.14 * wild_turns * noise(rng[3], n, 3, 0.8, 2.0, _HAND_STEP_S)
    position = position - position[:1]
    return SplineTrajectory.through(f"handheld {seed}", _HAND_STEP_S, position, rotations.exp(turns), seconds)


def noise(rng: np.random.Generator, n: int, channels: int, low_hz: float, high_hz: float, step_s: float) -> Array:
    """Generate smooth noise (n, channels) of variance 1, with most of its power between two frequencies.

    It is white noise filtered by the difference of two Gaussians. A longer signal of the same generator begins with the
    shorter one.
    """
    narrow, wide = 1 / (2 * np.pi * high_hz * step_s), 1 / (2 * np.pi * low_hz * step_s)  # standard deviations [steps]
    reach = math.ceil(3.5 * wide)
    at = np.arange(-reach, reach + 1)
    bells = [np.exp(-0.5 * (at / sigma) ** 2) for sigma in (narrow, wide)]
    kernel = bells[0] / bells[0].sum() - bells[1] / bells[1].sum()
    kernel /= np.linalg.norm(kernel)
    white = rng.standard_normal((n + kernel.size - 1, channels))
    return np.stack([np.convolve(white[:, c], kernel, mode="valid") for c in range(channels)], axis=1)
