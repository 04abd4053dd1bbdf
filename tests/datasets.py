"""Small HDF5 files in the layouts of MVSEC, DSEC and M3ED, for the tests of their readers."""

from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses
from neurove_core.io import Imu
from neurove_core.io.formats.hdf5.dsec_write import write_dsec
from neurove_core.sources import open_source
from neurove_protocol import Events
from tests.builders import SENSOR, make_events

DAY_US = 1_506_117_902_000_000
EVENTS = make_events(1000, seed=1, start_us=500_000, duration_us=1_000_000)
LATE = EVENTS._replace(t=EVENTS.t + DAY_US)
"""The same events in unix time, as in MVSEC and DSEC."""

CHUNK = 100  # rows per stored chunk: small, so that a corrupt byte destroys few


def make_poses(n: int = 30, *, seed: int = 0, start_us: int = 0, step_us: int = 50_000) -> Poses:
    """A smooth random trajectory from a seed."""
    rng = np.random.default_rng(seed)
    s = np.arange(n)[:, None] * step_us / 1e6
    size, rate, phase = rng.uniform(0.2, 1.0, 6), rng.uniform(0.5, 2.0, 6), rng.uniform(0, 6, 6)
    path = size * np.sin(rate * s + phase)
    return Poses(start_us + np.arange(n) * step_us, path[:, :3], rotations.exp(path[:, 3:]))


def make_imu(n: int = 40, *, seed: int = 0, start_us: int = 0, step_us: int = 1000) -> Imu:
    rng = np.random.default_rng(seed)
    return Imu(start_us + np.arange(n) * step_us, rng.normal(0, 9.8, (n, 3)), rng.normal(0, 1, (n, 3)))


def matrices(poses: Poses) -> NDArray[np.float64]:
    """Homogeneous (N, 4, 4) from camera to world."""
    out = np.tile(np.eye(4), (poses.t.size, 1, 1))
    out[:, :3, :3] = rotations.matrix_of(poses.orientation)
    out[:, :3, 3] = poses.position_m
    return out


def rigid(rotation_vector: tuple[float, float, float], offset_m: tuple[float, float, float]) -> NDArray[np.float64]:
    """A homogeneous matrix (4, 4)."""
    one = Poses(np.zeros(1, np.int64), np.array([offset_m]), rotations.exp(np.array([rotation_vector])))
    return matrices(one)[0]


def write_mvsec(
    folder: Path,
    events: Events,
    *,
    right: Events | None = None,
    imu: Imu | None = None,
    poses: Poses | None = None,
    images: NDArray[np.uint8] | None = None,
    name: str = "indoor_flying1",
    **storage: Any,
) -> str:
    """FILE_data.hdf5 and, with poses, FILE_gt.hdf5; event times are float seconds."""
    path = folder / f"{name}_data.hdf5"
    with h5py.File(path, "w") as file:
        for side, stream in (("left", events), ("right", right)):
            if stream is not None:
                rows = np.stack([stream.x, stream.y, stream.t / 1e6, stream.p * 2.0 - 1], axis=1)
                file.create_dataset(f"davis/{side}/events", data=rows, chunks=(min(CHUNK, stream.n), 4), **storage)
        if imu is not None:
            file["davis/left/imu"] = np.concatenate([imu.accel_m_s2, imu.gyro_rad_s], axis=1)
            file["davis/left/imu_ts"] = imu.t / 1e6
        if images is not None:
            file["davis/left/image_raw"] = images
            file["davis/left/image_raw_ts"] = np.arange(len(images)) / 40 + events.t[0] / 1e6
    if poses is not None:
        with h5py.File(folder / f"{name}_gt.hdf5", "w") as file:
            file["davis/left/odometry"] = matrices(poses)
            file["davis/left/odometry_ts"] = poses.t / 1e6
            file["davis/left/pose"] = np.tile(np.eye(4), (poses.t.size, 1, 1))  # must not be read
    return str(path)


def write_dsec_file(path: Path, events: Events, *, offset_us: int | None = None, index: bool = True) -> str:
    """An events.h5 as in DSEC: u4 times from 0 on, Blosc; offset_us None omits t_offset."""
    t = events.t - (offset_us or 0)
    with h5py.File(path, "w") as file:
        for name, column, dtype in (
            ("p", events.p, "u1"),
            ("x", events.x, "u2"),
            ("y", events.y, "u2"),
            ("t", t, "u4"),
        ):
            packing = hdf5plugin.Blosc(cname="zstd")
            file.create_dataset(f"events/{name}", data=column.astype(dtype), chunks=(CHUNK,), compression=packing)
        if offset_us is not None:
            file["t_offset"] = offset_us
        if index:
            file["ms_to_idx"] = np.searchsorted(t, np.arange(0, t[-1] // 1000 + 1) * 1000).astype("u8")
    return str(path)


def write_m3ed(
    folder: Path,
    events: Events,
    *,
    right: Events | None = None,
    imu: Imu | None = None,
    poses: Poses | None = None,
    mounts: dict[str, NDArray[np.float64]] | None = None,
    resolution: tuple[int, int] = (64, 48),
    name: str = "car_urban_day_horse",
) -> str:
    """FILE_data.h5 and, with poses, FILE_pose_gt.h5; `mounts` gives T_to_prophesee_left of `right` and `imu`."""
    mounts = mounts or {}
    path = folder / f"{name}_data.h5"
    with h5py.File(path, "w") as file:
        for side, stream in (("left", events), ("right", right)):
            if stream is None:
                continue
            for column, dtype in zip("txyp", ("i8", "u2", "u2", "i1"), strict=True):
                rows = getattr(stream, column).astype(dtype)
                file.create_dataset(
                    f"prophesee/{side}/{column}", data=rows, chunks=(min(CHUNK, stream.n),), compression="lzf"
                )
            grid_us = np.arange(stream.t[-1] // 1000) * 1000
            file[f"prophesee/{side}/ms_map_idx"] = np.searchsorted(stream.t, grid_us).astype("u8")
            calib = file.create_group(f"prophesee/{side}/calib")
            calib["camera_model"], calib["distortion_model"] = "pinhole", "radtan"
            calib["intrinsics"], calib["distortion_coeffs"] = [60.0, 61.0, 32.5, 24.5], [-0.1, 0.02, 0.001, -0.002]
            calib["resolution"] = resolution
            calib["T_to_prophesee_left"] = mounts.get(side, np.eye(4))
        if imu is not None:
            file["ovc/imu/ts"], file["ovc/imu/accel"], file["ovc/imu/omega"] = imu
            file["ovc/imu/calib/T_to_prophesee_left"] = mounts.get("imu", np.eye(4))
    if poses is not None:
        with h5py.File(folder / f"{name}_pose_gt.h5", "w") as file:
            file["Cn_T_C0"] = np.linalg.inv(matrices(poses))
            file["ts"] = poses.t.astype(np.float64)
    return str(path)


def mvsec_file(folder: Path) -> str:
    return write_mvsec(folder, LATE)


def dsec_file(folder: Path) -> str:
    return write_dsec_file(folder / "events.h5", LATE, offset_us=DAY_US)


def m3ed_file(folder: Path) -> str:
    return write_m3ed(folder, LATE._replace(t=EVENTS.t))


def own_file(folder: Path) -> str:
    write_dsec(open_source(mvsec_file(folder), SENSOR), folder / "own.h5")
    return str(folder / "own.h5")


def corrupt_chunk(path: Path, data: h5py.Dataset, number: int) -> None:
    """Overwrite a stored chunk with invalid bytes."""
    chunk = data.id.get_chunk_info(number)
    with path.open("r+b") as file:
        file.seek(chunk.byte_offset)
        file.write(b"\xff" * chunk.size)
