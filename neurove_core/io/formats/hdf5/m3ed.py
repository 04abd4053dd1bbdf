"""Reader of M3ED (Chaney 2023) in HDF5: FILE_data.h5 with events, IMU, calibration; FILE_pose_gt.h5 with ground truth.

Layout: prophesee/left and prophesee/right with `x` u2, `y` u2, `t` i8 [us], `p` i1, `ms_map_idx` (the first event at or
after each millisecond) and `calib`: `intrinsics` (fx fy cx cy), `distortion_coeffs`, `distortion_model`, `resolution`
(width, height), `T_to_prophesee_left`; ovc/imu with `accel` (N, 3) [m/s2], `omega` (N, 3) [rad/s], `ts` i8 [us] and
`calib/T_to_prophesee_left`. The images are from other cameras and are not read.

Source: daniilidis-group/m3ed, build_system/bag_processing/rosbag2hdf5.py.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses
from neurove_core.io.errors import BrokenRecording
from neurove_core.io.formats.hdf5.file import Column, dataset, has, opened, value
from neurove_core.io.formats.hdf5.poses import m3ed_poses
from neurove_core.io.formats.hdf5.tables import EventTable, ImuTable, TableRecording, chosen_topic, row_indexed
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

EVK4: Final = Sensor(1280, 720)
"""Sensor of both cameras, for a file without calibration."""

TOPICS: Final = ("prophesee/left", "prophesee/right")
_IMU: Final = ("ovc/imu/ts", "ovc/imu/accel", "ovc/imu/omega")
_TAILS: Final = ((), (3,), (3,))
_IMU_MOUNT: Final = "ovc/imu/calib/T_to_prophesee_left"
_LENS_OF_MODEL: Final[dict[str, Literal["pinhole", "equidistant"]]] = {
    "radtan": "pinhole",
    "equidistant": "equidistant",
}


@dataclass(frozen=True, slots=True)
class M3edRecording(TableRecording):
    """One camera of an M3ED FILE_data.h5; see `Recording`. Times are relative to the start of the recording."""

    lens: CameraInfo | None = None
    to_left: tuple[tuple[float, ...], ...] = ()  # 3x4, from this camera's frame to the left camera's [m]

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None, topic: str | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the FILE_data.h5.
            sensor: its pixel array; overrides that of the file.
            topic: `prophesee/left`, the default, or `prophesee/right`.

        Raises:
            UnknownSource: the file has no such camera. InvalidField: its calibration is invalid.
            BrokenRecording: the file is truncated or corrupt. MissingExtra: h5py is not installed.
        """
        with opened(path) as file:
            topics = tuple(name for name in TOPICS if has(file, *(f"{name}/{column}" for column in "txyp")))
            topic = chosen_topic(path, topics, topic)
            lens = read_lens(path, file, topic) if has(file, f"{topic}/calib/intrinsics") else None
            to_left = _transform(path, file, f"{topic}/calib/T_to_prophesee_left")
            held = ["events"]
            if _transform(path, file, _IMU_MOUNT) is not None and to_left is not None and has(file, *_IMU):
                held.append("imu")
        if to_left is not None and truth_path(path).is_file():
            held += ["poses", "twists"]
        sensor = sensor or (lens.sensor if lens else EVK4)
        transform = () if to_left is None else tuple(map(tuple, to_left.tolist()))
        return cls(path, f"{path.name} ({topic})", sensor, topic, tuple(held), lens=lens, to_left=transform)

    def camera(self, stream: str) -> CameraInfo | None:
        """The lens of the file's calibration; None without a calibration, or for another sensor size."""
        if self.lens is None or self.lens.sensor != self.sensor:
            return None
        return CameraInfo(**(self.lens.model_dump() | {"stream": stream}))

    def event_table(self, file: Any) -> EventTable:
        """The columns t, x, y, p."""
        columns = tuple(dataset(self.path, file, f"{self.topic}/{name}") for name in "txyp")
        return EventTable(self.topic, columns, _unchanged)

    def first_row(self, file: Any, table: EventTable, t_us: int) -> int:
        """As in `TableRecording`, found with the file's millisecond index."""
        name = f"{self.topic}/ms_map_idx"
        if not has(file, name):
            return super(M3edRecording, self).first_row(file, table, t_us)
        return row_indexed(table, dataset(self.path, file, name), t_us)

    def imu_table(self, file: Any) -> ImuTable | None:
        """The IMU of the OVC, 400 Hz. Samples that were never taken are nan in the file and are left out."""
        mount = _transform(self.path, file, _IMU_MOUNT)
        if "imu" not in self.held or mount is None:
            return None
        t, accel, omega = (dataset(self.path, file, name, *tail) for name, tail in zip(_IMU, _TAILS, strict=True))
        rotation = np.array(self.to_left)[:, :3].T @ mount[:, :3]
        return ImuTable("ovc/imu", (t, accel, omega), _unchanged, rotation, may_miss=True)

    def poses(self) -> Poses | None:
        """Poses of FILE_pose_gt.h5 at the lidar's 10 Hz, in the world of the left camera's first pose; or None.

        Invalid rows are skipped.

        Raises:
            BrokenRecording: the file is truncated or corrupt.
        """
        truth = truth_path(self.path)
        if "poses" not in self.held:
            return None
        with opened(truth) as file:
            left = m3ed_poses(truth, file, self.faults.begin("poses"))
        rigid = np.array(self.to_left)
        offset_m = rotations.turn(left.orientation, np.broadcast_to(rigid[:, 3], left.position_m.shape))
        q = np.broadcast_to(rotations.quaternion_of(rigid[:, :3]), left.orientation.shape)
        return Poses(left.t, left.position_m + offset_m, rotations.product(left.orientation, q))


def truth_path(path: Path) -> Path:
    """Path of the ground truth of a FILE_data.h5."""
    return path.with_name(f"{path.stem.removesuffix('_data')}_pose_gt{path.suffix}")


def read_lens(path: Path, file: Any, topic: str) -> CameraInfo:
    """The lens in a camera's `calib` group, in the format of Kalibr.

    Raises:
        BrokenRecording: the group cannot be read. InvalidField: the lens model is not supported or invalid.
    """
    names = ("intrinsics", "distortion_coeffs", "resolution", "distortion_model", "camera_model")
    intrinsics, distortion, resolution, model, camera = (value(path, file, f"{topic}/calib/{name}") for name in names)
    what = f"{path}: {topic}/calib"
    if camera != "pinhole" or model not in _LENS_OF_MODEL:
        raise InvalidField(what, "distortion_model", f"{camera}-{model}", "pinhole-radtan or pinhole-equidistant")
    try:
        fx, fy, cx, cy = map(float, intrinsics)
        width, height = map(int, resolution)
        return CameraInfo(
            stream="recording",
            width=width,
            height=height,
            lens=_LENS_OF_MODEL[model],
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            distortion=tuple(map(float, distortion)),
        )
    except (TypeError, ValueError, OverflowError, InvalidField) as error:
        got = f"{intrinsics}, {distortion}, {resolution}"
        raise InvalidField(
            what, "intrinsics", got, f"expected fx fy cx cy, four coefficients and a size: {error}"
        ) from None


def _transform(path: Path, file: Any, name: str) -> NDArray[np.float64] | None:
    """The upper rows (3, 4) of a rigid transform, or None if the file does not have this name.

    Raises:
        BrokenRecording: the value is not a rigid transform.
    """
    if not has(file, name):
        return None
    try:
        matrix = np.asarray(value(path, file, name), np.float64)
    except (TypeError, ValueError):  # for example a text
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-2):
        raise BrokenRecording(path, name, "expected a rigid transform of shape (4, 4)")
    return matrix[:3]


def _unchanged(*columns: Column) -> Any:
    return columns
