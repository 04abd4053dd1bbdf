"""Event Stream files: the compiled decoder and its reference implementation, a real recording, broken files."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.io import UnknownSource
from neurove_core.io.formats.eventstream import ATIS, DVS, es_decode, es_reference
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from tests.builders import SENSOR, make_events
from tests.recordings import assert_same, put, read, read_broken, shared


def header(kind: int = DVS, version: bytes = b"\2\0\0", sensor: Sensor = SENSOR) -> bytes:
    return b"Event Stream" + version + bytes([kind]) + struct.pack("<HH", sensor.width, sensor.height)


def write(events: Events, kind: int = DVS, sensor: Sensor = SENSOR) -> list[bytes]:
    """The bytes of each event and of the overflows before it. In the file y counts upwards."""
    longest, shift = (127, 1) if kind == DVS else (63, 2)
    parts, last = [], 0
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        overflows, step = divmod(t - last, longest)
        last = t
        first = step << shift | (p if kind == DVS else p << 1)
        parts.append(bytes([0xFF if kind == DVS else 0xFD]) * overflows)
        parts[-1] += bytes([first]) + struct.pack("<HH", x, sensor.height - 1 - y)
    return parts


EVENTS = make_events(300, seed=1, duration_us=60_000)


def test_the_real_recording_gives_its_known_events():
    recording = open_source(str(shared("es/dvs.es")))
    assert recording.sensor == Sensor(320, 240)
    events = read(recording)
    assert (events.n, events.t[-1] - events.t[0]) == (473_225, 999_000)
    assert (events.x[0], events.y[0], events.p[0]) == (0, 0, 1)  # 239 in the file, whose y counts upwards


@pytest.mark.parametrize("kind", [DVS, ATIS])
def test_a_written_file_reads_back_identical(kind, tmp_path):
    data = header(kind) + b"".join(write(EVENTS, kind))
    assert_same(read(open_source(put(tmp_path, "a.es", data))), EVENTS)


@pytest.mark.parametrize("kind", [DVS, ATIS])
@given(data=st.lists(st.sampled_from([*range(4), 126, 127, 252, 253, 254, 255]), max_size=200), n_max=st.integers(1, 9))
def test_compiled_decoder_equals_its_reference_for_any_size_of_out(kind, data, n_max):
    array = np.array(data, np.uint8)
    t_us, read_, want = es_reference(array, 5, kind)
    state, parts = 5, [Events.empty()]
    while True:
        out = Events(*(np.zeros(n_max, column.dtype) for column in Events.empty()))
        state, done, n = es_decode(array, state, kind, out)
        parts.append(out.span(0, n))
        array = array[done:]
        if n < n_max:
            break
    assert_same(Events.join(parts), want)
    assert (state, len(data) - array.size) == (t_us, read_)


def test_exposure_measurements_are_skipped_and_advance_the_clock(tmp_path):
    data = header(ATIS) + bytes([5 << 2 | 1, 1, 0, 1, 0]) + bytes([6 << 2 | 2, 1, 0, 1, 0])
    got = read(open_source(put(tmp_path, "a.es", data)))
    assert_same(got, Events.from_columns([11], [1], [46], [1]))


def test_a_truncated_file_gives_its_complete_events_and_then_names_the_byte(tmp_path):
    parts = write(EVENTS)
    ends = np.cumsum([len(part) for part in parts])
    for size in (3, 100, 777):
        stream = b"".join(parts)[:size]
        events, error = read_broken(open_source(put(tmp_path, "a.es", header() + stream)))
        complete = int(np.searchsorted(ends, size, "right"))
        assert_same(events, EVENTS.span(0, complete))
        clock = len(stream[ends[complete - 1] if complete else 0 :]) - len(
            stream[ends[complete - 1] if complete else 0 :].lstrip(b"\xff")
        )
        reached = 20 + (int(ends[complete - 1]) if complete else 0) + clock
        if error is not None:
            assert error.details["where"] == f"byte {reached}"
        else:
            assert reached == 20 + size


def test_an_event_outside_the_sensor_is_skipped_and_its_place_is_its_number(tmp_path):
    good = b"".join(write(EVENTS))
    data = header() + good + bytes([0, 64, 0, 3, 0]) + bytes([1 << 1, 9, 0, 60, 0]) + bytes([1 << 1, 5, 0, 47, 0])
    events, error = read_broken(open_source(put(tmp_path, "a.es", data)))
    last = int(EVENTS.t[-1])
    assert_same(events, Events.join([EVENTS, Events.from_columns([last + 2], [5], [0], [0])]))
    assert error is not None
    assert error.details["where"] == f"event {EVENTS.n:,}"
    assert "x=64 y=44 lies outside" in error.message


@pytest.mark.parametrize(
    ("head", "why"),
    [
        (header(version=b"\1\0\0"), "it is Event Stream 1.0"),
        (header(kind=4), "type 4 .color."),
        (b"Event Horizon" + bytes(7), "does not begin"),
    ],
)
def test_other_versions_and_types_are_refused(head, why, tmp_path):
    with pytest.raises(UnknownSource, match=why):
        open_source(put(tmp_path, "a.es", head))
