"""Recordings for tests: real recordings, if they are available, and small generated ones."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from neurove_core.io import BrokenRecording, Imu, Recording, Triggers
from neurove_core.io.recording import CHUNK_EVENTS
from neurove_protocol import Events, Sensor
from neurove_protocol.events import check_events

SHARED = Path(__file__).resolve().parents[1].parent / "shared/data"


def shared(path: str) -> Path:
    """Return a real recording from shared/data, or skip the test if it is missing."""
    if not (SHARED / path).exists():
        pytest.skip(f"the recording shared/data/{path} is not available")
    return SHARED / path


def put(folder: Path, name: str, data: bytes) -> str:
    """Write a file and return its path as a source."""
    (folder / name).write_bytes(data)
    return str(folder / name)


def read(recording: Recording) -> Events:
    """Return all events of a recording, and check the guarantees for its chunks."""
    last_us, parts = None, []
    for chunk in recording.chunks():
        assert 0 < chunk.n <= CHUNK_EVENTS
        assert [column.dtype for column in chunk] == [np.int64, np.uint16, np.uint16, np.uint8]
        assert chunk.p.max() <= 1
        check_events(chunk, recording.sensor, last_us)
        last_us = int(chunk.t[-1])
        parts.append(chunk)
    return Events.join(parts)


def read_broken(recording: Recording) -> tuple[Events, BrokenRecording | None]:
    """Return the valid events and the first fault of the events as an error, or None."""
    parts = []
    try:
        for chunk in recording.chunks():
            parts.append(chunk)  # noqa: PERF402  # keeps the chunks before the error
    except BrokenRecording as error:
        return Events.join(parts), error
    found = [fault for fault in recording.faults.found if fault.stream == "events"]
    return Events.join(parts), BrokenRecording(Path(recording.name), found[0].where, found[0].why) if found else None


def all_samples(recording: Recording) -> Imu:
    return Imu(*(np.concatenate(columns) for columns in zip(*recording.imu(), strict=True)))


def all_triggers(recording: Recording) -> Triggers:
    return Triggers(*(np.concatenate(columns) for columns in zip(*recording.triggers(), strict=True)))


def assert_same(got: Events, want: Events) -> None:
    for name, a, b in zip("txyp", got, want, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)
        assert a.dtype == b.dtype


def ecd_text(events: Events) -> bytes:
    """Return lines `t[s] x y p` with nine decimals, as in the Event Camera Dataset."""
    rows = zip(*(column.tolist() for column in events), strict=True)
    return "".join(f"{t // 1_000_000}.{t % 1_000_000:06d}000 {x} {y} {p}\n" for t, x, y, p in rows).encode()


class Aedat4(NamedTuple):
    data: bytes
    starts: list[int]  # offset of each event packet [bytes]
    stops: list[int]  # end of each event packet [bytes]
    end: int  # end of the last packet of any stream [bytes]


def aedat4(packets: Sequence[Events], sensor: Sensor, *, finished: bool = True) -> Aedat4:
    """Return an uncompressed .aedat4 file with a packet of triggers after each packet of events.

    The header of a finished file gives the end of the packets, and a table follows them. The file of a killed recorder
    has neither.
    """
    streams = _stream(0, "EVTS", sensor) + _stream(1, "TRIG")
    xml = f'<dv version="2.0"><node name="outInfo" path="/o/">{streams}</node></dv>'.encode()
    at = start = 14 + 4 + 40 + 4 + len(xml) + 1
    body, starts, stops = b"", [], []
    for packet in packets:
        events, triggers = _packet(0, b"EVTS", _rows(packet)), _packet(1, b"TRIG", struct.pack("<qB7x", 0, 1))
        body += events + triggers
        starts.append(at)
        stops.append(at + len(events))
        at += len(events) + len(triggers)
    # a hand-written flatbuffer: root, identifier, table of offsets, table, string
    table = struct.pack("<iiqI", 12, 0, at if finished else -1, 4)
    header = struct.pack("<I4sHHHHHxx", 20, b"IOHE", 10, 20, 4, 8, 16) + table + struct.pack("<I", len(xml)) + xml
    data = b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(header) + 1) + header + b"\0"
    assert len(data) == start
    return Aedat4(data + body + (b"a table of packets, unread" if finished else b""), starts, stops, at)


def _stream(number: int, kind: str, sensor: Sensor | None = None) -> str:
    size = (
        f'<attr key="sizeX" type="int">{sensor.width}</attr><attr key="sizeY" type="int">{sensor.height}</attr>'
        if sensor
        else ""
    )
    return (
        f'<node name="{number}" path="/o/{number}/"><attr key="typeIdentifier" type="string">{kind}</attr>'
        f'<node name="info" path="/o/{number}/info/">{size}</node></node>'
    )


def _rows(events: Events) -> bytes:
    rows = np.zeros(events.n, np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("_", "V3")]))
    for name in ("t", "x", "y", "p"):
        rows[name] = getattr(events, name)
    return rows.tobytes()


def _packet(stream: int, identifier: bytes, rows: bytes) -> bytes:
    buffer = struct.pack("<I4sHHHxxiI", 16, identifier, 6, 8, 4, 8, 4) + struct.pack("<I", len(rows) // 16) + rows
    return struct.pack("<iiI", stream, len(buffer) + 4, len(buffer)) + buffer
