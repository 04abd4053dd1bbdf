"""Reader of DSEC's events.h5 (Gehrig 2021). `dsec_write.py` writes any recording in this layout.

Layout: `events` with `p`, `x`, `y`, `t` [us], `ms_to_idx` (the first event at or after each millisecond of t) and
`t_offset` [us], which is added to t and may be missing. The file does not hold the sensor size: DSEC's is 640x480.
Other data sets use the layout too (TUM-VIE, at 1280x720).

`write_dsec` adds the following, which other readers of DSEC ignore: the attributes `width` and `height` [px] of
`events`; and, where the source has them, `imu` (`t`, `accel` (N, 3) [m/s2], `gyro` (N, 3) [rad/s]), `poses` (`t`,
`position` (N, 3) [m], `orientation` (N, 4) x y z w), `twists` (`t`, `twist` (N, 6) [m/s, rad/s]) and `camera` (the
lens, as attributes). All of these `t` [us] are on the sensor's clock: they already include t_offset.

Sources: https://dsec.ifi.uzh.ch/data-format, and uzh-rpg/DSEC, scripts/utils/eventslicer.py.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.errors import BrokenRecording
from neurove_core.io.formats.hdf5.file import Column, dataset, has, opened, value
from neurove_core.io.formats.hdf5.poses import stored_poses, table
from neurove_core.io.formats.hdf5.tables import EventTable, ImuTable, TableRecording, row_indexed
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

DSEC_SENSOR: Final = Sensor(640, 480)
"""The Prophesee Gen3.1 that recorded the data set."""

LENS_FIELDS: Final = ("width", "height", "lens", "fx", "fy", "cx", "cy", "distortion", "height_m")
"""Attributes of the group `camera`."""

_MAX_OFFSET_US: Final = 1 << 60


@dataclass(frozen=True, slots=True)
class DsecRecording(TableRecording):
    """An events.h5 of DSEC, or a file of `write_dsec`; see `Recording`."""

    offset_us: int = 0
    lens: CameraInfo | None = None
    assumed: bool = False  # neither the file nor the caller gives the sensor

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .h5 file.
            sensor: its pixel array; by default that of the file, or DSEC's if the file does not give it.

        Raises:
            BrokenRecording: the file is truncated or corrupt. MissingExtra: h5py is not installed.
        """
        with opened(path) as file:
            offset_us = _offset_us(path, file)
            stored = _attributes(path, file, "events")
            lens = _lens(path, _attributes(path, file, "camera")) if has(file, "camera") else None
            held = ["events", *(name for name in ("imu", "poses", "twists") if has(file, f"{name}/t"))]
        if "poses" in held and "twists" not in held:
            held.append("twists")
        try:
            sensor = sensor or (Sensor(int(stored["width"]), int(stored["height"])) if "width" in stored else None)
        except (KeyError, TypeError, ValueError, OverflowError, InvalidField) as error:
            raise BrokenRecording(path, "attributes of events", f"they are not a valid sensor: {error}") from None
        which, assumed = sensor or DSEC_SENSOR, sensor is None
        return cls(path, path.name, which, "events", tuple(held), offset_us=offset_us, lens=lens, assumed=assumed)

    def camera(self, stream: str) -> CameraInfo | None:
        """The lens that `write_dsec` stored, or None: DSEC's own files do not hold a calibration."""
        if self.lens is None or self.lens.sensor != self.sensor:
            return None
        return CameraInfo(**(self.lens.model_dump() | {"stream": stream}))

    def event_table(self, file: Any) -> EventTable:
        """The columns t, x, y, p."""
        columns = tuple(dataset(self.path, file, f"events/{name}") for name in "txyp")
        return EventTable("events", columns, _unchanged, self.offset_us)

    @property
    def sensor_note(self) -> str:
        """That the sensor is assumed, if it is."""
        note = ", which is DSEC's, because the file does not give its own: give --sensor WIDTHxHEIGHT"
        return note if self.assumed else ""

    def first_row(self, file: Any, table: EventTable, t_us: int) -> int:
        """As in `TableRecording`, found with the file's millisecond index."""
        if not has(file, "ms_to_idx"):
            return super(DsecRecording, self).first_row(file, table, t_us)
        return row_indexed(table, dataset(self.path, file, "ms_to_idx"), t_us)

    def imu_table(self, file: Any) -> ImuTable | None:
        """The group `imu`, in the frame that the source used."""
        if "imu" not in self.held:
            return None
        tails = {"t": (), "accel": (3,), "gyro": (3,)}
        columns = tuple(dataset(self.path, file, f"imu/{name}", *tail) for name, tail in tails.items())
        return ImuTable("imu", columns, _unchanged, np.eye(3))

    def poses(self) -> Poses | None:
        """The group `poses`, or None. Invalid rows are skipped.

        Raises:
            BrokenRecording: the file is truncated or corrupt.
        """
        if "poses" not in self.held:
            return None
        with opened(self.path) as file:
            return stored_poses(self.path, file, self.faults.begin("poses"))

    def twists(self) -> Twists | None:
        """The group `twists`; without that group, twists from the poses; None without both.

        Raises:
            BrokenRecording: the twists are not ordered by time or cannot be read; the error names the row.
        """
        with opened(self.path) as file:
            if not has(file, "twists/t"):
                return super(DsecRecording, self).twists()
            t, twist = table(self.path, file, ("twists/t", "twists/twist"), (), (6,))
        backwards = np.diff(t, prepend=t[:1]) < 0
        if t.dtype.kind not in "iu" or backwards.any():
            raise BrokenRecording(self.path, f"row {int(backwards.argmax())} of twists", "time runs backwards")
        return Twists(t.astype(np.int64), twist.astype(np.float64))


def _offset_us(path: Path, file: Any) -> int:
    if not has(file, "t_offset"):
        return 0
    offset = value(path, file, "t_offset")
    try:
        if np.size(offset) != 1 or not abs(int(offset)) < _MAX_OFFSET_US:
            raise ValueError(f"expected one number below {_MAX_OFFSET_US}, not {offset}")
        return int(offset)
    except (TypeError, ValueError, OverflowError) as error:
        raise BrokenRecording(path, "t_offset", str(error)) from None


def _attributes(path: Path, file: Any, name: str) -> dict[str, Any]:
    """The attributes of a group."""
    try:
        return dict(file[name].attrs)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise BrokenRecording(path, f"attributes of {name}", f"they cannot be read: {error}") from None


def _lens(path: Path, attributes: dict[str, Any]) -> CameraInfo:
    """The lens in the attributes that `write_dsec` wrote."""
    try:
        fields = {name: np.asarray(attributes[name]).tolist() for name in LENS_FIELDS if name in attributes}
        return CameraInfo(stream="recording", **fields)
    except (TypeError, ValueError, InvalidField) as error:  # pydantic's error is a ValueError
        raise BrokenRecording(path, "attributes of camera", f"they are not a valid lens: {error}") from None


def _unchanged(*columns: Column) -> Any:
    return columns
