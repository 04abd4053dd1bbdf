"""AEDAT 3.1: packets of every kind, several sources, and files that are damaged or truncated."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurove_core.io import BrokenRecording, MissingGeometry, RecordingError, UnknownSource
from neurove_core.io.formats.aedat.aedat3 import MAX_PACKET_BYTES
from neurove_core.io.recording import BLOCK_BYTES
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from tests.builders import SENSOR, make_events
from tests.recordings import all_samples, all_triggers, assert_same, put, read, read_broken

HEADER = (
    b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: %s\r\n#-Source 0: DVS128\r\n"
    b"#Start-Time: 2017-03-01 12:00:00 (TZ+0100)\r\n#!END-HEADER\r\n"
)
DAVIS240 = HEADER % b"DAVIS240C"
EVENTS = make_events(600, seed=3, start_us=(1 << 31) - 50_000)


def packet(
    kind: int, items: bytes, size: int, *, source: int = 1, overflow: int = 0, number: int | None = None
) -> bytes:
    number = len(items) // size if number is None else number
    return struct.pack("<hhiiiiii", kind, source, size, 4, overflow, number, number, number) + items


def polarity(events: Events, *, source: int = 1, invalid: int = 0) -> bytes:
    """Packets of up to 100 events. Every `invalid`-th event is followed by one that is marked as not valid."""
    found = b""
    for overflow in np.unique(events.t >> 31).tolist():
        index = np.flatnonzero(events.t >> 31 == overflow)
        for first in range(0, index.size, 100):
            items = b""
            for i in index[first : first + 100].tolist():
                word = int(events.x[i]) << 17 | int(events.y[i]) << 2 | int(events.p[i]) << 1
                item = struct.pack("<Ii", word | 1, int(events.t[i]) & 0x7FFF_FFFF)
                items += item + (struct.pack("<I", word) + item[4:] if invalid and i % invalid == 0 else b"")
            found += packet(1, items, 8, source=source, overflow=overflow)
    return found


def special(*rows: tuple[int, int]) -> bytes:
    """One packet of (type, time) pairs."""
    return packet(0, b"".join(struct.pack("<Ii", kind << 1 | 1, t) for kind, t in rows), 8)


def imu(t: int, accel: tuple[float, ...], gyro: tuple[float, ...]) -> bytes:
    return packet(3, struct.pack("<Ii7f", 1, t, *accel, *gyro, 25.0), 36)


@pytest.mark.parametrize("invalid", [0, 7])
def test_a_written_file_reads_back_identical_across_the_overflow_of_its_times(invalid, tmp_path):
    recording = open_source(put(tmp_path, "a.aedat", DAVIS240 + polarity(EVENTS, invalid=invalid)))
    assert (recording.sensor, recording.streams) == (Sensor(240, 180), ("events", "imu", "triggers"))
    assert EVENTS.t[-1] > 1 << 31
    for _ in range(2):
        assert_same(read(recording), EVENTS)
    assert recording.faults.found == ()
    assert_same(Events.join(list(recording.since(int(EVENTS.t[300])))), EVENTS.span(300, 600))


@pytest.mark.parametrize(
    ("camera", "sensor"),
    [
        (b"DVS128", Sensor(128, 128)),
        (b"DAVIS346Cbsi", Sensor(346, 260)),
        (b"DAVISHet640", Sensor(640, 480)),
        (b"DVXplorer Lite", Sensor(320, 240)),
    ],
)
def test_the_camera_in_the_header_gives_the_sensor(camera, sensor, tmp_path):
    path = put(tmp_path, "a.aedat", HEADER % camera)
    assert open_source(path).sensor == sensor
    assert open_source(path, SENSOR).sensor == SENSOR


def test_an_unknown_camera_needs_a_sensor(tmp_path):
    path = put(tmp_path, "a.aedat", HEADER % b"DYNAPSE")
    with pytest.raises(MissingGeometry, match="--sensor"):
        open_source(path)
    assert open_source(path, SENSOR).sensor == SENSOR


@pytest.mark.parametrize(
    ("header", "why"),
    [
        (b"#!AER-DAT3.0\r\n#!END-HEADER\r\n", "it is AEDAT 3.0; the supported versions are 2.0, 3.1 and 4.0"),
        (b"#!AER-DAT3.1\r\n#Format: SerializedTS\r\n#!END-HEADER\r\n", "is SerializedTS; the supported format is RAW"),
    ],
)
def test_another_version_or_format_is_named(header, why, tmp_path):
    with pytest.raises(UnknownSource, match=why):
        open_source(put(tmp_path, "a.aedat", header))


def test_a_header_without_end_is_broken(tmp_path):
    with pytest.raises(BrokenRecording, match="byte 28: the header has no line #!END-HEADER"):
        open_source(put(tmp_path, "a.aedat", b"#!AER-DAT3.1\r\n#Format: RAW\r\n" + bytes(50)))


def test_each_of_several_sources_can_be_chosen(tmp_path):
    other = make_events(50, seed=9, start_us=EVENTS.t[0])
    header = HEADER.replace(b"#-Source 0", b"#Source 4") % b"DAVIS240C"
    data = header + b"".join(
        polarity(EVENTS.span(i, i + 100)) + polarity(other.span(i // 12, min(i // 12 + 9, 50)), source=4)
        for i in range(0, 600, 100)
    )
    path = put(tmp_path, "a.aedat", data)
    first, second = open_source(path), open_source(path, topic="4")
    assert (first.name, second.name) == ("a.aedat (source 1 of 2: DAVIS240C)", "a.aedat (source 4 of 2: DVS128)")
    assert (first.sensor, second.sensor) == (Sensor(240, 180), Sensor(128, 128))
    assert_same(read(first), EVENTS)
    assert read(second).n > 0
    with pytest.raises(UnknownSource, match=r"no source '7'; its sources are 1 \(DAVIS240C\), 4 \(DVS128\)"):
        open_source(path, topic="7")


def test_samples_are_in_si_units_and_special_events_are_triggers(tmp_path):
    body = special((1, 5), (2, 10), (3, 12)) + imu(20, (0, -1, 0), (180, 0, -90)) + polarity(EVENTS)
    body += special((12, 30), (17, 40), (7, 50)) + imu(60, (1, 0, 0), (0, 0, 0))
    recording = open_source(put(tmp_path, "a.aedat", DAVIS240 + body))
    samples = all_samples(recording)
    assert samples.t.tolist() == [20, 60]
    np.testing.assert_allclose(samples.accel_m_s2, [[0, -9.80665, 0], [-9.80665, 0, 0]])
    np.testing.assert_allclose(samples.gyro_rad_s, [[-np.pi, 0, np.pi / 2], [0, 0, 0]])
    triggers = all_triggers(recording)
    assert [column.tolist() for column in triggers] == [[10, 12, 30, 40, 50], [0, 0, 1, 3, 4], [1, 0, 1, 0, 0]]
    assert_same(read(recording), EVENTS)


def test_invalid_samples_and_negative_times_are_counted(tmp_path):
    bad = packet(1, struct.pack("<Ii", 1, -5), 8)
    body = imu(20, (0, 0, 0), (0, 0, 0)) + imu(21, (float("nan"), 0, 0), (0, 0, 0)) + bad + polarity(EVENTS)
    recording = open_source(put(tmp_path, "a.aedat", DAVIS240 + body))
    assert all_samples(recording).t.tolist() == [20]
    assert_same(read(recording), EVENTS)
    assert {(one.stream, one.reason, one.count) for one in recording.faults.found} == {
        ("imu", "invalid", 1),
        ("events", "invalid", 1),
    }


def test_an_event_outside_the_sensor_costs_itself_and_its_byte_is_named(tmp_path):
    events = Events.from_columns([1, 2, 3], [5, 300, 6], [1, 1, 1], [1, 1, 0])
    recording = open_source(put(tmp_path, "a.aedat", DAVIS240 + polarity(events)))
    assert read(recording).x.tolist() == [5, 6]
    (fault,) = recording.faults.found
    assert (fault.reason, fault.where) == ("outside_sensor", f"byte {len(DAVIS240) + 28 + 8}")


def test_packets_of_unknown_kinds_are_skipped(tmp_path):
    body = packet(2, bytes(500), 250) + packet(12, bytes(16), 8) + polarity(EVENTS) + packet(2, b"", 9000)
    recording = open_source(put(tmp_path, "a.aedat", DAVIS240 + body))
    assert_same(read(recording), EVENTS)
    assert recording.faults.found == ()


@pytest.mark.parametrize("filler", [b"\xff" * 40, bytes(100), b"\1\0\1\0\x08\0\0\0\4\0\0\0" + b"\xff" * 90])
def test_reading_goes_on_at_the_next_packet_after_damage(filler, tmp_path):
    first, second = EVENTS.span(0, 200), EVENTS.span(200, 600)
    data = DAVIS240 + polarity(first) + filler + polarity(second)
    recording = open_source(put(tmp_path, "a.aedat", data))
    assert_same(read(recording), EVENTS)
    (fault,) = recording.faults.found
    assert (fault.reason, fault.where) == ("damaged", f"byte {len(DAVIS240 + polarity(first))}")


def test_the_next_packet_is_found_across_the_blocks_of_the_search(tmp_path):
    for shift in (0, 5, 27):
        filler = b"\xff" * (BLOCK_BYTES - shift)
        recording = open_source(put(tmp_path, "a.aedat", DAVIS240 + filler + polarity(EVENTS)))
        assert_same(read(recording), EVENTS)


@pytest.mark.parametrize("missing", [1, 7, 8, 27, 800, 810])
def test_a_truncated_file_gives_its_complete_events_and_says_so(missing, tmp_path):
    events = make_events(200, seed=4)
    data = (DAVIS240 + polarity(events))[:-missing]
    recording = open_source(put(tmp_path, "a.aedat", data))
    got, error = read_broken(recording)
    assert_same(got, events.span(0, 200 - min((missing + 7) // 8, 100)))
    assert error is not None
    assert recording.faults.unread


def test_a_packet_that_claims_too_much_is_not_allocated(tmp_path):
    huge = packet(1, b"", 8, number=MAX_PACKET_BYTES // 8 + 1)
    recording = open_source(put(tmp_path, "a.aedat", DAVIS240 + huge + polarity(EVENTS)))
    assert_same(read(recording), EVENTS)
    assert [one.reason for one in recording.faults.found] == ["damaged"]


@settings(max_examples=150, deadline=None)
@given(
    changes=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=12),
    cut=st.integers(0, 99),
)
def test_mutated_files_raise_declared_errors_only(tmp_path_factory, changes, cut):
    whole = bytearray(DAVIS240 + special((2, 3)) + imu(5, (0, 0, 0), (0, 0, 0)) + polarity(make_events(300, seed=1)))
    for at, value in changes:
        whole[at % len(whole)] = value
    path = tmp_path_factory.mktemp("mutated") / "a.aedat"
    path.write_bytes(whole[: len(whole) - cut * len(whole) // 300])
    try:
        recording = open_source(str(path))
        for stream in (recording.chunks, recording.imu, recording.triggers):
            list(stream())
    except RecordingError:
        pass
