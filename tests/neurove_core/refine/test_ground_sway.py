"""Rates of pitch and roll: no slow mean, less noise, and yaw as it was."""

import math

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine.ground_sway import (
    MOST_TOO_FAST,
    NOISE_RAD_S,
    PITCH_KEPT,
    ROLL_KEPT,
    TOO_FAST_S,
    Sway,
    swayed,
)

PITCH = math.radians(5)
UP = np.array([0.0, math.cos(PITCH), math.sin(PITCH)])
AHEAD = np.array([0.0, -math.sin(PITCH), math.cos(PITCH)])


def filtered(
    pitching: NDArray[np.float64], rolling: NDArray[np.float64], speed_m_s: float = 8.0
) -> NDArray[np.float64]:
    """Rates about the axes of the ground (N, 3): pitch, yaw, roll, of a camera that yaws at 0.4 rad/s."""
    sway, out = Sway(), []
    for pitch, roll in zip(pitching, rolling, strict=True):
        w = np.array([pitch, 0, 0]) + 0.4 * UP + roll * AHEAD
        twist, sway = swayed(np.concatenate([[0.1, 0.2, speed_m_s], w]), PITCH, sway)
        np.testing.assert_array_equal(twist[:3], [0.1, 0.2, speed_m_s])
        out.append([twist[3], twist[3:] @ UP, twist[3:] @ AHEAD])
    return np.array(out)


def test_constant_rates_of_pitch_and_roll_are_errors_and_yaw_stays() -> None:
    found = filtered(np.full(200, 0.05), np.full(200, -0.05))
    assert np.abs(found[-1, [0, 2]]).max() < 0.01
    np.testing.assert_allclose(found[:, 1], 0.4, atol=1e-12)


def test_rates_with_noise_are_nearer_to_the_truth() -> None:
    rng = np.random.default_rng(0)
    time_s = np.arange(400) * 0.05
    truth = 0.02 * np.stack([np.sin(2 * np.pi * time_s), np.cos(1.7 * np.pi * time_s)])
    noise = rng.normal(size=(2, 403))
    noise = sum(noise[:, k : k + 400] for k in range(4)) / 2  # the spans of four answers in a row overlap
    noisy = truth + NOISE_RAD_S * noise
    found = filtered(*noisy)[:, [0, 2]].T
    for axis in (0, 1):
        before, after = (np.sqrt(np.mean((one[axis] - truth[axis]) ** 2)) for one in (noisy, found))
        assert after < before


def test_little_motion_keeps_its_least_share() -> None:
    rng = np.random.default_rng(1)
    little = NOISE_RAD_S / 2 * rng.normal(size=(2, 200))
    found = filtered(*little)[100:, [0, 2]].T
    kept = np.sqrt((found**2).mean(axis=1) / (little[:, 100:] ** 2).mean(axis=1))
    np.testing.assert_allclose(kept, [PITCH_KEPT, ROLL_KEPT], atol=0.12)


def test_much_motion_is_kept_almost_whole() -> None:
    time_s = np.arange(400) * 0.05
    swing = 0.1 * np.sin(2 * np.pi * time_s)
    found = filtered(swing, swing)[200:, [0, 2]]
    np.testing.assert_allclose(np.sqrt((found**2).mean(axis=0)), 0.1 / math.sqrt(2), rtol=0.15)


def test_a_low_fast_camera_shows_its_yaw_rate_too_fast() -> None:
    twist = np.concatenate([[0.0, 0.0, 4.0], 0.4 * UP])

    def yaw(height_m: float) -> float:
        return float(swayed(twist, PITCH, Sway(), height_m)[0][3:] @ UP)

    assert math.isclose(yaw(0.5), 0.4 * (1 - TOO_FAST_S * 8))
    assert math.isclose(yaw(0.01), 0.4 * (1 - MOST_TOO_FAST))
    assert math.isclose(swayed(twist, PITCH, Sway())[0][3:] @ UP, 0.4)


def test_the_rates_of_a_slow_camera_stay() -> None:
    found = filtered(np.full(30, 0.1), np.full(30, -0.1), speed_m_s=0.0)
    np.testing.assert_allclose(found[:, 0], 0.1, atol=0.01)
    np.testing.assert_allclose(found[:, 2], -0.1, atol=0.01)
