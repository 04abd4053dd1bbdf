"""A simulated inertial unit: exact accelerations and turns of a camera's path, with bias and noise."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.world.path import CameraPath
from neurove_protocol.imu import Imu

GRAVITY_M_S2: Final = 9.80665

BATCH_US: Final = 100_000
"""Time of the samples in one batch."""

_DIFFERENCE_S: Final = 0.5e-3  # half of the span over which the velocity is differentiated


class ImuConfig(NamedTuple):
    """The inertial unit. The defaults are those of a cheap unit after it has warmed up."""

    rate_hz: float = 500.0
    gyro_bias_rad_s: float = 0.01  # standard deviation of the constant error of each axis
    gyro_noise_rad_s: float = 0.003  # standard deviation of each sample
    accel_bias_m_s2: float = 0.05
    accel_noise_m_s2: float = 0.05
    offset_us: int = 0  # added to the times of the samples: the clock of the unit is late by it


def biases(config: ImuConfig, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The constant errors of accelerometer (3,) [m/s2] and gyroscope (3,) [rad/s] of a simulation."""
    rng = np.random.default_rng((seed, 11))
    return rng.normal(0, config.accel_bias_m_s2, 3), rng.normal(0, config.gyro_bias_rad_s, 3)


def exact(path: CameraPath, t_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Specific force [m/s2] and angular velocity [rad/s], both (N, 3) in the optical frame.

    The specific force is R^T (dv/dt - g) with the velocity v of the world frame and g = (0, 9.81, 0).

    Args:
        path: of the camera; its world has y down.
        t_s: times (N,) [s] within the path.
    """
    before = np.maximum(t_s - _DIFFERENCE_S, 0)
    after = np.minimum(t_s + _DIFFERENCE_S, path.duration_s)
    rate = (_velocity(path, after) - _velocity(path, before)) / (after - before)[:, None]
    rotation = path.pose(t_s)[1]
    force = rate - np.array([0.0, GRAVITY_M_S2, 0.0])
    return np.einsum("nji,nj->ni", rotation, force), path.twist(t_s)[:, 3:]


def samples(path: CameraPath, stop_us: int, config: ImuConfig, seed: int, shift_us: int = 0) -> Iterator[Imu]:
    """The samples from the start of a path to a time, in batches; the same for the same seed.

    Args:
        path: of the camera.
        stop_us: end [us], not after that of the path.
        config: of the unit.
        seed: of the simulation.
        shift_us: added to all times, beside the offset of the unit.
    """
    accel_bias, gyro_bias = biases(config, seed)
    for number, start_us in enumerate(range(0, stop_us, BATCH_US)):
        end_us = min(start_us + BATCH_US, stop_us)
        first, stop = (int(np.ceil(t_us * config.rate_hz / 1e6)) for t_us in (start_us, end_us))
        t_us = np.arange(first, stop, dtype=np.float64) * (1e6 / config.rate_hz)
        if not t_us.size:
            continue
        rng = np.random.default_rng((seed, 12, shift_us, number))
        accel, gyro = exact(path, t_us / 1e6)
        accel = accel + accel_bias + rng.normal(0, config.accel_noise_m_s2, accel.shape)
        gyro = gyro + gyro_bias + rng.normal(0, config.gyro_noise_rad_s, gyro.shape)
        yield Imu(np.rint(t_us).astype(np.int64) + shift_us + config.offset_us, accel, gyro)


def _velocity(path: CameraPath, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Velocity in the world frame (N, 3) [m/s]."""
    return np.asarray(np.einsum("nij,nj->ni", path.pose(t_s)[1], path.twist(t_s)[:, :3]))
