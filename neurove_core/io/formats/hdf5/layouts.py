"""Readers of HDF5 layouts that hold little besides events: Prophesee, v2e, EDS and `events/xs`.

- Prophesee (Metavision SDK): `CD/events`, records of `x` u2, `y` u2, `p` i2, `t` i8 [us]; `EXT_TRIGGER/events`, records
  of `p` i2, `t` i8 [us], `id` i2; the attribute `geometry` of the file, a text such as 1280x720. The SDK compresses the
  events with ECF, HDF5 filter 36559 (0x8ECF), which hdf5plugin does not have: see `MissingFilter`.
  Sources: https://docs.prophesee.ai/stable/data/file_formats/hdf5.html, https://github.com/prophesee-ai/hdf5_ecf and
  hdf5_event_file_writer.cpp of OpenEB.
- v2e: `events` (N, 4) u4, the columns t [us], x, y, p. Source: https://github.com/SensorsINI/v2e, option --dvs_h5.
- EDS: `x`, `y`, `t` [us], `p` in the root, from a Prophesee Gen3.1. Source: https://rpg.ifi.uzh.ch/eds.html.
- `events/xs`: `events/xs`, `ys`, `ts`, `ps`, or `events/x`, `y`, `ts`, `p` in older files; the attribute
  `sensor_resolution` of the file. Some writers store it as height, width and others as width, height: the larger number
  is read as the width. `ts` is in seconds if it is a float, otherwise in us.
  Source: https://github.com/TimoStoff/event_cnn_minimal and https://github.com/TimoStoff/events_contrast_maximization,
  tools/event_packagers.py.

Where a file does not give its sensor and the data set has no sensor of its own, the caller must give it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from neurove_core.io.checked import ordered
from neurove_core.io.errors import BrokenRecording, MissingGeometry
from neurove_core.io.faults import Tally
from neurove_core.io.formats.hdf5.file import FAULTS, Column, dataset, has, opened, records
from neurove_core.io.formats.hdf5.tables import EventTable, TableRecording, row_blocks
from neurove_core.io.order import Where
from neurove_core.io.recording import CHUNK_EVENTS, Triggers
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

EDS_SENSOR: Final = Sensor(640, 480)
"""The Prophesee Gen3.1 that recorded EDS."""

CD, EXT_TRIGGER = "CD/events", "EXT_TRIGGER/events"
LAYOUTS: Final = {
    "prophesee": (CD,),
    "xs": ("events/xs", "events/ys", "events/ts", "events/ps"),
    "old xs": ("events/x", "events/y", "events/ts", "events/p"),
    "eds": ("x", "y", "t", "p"),
}
"""The data sets that identify a layout. v2e has none of these: `events` itself is its data set."""

V2E: Final = "v2e"
_SENSOR_ATTRIBUTE: Final = {"prophesee": "geometry", "xs": "sensor_resolution", "old xs": "sensor_resolution"}


def layout_of(file: Any) -> str | None:
    """The layout of an opened file, or None if it has none of these."""
    for layout, names in LAYOUTS.items():
        if has(file, *names):
            return layout
    try:
        return V2E if len(file["events"].shape) == 2 else None
    except (*FAULTS, AttributeError):  # no `events`, or a group
        return None


@dataclass(frozen=True, slots=True)
class PlainRecording(TableRecording):
    """Events, and triggers of a Prophesee file; see `Recording`."""

    layout: str = V2E
    assumed: bool = False  # neither the file nor the caller gives the sensor

    @classmethod
    def open(cls, path: Path, layout: str, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .h5 or .hdf5 file.
            layout: its layout, see `layout_of`.
            sensor: its pixel array; overrides that of the file.

        Raises:
            MissingGeometry: neither the file nor the caller gives the sensor. MissingFilter: HDF5 lacks a filter that
                the events need. BrokenRecording: the file is corrupt. MissingExtra: h5py is not installed.
        """
        with opened(path) as file:
            known = sensor or _sensor(path, file, layout)
            held = ("events", "triggers") if layout == "prophesee" and has(file, EXT_TRIGGER) else ("events",)
            _event_table(path, file, layout)
        if known is None and layout != "eds":
            raise MissingGeometry(path)
        name = LAYOUTS.get(layout, ("events",))[0].rpartition("/")[0] or "events"
        return cls(path, path.name, known or EDS_SENSOR, name, held, layout=layout, assumed=known is None)

    def event_table(self, file: Any) -> EventTable:
        """The table of the events."""
        return _event_table(self.path, file, self.layout)

    @property
    def sensor_note(self) -> str:
        """That the sensor is assumed, if it is."""
        note = ", which is EDS's, because the file does not give its own: give --sensor WIDTHxHEIGHT"
        return note if self.assumed else ""

    def triggers(self) -> Iterator[Triggers]:
        """The edges on the trigger inputs of a Prophesee file; see `Recording`."""
        if "triggers" in self.held:
            tally = self.faults.begin("triggers")
            yield from ordered(self._edges(tally), tally)

    def _edges(self, tally: Tally) -> Iterator[tuple[Where, Triggers]]:
        with opened(self.path) as file:
            table = records(self.path, file, EXT_TRIGGER, ("p", "t", "id"))
            for at, (rows,) in row_blocks(self.path, EXT_TRIGGER, (table,), tally, CHUNK_EVENTS):
                channel, level = (rows["id"] & 0xFF).astype(np.uint8), (rows["p"] > 0).astype(np.uint8)
                yield _row_of(at, EXT_TRIGGER), Triggers(rows["t"].astype(np.int64), channel, level)


def _row_of(first: int, name: str) -> Where:
    return lambda i: f"row {first + i} of {name}"


def _event_table(path: Path, file: Any, layout: str) -> EventTable:
    if layout == "prophesee":
        return EventTable(CD, (records(path, file, CD, tuple("txyp")),), _of_records)
    if layout == V2E:
        return EventTable("events", (dataset(path, file, "events", 4),), _of_matrix)
    x, y, t, p = (dataset(path, file, name) for name in LAYOUTS[layout])
    seconds = layout != "eds" and t.dtype.kind == "f"
    return EventTable(t.name, (t, x, y, p), _in_seconds if seconds else _unchanged, unit="s" if seconds else "us")


def _sensor(path: Path, file: Any, layout: str) -> Sensor | None:
    """The sensor that the attributes of the file give, or None."""
    name = _SENSOR_ATTRIBUTE.get(layout)
    try:
        if name is None or name not in file.attrs:
            return None
        value = file.attrs[name]
        if name == "geometry":
            text = value.decode() if isinstance(value, bytes) else str(value)
            width, height = (int(number) for number in text.split("x"))
        else:
            height, width = sorted(int(number) for number in np.asarray(value).ravel()[:2])
        return Sensor(width, height)
    except (*FAULTS, InvalidField) as error:
        raise BrokenRecording(path, f"attribute {name}", f"it is not a valid sensor: {error}") from None


def _of_records(rows: Column) -> tuple[Column, Column, Column, Column]:
    return rows["t"], rows["x"], rows["y"], rows["p"]


def _of_matrix(rows: Column) -> tuple[Column, Column, Column, Column]:
    return rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3]


def _in_seconds(t: Column, *others: Column) -> Any:
    return (t.astype(np.float64) * 1e6, *others)


def _unchanged(*columns: Column) -> Any:
    return columns
