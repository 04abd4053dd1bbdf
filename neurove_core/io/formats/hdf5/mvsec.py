"""Reader of MVSEC (Zhu 2018) in HDF5: FILE_data.hdf5 with events, images and IMU; FILE_gt.hdf5 with ground truth.

Layout of both davis/left and davis/right: `events` (N, 4) float64 of x, y, t [unix s] and p (-1 or 1); `image_raw`
(N, 260, 346) with `image_raw_ts` (N,) [s]; `imu` (N, 6) of accelerometer [m/s2], then gyroscope [rad/s], with `imu_ts`.

Sources: https://daniilidis-group.github.io/mvsec (download, data format), and the calibration files of the data set.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses
from neurove_core.io.checked import until_broken
from neurove_core.io.errors import BrokenRecording
from neurove_core.io.faults import Reason, Tally
from neurove_core.io.formats.hdf5.file import Column, dataset, has, opened, read_rows
from neurove_core.io.formats.hdf5.poses import mvsec_odometry
from neurove_core.io.formats.hdf5.tables import EventTable, ImuTable, TableRecording, chosen_topic
from neurove_core.io.recording import Frame
from neurove_protocol.camera import CameraInfo
from neurove_protocol.events import Sensor

DAVIS346: Final = Sensor(346, 260)
"""Sensor of both cameras."""

TOPICS: Final = ("davis/left", "davis/right")


def _lens(fx: float, fy: float, cx: float, cy: float, *distortion: float) -> CameraInfo:
    return CameraInfo(
        stream="recording",
        width=DAVIS346.width,
        height=DAVIS346.height,
        lens="equidistant",
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=distortion,
    )


LENS_INDOOR_FLYING: Final = {
    "davis/left": _lens(
        *(226.38018519795807, 226.15002947047415, 173.6470807871759, 133.73271487507847),
        *(-0.048031442223833355, 0.011330957517194437, -0.055378166304281135, 0.021500973881459395),
    ),
    "davis/right": _lens(
        *(226.0181418548734, 225.7869434267677, 174.5433576736815, 124.21627572590607),
        *(-0.04846669832871334, 0.010092844338123635, -0.04293073765014637, 0.005194706897326005),
    ),
}
"""Source: MVSEC, camchain-imucam-indoor_flying.yaml: intrinsics and distortion_coeffs of cam0 and cam1."""

LENS_OUTDOOR_DAY: Final = {
    "davis/left": _lens(
        *(223.9940010790056, 223.61783486959376, 170.7684322973841, 128.18711828338436),
        *(-0.033904378348448685, -0.01537260902537579, -0.022284741346941413, 0.0069204143687187645),
    ),
}
"""Source: MVSEC, camchain-imucam-outdoor_day.yaml, cam0, as quoted by public readers of the data set."""

CAMERA_FROM_IMU: Final = {
    "davis/left": (
        (0.9998771896957381, -0.015128404695721132, -0.004091075349566317),
        (0.015081690576531692, 0.9998233340761795, -0.011217987615716542),
        (0.004260062852482415, 0.011154909598696812, 0.99992871),
    ),
    "davis/right": (
        (0.9999459669775138, -0.002658051013083418, -0.010049770654903653),
        (0.002628365498611729, 0.9999921475216119, -0.0029659045702786734),
        (0.01005757526494452, 0.0029393298430320275, 0.9999451012529955),
    ),
}
"""Rotation of T_cam_imu: from the left camera's IMU to either camera. Source: camchain-imucam-indoor_flying.yaml."""

RIGHT_FROM_LEFT: Final = (
    (0.9999285439274112, 0.011088072985503046, -0.004467849222081981, -0.09988137641750752),
    (-0.011042817783611191, 0.9998887260774646, 0.01002953830336461, -0.0003927067773089277),
    (0.004578560319692358, -0.009979483987103495, 0.9999397215256256, 1.8880107752680777e-06),
)
"""T_cn_cnm1 of cam1: from the left camera's frame to the right camera's [m]. Source: as above."""


@dataclass(frozen=True, slots=True)
class MvsecRecording(TableRecording):
    """One camera of an MVSEC FILE_data.hdf5; see `Recording`. Times are unix time."""

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None, topic: str | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the FILE_data.hdf5.
            sensor: its pixel array; by default that of a DAVIS346.
            topic: `davis/left`, the default, or `davis/right`.

        Raises:
            UnknownSource: the file has no such camera. BrokenRecording: the file is truncated or corrupt.
            MissingExtra: h5py is not installed.
        """
        with opened(path) as file:
            topics = tuple(name for name in TOPICS if has(file, f"{name}/events"))
            topic = chosen_topic(path, topics, topic)
            optional = {"imu": "davis/left/imu", "frames": f"{topic}/image_raw"}
            held = ["events", *(stream for stream, name in optional.items() if has(file, name, f"{name}_ts"))]
        if truth_path(path).is_file():
            held += ["poses", "twists"]
        return cls(path, f"{path.name} ({topic})", sensor or DAVIS346, topic, tuple(held))

    def camera(self, stream: str) -> CameraInfo | None:
        """The equidistant lens of the sequence's calibration.

        Sequences other than outdoor_day use that of indoor_flying: the cameras are the same, and the two calibrations
        differ by 1 % in focal length and 6 px in the centre. None for another sensor size, and for the right camera of
        outdoor_day, because its calibration is not included here.
        """
        lenses = LENS_OUTDOOR_DAY if self.path.name.startswith("outdoor_day") else LENS_INDOOR_FLYING
        lens = lenses.get(self.topic)
        if lens is None or self.sensor != DAVIS346:
            return None
        return CameraInfo(**(lens.model_dump() | {"stream": stream}))

    def event_table(self, file: Any) -> EventTable:
        """The table `events` (N, 4); see the module."""
        name = f"{self.topic}/events"
        return EventTable(name, (dataset(self.path, file, name, 4),), _txyp, unit="s")

    def imu_table(self, file: Any) -> ImuTable | None:
        """The left camera's IMU for both cameras: only its mounting was calibrated."""
        name = "davis/left/imu"
        if not has(file, name, f"{name}_ts"):
            return None
        columns = (dataset(self.path, file, f"{name}_ts"), dataset(self.path, file, name, 6))
        return ImuTable(name, columns, _sample, np.array(CAMERA_FROM_IMU[self.topic]))

    def frames(self) -> Iterator[Frame]:
        """All images of this camera, ordered by time. An image that cannot be read, or is late, is skipped."""
        if "frames" in self.held:
            tally = self.faults.begin("frames")
            yield from until_broken(self._frames(tally), tally)

    def _frames(self, tally: Tally) -> Iterator[Frame]:
        name = f"{self.topic}/image_raw"
        with opened(self.path) as file:
            images = dataset(self.path, file, name, DAVIS346.height, DAVIS346.width)
            times = dataset(self.path, file, f"{name}_ts")
            if images.dtype != np.uint8:
                raise BrokenRecording(self.path, name, f"expected images of uint8, not {images.dtype}")
            last_s = -np.inf
            for i in range(min(images.shape[0], times.shape[0])):
                (image, t_s), why = read_rows((images, times), i, i + 1)
                if why:
                    tally.add(Reason.DAMAGED, f"row {i} of {name}", why)
                elif not (last_s <= t_s[0] < 1e12):
                    why = f"t={t_s[0]} s is not a valid time, or is before the previous t={last_s} s"
                    tally.add(Reason.LATE, f"row {i} of {name}", why)
                else:
                    last_s = float(t_s[0])
                    yield Frame(round(last_s * 1e6), np.asarray(image[0], np.uint8))

    def poses(self) -> Poses | None:
        """The odometry of FILE_gt.hdf5, at the lidar's 20 Hz; None without that file. Invalid rows are skipped.

        Raises:
            BrokenRecording: the file is truncated or corrupt.
        """
        truth = truth_path(self.path)
        if not truth.is_file():
            return None
        with opened(truth) as file:
            left = mvsec_odometry(truth, file, self.faults.begin("poses"))
        return left if self.topic == "davis/left" else _poses_of_right_camera(left)


def truth_path(path: Path) -> Path:
    """Path of the ground truth of a FILE_data.hdf5."""
    return path.with_name(f"{path.stem.removesuffix('_data')}_gt{path.suffix}")


def _txyp(rows: Column) -> tuple[Column, Column, Column, Column]:
    return rows[:, 2] * 1e6, rows[:, 0], rows[:, 1], rows[:, 3]


def _sample(t: Column, rows: Column) -> tuple[Column, Column, Column]:
    return t * 1e6, rows[:, :3], rows[:, 3:]


def _poses_of_right_camera(left: Poses) -> Poses:
    """Poses of the right camera, which is rigidly fixed to the left one."""
    rigid: NDArray[np.float64] = np.array(RIGHT_FROM_LEFT)
    to_left = rigid[:, :3].T  # from the right camera's axes to the left's
    offset_m = -to_left @ rigid[:, 3]
    rotated_m = rotations.turn(left.orientation, np.broadcast_to(offset_m, left.position_m.shape))
    q = np.broadcast_to(rotations.quaternion_of(to_left), left.orientation.shape)
    return Poses(left.t, left.position_m + rotated_m, rotations.product(left.orientation, q))
