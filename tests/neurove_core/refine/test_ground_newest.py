"""The roll rate of the newest events, where that of the whole span is another one."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from neurove_core.refine.ground import PITCH, GroundEvents, GroundState, image_of, rays_of, refine
from neurove_core.refine.ground_newest import FROM_M_S, FULL_M_S, rates, with_roll
from neurove_protocol import CameraInfo

Array = NDArray[np.float64]

CAMERA = CameraInfo.model_validate(
    {"stream": "cam0", "height_m": 1.0, "width": 172, "height": 130, "fx": 112.0, "fy": 112.0, "cx": 85.5, "cy": 64.5}
    | {"lens": "pinhole"}
)
C, S = math.cos(PITCH), math.sin(PITCH)
UP, AHEAD = np.array([0.0, C, S]), np.array([0.0, -S, C])
WINDOW_US = 50_000
SPEED_M_S = 4.0


def moving(roll_rad_s: float, yaw_rad_s: float = 0.0) -> Array:
    """The twist of a camera that drives ahead."""
    return np.concatenate([SPEED_M_S * AHEAD, roll_rad_s * AHEAD + yaw_rad_s * UP])


def seen(twist: Array, start_us: int, reference_us: int, seed: int) -> GroundEvents:
    """A window of events of points on the ground, which are where they are at the reference time."""
    rng = np.random.default_rng(seed)
    right, far = rng.uniform(-3, 3, 400), rng.uniform(1, 12, 400)
    points = np.repeat(np.stack([right, C - S * far, S + C * far], axis=1), 12, axis=0)
    t_us = np.sort(start_us + rng.integers(0, WINDOW_US, len(points)))
    points = rng.permutation(points)
    time = (t_us[:, None] - reference_us) / 1e6
    once = -(twist[:3] + np.cross(twist[3:], points))
    x, y, z = (points + time * once - time**2 / 2 * np.cross(twist[3:], once)).T
    u, v = np.rint(x / z * 112 + 85.5), np.rint(y / z * 112 + 64.5)
    inside = (z > 0.1) & (u >= 0) & (u < 172) & (v >= 0) & (v < 130)
    columns = (((side - centre) / 112)[inside].astype(np.float32) for side, centre in ((u, 85.5), (v, 64.5)))
    return GroundEvents(*columns, t_us[inside])


def stepped(roll_rad_s: float) -> float:
    """The roll rate of one step, from a motion without roll."""
    parts = [seen(moving(roll_rad_s, 0.2), start_us, WINDOW_US, 1) for start_us in (0, WINDOW_US)]
    events = GroundEvents(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    image = image_of(CAMERA)
    unknowns = np.array([0.0, 0.0, SPEED_M_S, *0.2 * UP, 0.0, 0.0, 0.0])
    return float(rates(rays_of(events, WINDOW_US, PITCH, image), image, unknowns, PITCH, 1.0) @ AHEAD)


def test_one_step_goes_towards_the_roll_rate() -> None:
    left, straight, right = (stepped(roll) for roll in (-0.05, 0.0, 0.05))
    assert abs(straight) < 0.012
    assert -0.06 < left < straight - 0.015
    assert straight + 0.015 < right < 0.06


@pytest.mark.parametrize("roll", [-0.06, 0.06])
def test_an_answer_has_the_roll_rate_of_the_newest_windows(roll: float) -> None:
    state = GroundState()
    for number in range(8):
        twist = moving(roll if number >= 6 else -roll)  # the mean of the last span is zero
        start_us = number * WINDOW_US
        pair = number // 2  # windows of a pair see the same points
        events = seen(twist, start_us, WINDOW_US * (2 * pair + 1), pair)
        known = moving(0.0), np.full(3, 0.05)
        found = refine(events, start_us, start_us + WINDOW_US, CAMERA, *known, state)
        state = found.state
    assert found.outcome == "accepted"
    assert found.motion is not None
    assert found.motion.twist[3:] @ AHEAD * np.sign(roll) > 0.02


@pytest.mark.parametrize(
    ("speed_m_s", "share"),
    [(0.0, 0.0), (FROM_M_S, 0.0), ((FROM_M_S + FULL_M_S) / 2, 0.5), (FULL_M_S, 1.0), (12.0, 1.0)],
)
def test_another_roll_rate_changes_neither_velocity_nor_pitch_nor_yaw_rate(speed_m_s: float, share: float) -> None:
    rng = np.random.default_rng(2)
    twist, newest = np.concatenate([speed_m_s * AHEAD, rng.normal(size=3)]), rng.normal(size=3)
    found = with_roll(twist, newest, PITCH)
    np.testing.assert_array_equal(found[:4], twist[:4])
    assert found[3:] @ UP == pytest.approx(twist[3:] @ UP)
    assert found[3:] @ AHEAD == pytest.approx((1 - share) * twist[3:] @ AHEAD + share * newest @ AHEAD)
