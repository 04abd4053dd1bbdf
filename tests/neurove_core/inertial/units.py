"""Signals of an inertial unit, from a known motion."""

from collections.abc import Callable

import numpy as np

from neurove_core.inertial.state import Window
from neurove_protocol import Imu

GRAVITY = np.array([0.0, -9.81, 0.0])
Motion = Callable[[np.ndarray], np.ndarray]


def still(t_s: np.ndarray) -> np.ndarray:
    return np.zeros((t_s.size, 3))


def shaking(t_s: np.ndarray) -> np.ndarray:
    """Turns about all axes, each with a frequency of its own [rad/s]."""
    return np.stack([0.5 * np.sin(2.3 * t_s), 0.8 * np.sin(1.7 * t_s + 1), 0.4 * np.sin(3.1 * t_s + 2)], axis=1)


def samples(
    motion: Motion,
    seconds: float,
    *,
    rate_hz: float = 500,
    start_us: int = 0,
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
    noise: float = 0.002,
    accel_noise: float = 0.03,
    late_us: int = 0,
    seed: int = 20100,
) -> Imu:
    rng = np.random.default_rng(seed)
    t_us = start_us + np.arange(round(seconds * rate_hz)) * round(1e6 / rate_hz)
    gyro = motion(t_us / 1e6) + bias + rng.normal(0, noise, (t_us.size, 3))
    return Imu(t_us + late_us, GRAVITY + rng.normal(0, accel_noise, (t_us.size, 3)), gyro)


def window(
    start_us: int, motion: Motion, *, speed: float = 0.0, refined: bool = True, bins: int = 5, scale_m: float = 1.0
) -> Window:
    """A window of 50 ms whose events show this motion, and a forward speed [m/s]."""
    edges_s = (start_us + np.arange(bins) * 10_000 + 5_000) / 1e6
    twists = np.concatenate([np.tile([0.0, 0.0, speed], (bins, 1)), motion(edges_s)], axis=1)
    covariance = np.diag([0.1, 0.1, 0.2, 0.04, 0.04, 0.04]) ** 2 + 1e-5
    return Window(start_us, start_us + 50_000, twists, covariance, False, refined, scale_m)
