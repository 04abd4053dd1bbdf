"""Reader and writer of recordings of CARLA's sensor.camera.dvs, in a container of this project.

The container is a .npz of `events` (N,) of RECORD, `width`, `height` and `fov_deg`. If poses were recorded, it also has
`pose_t_ns` (M,), `location` (M, 3) [m] and `rotation_deg` (M, 3) roll, pitch, yaw of the camera. All values are in
CARLA's convention. `carla_server.py` records one from a running server.
"""

import math
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.files import atomic_path, write_errors
from neurove_core.geometry.motion import Poses, Twists, twists
from neurove_core.io.archive import BROKEN_ZIP, member
from neurove_core.io.checked import Piece, cleaned, numbered
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Faults
from neurove_core.io.format import Format
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, refuse_topic
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor

RECORD: Final = np.dtype([("x", "<u2"), ("y", "<u2"), ("t", "<i8"), ("pol", "u1")])
"""One event as CARLA packs it, 13 bytes: x and y [px], t simulated time [ns], pol 1 or 0."""

_TO_OPTICAL = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]])  # columns: right, down, forward in CARLA's x y z
_MIRROR = np.diag([1.0, -1.0, 1.0])  # CARLA's world is left-handed; here y points left instead


class CarlaPoses(NamedTuple):
    """Poses of a CARLA camera in its left-handed world: x forward, y right, z up."""

    t_ns: NDArray[np.int64]  # (N,) simulated time
    location: NDArray[np.float64]  # (N, 3) [m]
    rotation_deg: NDArray[np.float64]  # (N, 3) roll, pitch, yaw [deg]


def to_optical(poses: CarlaPoses) -> Poses:
    """Convert to poses of the camera's optical frame in a right-handed world (x forward, y left, z up).

    Turns right (yaw), up (pitch) and clockwise (roll) are positive in CARLA. They become positive rates about the
    optical y, x and z: the mirror of the world and that of the axes cancel.
    """
    rotation = _MIRROR @ _matrices(poses.rotation_deg) @ _TO_OPTICAL
    return Poses(poses.t_ns // 1000, poses.location @ _MIRROR, _quaternions(rotation))


def _matrices(rotation_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3, 3) matrices whose columns are the forward, right and up axes in CARLA's world.

    Source: CARLA, LibCarla/source/carla/geom/Transform.h, GetMatrix.
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.radians(rotation_deg)).T, np.sin(np.radians(rotation_deg)).T
    rows = [
        [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr],
        [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr],
        [sp, -cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _quaternions(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4) unit quaternions x y z w of rotation matrices (N, 3, 3), by the largest eigenvector of Bar-Itzhack's K."""
    m = rotation
    k = np.zeros((len(m), 4, 4))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        k[:, i, j] = k[:, j, i] = m[:, i, j] + m[:, j, i]
    for i in range(3):
        k[:, i, i] = 2 * m[:, i, i] - m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2]
        a, b = (i + 1) % 3, (i + 2) % 3
        k[:, i, 3] = k[:, 3, i] = m[:, b, a] - m[:, a, b]
    k[:, 3, 3] = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    vectors: NDArray[np.float64] = np.linalg.eigh(k)[1][:, :, -1]
    return vectors * np.where(vectors[:, 3:] < 0, -1, 1)


@dataclass(frozen=True, slots=True)
class CarlaRecording(EventsOnly):
    """A .npz of CARLA events; see the module and `Recording`."""

    path: Path
    sensor: Sensor
    fov_deg: float
    streams: tuple[str, ...]
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .npz file; objects in it are never unpickled.
            sensor: its pixel array; overrides that of the file.

        Raises:
            UnknownSource: it is not a .npz file, or not one of this container.
        """
        try:
            with zipfile.ZipFile(path) as archive:
                names = {name.removesuffix(".npy") for name in archive.namelist()}
            missing = {"events", "width", "height", "fov_deg"} - names
            if missing:
                raise UnknownSource(path, f"it lacks {', '.join(sorted(missing))}")
            width, height, fov_deg = (_array(path, name, ()).item() for name in ("width", "height", "fov_deg"))
            own = Sensor(int(width), int(height))
        except (*BROKEN_ZIP, BrokenRecording, InvalidField) as error:
            raise UnknownSource(path, f"it is not a recording of CARLA: {error}") from None
        if not 0 < fov_deg < 180:
            raise UnknownSource(path, f"fov_deg={fov_deg} must lie between 0 and 180")
        posed = {"pose_t_ns", "location", "rotation_deg"} <= names
        return cls(path, sensor or own, float(fov_deg), ("events", "poses") if posed else ("events",))

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    def camera(self, stream: str) -> CameraInfo | None:
        """An ideal pinhole with the recorded horizontal field of view."""
        width, height = self.sensor.width, self.sensor.height
        f = width / 2 / math.tan(math.radians(self.fov_deg) / 2)
        cx, cy = (width - 1) / 2, (height - 1) / 2
        return CameraInfo(stream=stream, width=width, height=height, lens="pinhole", fx=f, fy=f, cx=cx, cy=cy)

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Simulated time, rounded down to whole us."""
        return cleaned(self._pieces(), self.sensor, self.faults.begin("events"))

    def _pieces(self) -> Iterator[Piece]:
        n = 0
        with _member(self.path, "events") as (file, shape, dtype):
            if len(shape) != 1 or dtype.itemsize != RECORD.itemsize:
                raise BrokenRecording(self.path, "events", f"{dtype} {shape} are not events of {RECORD.itemsize} bytes")
            while n < shape[0]:
                block = file.read(min(BLOCK_BYTES // RECORD.itemsize, shape[0] - n) * RECORD.itemsize)
                records = np.frombuffer(block, RECORD, len(block) // RECORD.itemsize)
                events = Events.from_columns(records["t"] // 1000, records["x"], records["y"], records["pol"] > 0)
                yield numbered(n), events
                n += events.n
                if not events.n or len(block) % RECORD.itemsize:
                    raise BrokenRecording(
                        self.path, f"event {n}", f"there are fewer events than the {shape[0]} in the header"
                    )

    def poses(self) -> Poses | None:
        """Poses of the optical frame, see `to_optical`; None if they were not recorded.

        Raises:
            BrokenRecording: the arrays of the poses differ in length or are not finite, or time runs backwards.
        """
        if "poses" not in self.streams:
            return None
        t_ns = _array(self.path, "pose_t_ns", (None,)).astype(np.int64)
        location = _array(self.path, "location", (t_ns.size, 3)).astype(np.float64)
        rotation = _array(self.path, "rotation_deg", (t_ns.size, 3)).astype(np.float64)
        if (np.diff(t_ns) < 0).any() or not (np.isfinite(location).all() and np.isfinite(rotation).all()):
            raise BrokenRecording(self.path, "pose_t_ns", "a pose is not finite, or time runs backwards")
        return to_optical(CarlaPoses(t_ns, location, rotation))

    def twists(self) -> Twists | None:
        """Twists of the camera from its poses, by `geometry.twists`; None without poses."""
        poses = self.poses()
        return twists(poses) if poses is not None and poses.t.size > 1 else None


@contextmanager
def _member(path: Path, name: str) -> Iterator[tuple[IO[bytes], tuple[int, ...], np.dtype[Any]]]:
    """An array in a .npz for reading in parts: its open file after the header, its shape and its type.

    Raises:
        BrokenRecording: the header or, during reading, the compressed data is truncated or corrupt.
    """
    try:
        with member(path, f"{name}.npy") as file:
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = header(file)
            if dtype.hasobject:
                raise ValueError("objects are not read")
            yield file, shape, dtype
    except (*BROKEN_ZIP, KeyError, SyntaxError) as error:
        raise BrokenRecording(path, name, f"it cannot be read: {error}") from None


def _array(path: Path, name: str, want: tuple[int | None, ...]) -> NDArray[Any]:
    """A small array of numbers from a .npz, of this shape; None matches any length."""
    with _member(path, name) as (file, shape, dtype):
        fits = len(shape) == len(want) and all(b is None or a == b for a, b in zip(shape, want, strict=True))
        size = math.prod(shape) * dtype.itemsize
        if not fits or dtype.kind not in "iuf" or size > 1 << 30:
            raise BrokenRecording(path, name, f"expected numbers {want}, not {dtype} {shape}")
        return np.frombuffer(file.read(size), dtype).reshape(shape)


def write(
    path: Path,
    events: Iterable[NDArray[np.void]],
    sensor: Sensor,
    fov_deg: float,
    poses: Callable[[], CarlaPoses] | None = None,
) -> int:
    """Write a recording atomically.

    Args:
        path: the .npz to write.
        events: arrays of RECORD, ordered by time.
        sensor: the camera's pixel array.
        fov_deg: its horizontal field of view.
        poses: gives the poses of the camera, if known; called after the last event.

    Returns:
        The number of events written.
    """
    raw = path.with_name(path.name + ".events")
    try:
        with write_errors(path, raw), raw.open("wb") as file:
            n = sum(file.write(np.ascontiguousarray(part, RECORD).tobytes()) for part in events) // RECORD.itemsize
        small: dict[str, Any] = {
            "width": np.int64(sensor.width),
            "height": np.int64(sensor.height),
            "fov_deg": np.float64(fov_deg),
        }
        if poses is not None:
            names = ("pose_t_ns", "location", "rotation_deg")
            small |= dict(zip(names, poses(), strict=True))
        with atomic_path(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, value in small.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asanyarray(value), allow_pickle=False)
            with archive.open("events.npy", "w", force_zip64=True) as member, raw.open("rb") as file:
                header = {"descr": RECORD.descr, "fortran_order": False, "shape": (n,)}
                np.lib.format.write_array_header_1_0(member, header)
                while block := file.read(BLOCK_BYTES):
                    member.write(block)
    finally:
        raw.unlink(missing_ok=True)
    return n


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> CarlaRecording:
    refuse_topic(path, topic)
    return CarlaRecording.open(path, sensor)


FORMAT = Format("FILE.npz (event camera of CARLA)", _open, (".npz",))
