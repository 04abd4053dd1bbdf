"""RAW and DAT files of Prophesee: headers, words, triggers, and the search for a time."""

import numpy as np
import pytest

from neurove_core.io import BrokenRecording, MissingGeometry, Triggers, UnknownSource
from neurove_core.io.formats.prophesee.dat import RECORD, SEEK_RECORDS
from neurove_core.io.recording import BLOCK_BYTES
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from tests.builders import SENSOR, make_events
from tests.builders_evt import (
    ADDR_X,
    ADDR_Y,
    HEADER_EVT2,
    HEADER_EVT3,
    TIME_HIGH,
    TIME_LOW,
    TRIGGER,
    evt2,
    evt3,
    write_evt3,
)
from tests.recordings import all_triggers, assert_same, put, read, read_broken, shared

EVENTS = make_events(300, seed=1, start_us=16_700_000)
HEADER = b"% Data file containing CD events.\n% Version 2\n% Width 64\n% Height 48\n"


def dat(events: Events, header: bytes = HEADER + b"\x0c\x08") -> bytes:
    t, x, y, p = (column.astype(np.int64) for column in events)
    rows = np.empty(events.n, RECORD)
    rows["t"], rows["bits"] = t % (1 << 32), x | y << 14 | p << 28
    return header + rows.tobytes()


def columns(triggers: Triggers) -> list[list[int]]:
    return [column.tolist() for column in triggers]


@pytest.mark.parametrize("start_us", [5, (1 << 32) - 50_000])
def test_a_written_file_reads_back_identical_across_a_wrap_of_the_clock(start_us, tmp_path):
    events = make_events(3000, seed=1, start_us=start_us)
    recording = open_source(put(tmp_path, "a.dat", dat(events)))
    assert (recording.sensor, recording.streams) == (SENSOR, ("events",))
    assert_same(read(recording), events)


@pytest.mark.parametrize("start_us", [5, (1 << 32) - 2_000_000])
def test_since_gives_the_same_events_as_reading_the_whole_file(start_us, tmp_path):
    n = 3 * SEEK_RECORDS + 17
    events = make_events(n, seed=2, start_us=start_us, duration_us=4_000_000)
    recording = open_source(put(tmp_path, "a.dat", dat(events)))
    for at in (0, 1, SEEK_RECORDS - 1, SEEK_RECORDS, SEEK_RECORDS + 1, n // 2, n - 1):
        t_us = int(events.t[at])
        first = int(events.t.searchsorted(t_us))
        assert_same(Events.join(list(recording.since(t_us))), events.span(first, n))
    assert_same(Events.join(list(recording.since(0))), events)
    assert not list(recording.since(int(events.t[-1]) + 1))
    assert not list(open_source(put(tmp_path, "b.dat", dat(Events.empty()))).since(5))


def test_since_finds_a_time_in_a_real_file():
    recording = open_source(str(shared("prophesee/gen4.dat")))
    late = Events.join(list(recording.since(10_000_000)))
    events = read(recording)
    assert_same(late, events.span(int(events.t.searchsorted(10_000_000)), events.n))


def test_a_file_larger_than_a_block_is_read_completely(tmp_path):
    events = make_events(700_000, seed=3, duration_us=700_000)
    data = dat(events)
    assert len(data) > BLOCK_BYTES
    assert_same(read(open_source(put(tmp_path, "a.dat", data))), events)


@pytest.mark.parametrize(
    ("x", "y", "t", "why"),
    [(64, 3, 30, "outside the sensor"), (3, 48, 30, "outside the sensor"), (3, 4, 19, "comes after t=20 us")],
)
def test_a_bad_record_is_skipped_and_counted_with_its_byte(x, y, t, why, tmp_path):
    events = Events.from_columns([10, 20, t, 40], [1, 2, x, 4], [1, 2, y, 4], [0, 1, 0, 1])
    got, error = read_broken(open_source(put(tmp_path, "a.dat", dat(events))))
    assert_same(got, Events(*(np.delete(column, 2) for column in events)))
    assert error is not None
    assert error.details["where"] == f"byte {len(HEADER) + 2 + 16}"
    assert why in error.message


@pytest.mark.parametrize("missing", range(1, 17))
def test_a_truncated_file_gives_its_complete_records_and_then_names_the_byte(missing, tmp_path):
    events = make_events(10, seed=1)
    got, error = read_broken(open_source(put(tmp_path, "a.dat", dat(events)[:-missing])))
    assert_same(got, events.span(0, 10 - (missing + 7) // 8))
    assert (error is None) == (missing % 8 == 0)
    if error is not None:
        assert error.details["where"] == f"byte {len(HEADER) + 2 + 8 * got.n}"


@pytest.mark.parametrize("version", ["1", "3"])
def test_another_version_of_the_records_is_refused(version, tmp_path):
    data = dat(make_events(5)).replace(b"% Version 2", b"% Version " + version.encode())
    with pytest.raises(UnknownSource, match=f"version {version}; the supported version is 2"):
        open_source(put(tmp_path, "a.dat", data))


def test_a_large_step_of_the_clock_that_is_no_wrap_adds_no_hour(tmp_path):
    t = np.concatenate([np.arange(300) + (3 << 29), np.arange(300)])
    rows = np.zeros(600, RECORD)
    rows["t"] = t
    recording = open_source(put(tmp_path, "a.dat", HEADER + b"\x00\x08" + rows.tobytes()))
    events = read(recording)
    assert events.t[-1] - events.t[0] == 299 + 1_000_000 + 299
    assert [fault.reason for fault in recording.faults.found] == ["new_clock"]


def test_an_incomplete_header_is_refused(tmp_path):
    with pytest.raises(MissingGeometry, match="--sensor"):
        open_source(put(tmp_path, "a.dat", b"% Version 2\n\x00\x08"))
    assert open_source(put(tmp_path, "a.dat", b"% Version 2\n\x00\x08"), SENSOR).sensor == SENSOR
    with pytest.raises(UnknownSource, match="records are of type 0x0c and 16 bytes"):
        open_source(put(tmp_path, "a.dat", HEADER + b"\x0c\x10"))
    with pytest.raises(BrokenRecording, match="ends within its header"):
        open_source(put(tmp_path, "a.dat", HEADER + b"\x0c"))


def test_a_dat_file_of_triggers_has_triggers_and_no_events(tmp_path):
    rows = np.array([(7, 1 | 3 << 8), ((1 << 32) - 1, 3 << 8), (4, 1)], RECORD)
    recording = open_source(put(tmp_path, "a.dat", HEADER + b"\x0e\x08" + rows[1:].tobytes()))
    assert recording.streams == ("triggers",)
    assert read_broken(recording)[0].n == 0
    assert columns(all_triggers(recording)) == [[(1 << 32) - 1, (1 << 32) + 4], [3, 0], [0, 1]]
    backwards = np.array([(7, 1), (6, 0)], RECORD)
    recording = open_source(put(tmp_path, "a.dat", HEADER + b"\x0e\x08" + backwards.tobytes()))
    assert columns(all_triggers(recording)) == [[7], [0], [1]]
    (fault,) = recording.faults.found
    assert (fault.stream, fault.reason, fault.where) == ("triggers", "late", f"byte {len(HEADER) + 2 + 8}")


def test_the_triggers_of_a_raw_file_are_found_between_its_events(tmp_path):
    words = evt3(
        (TIME_HIGH, 1), (TIME_LOW, 5), (ADDR_Y, 1), (TRIGGER, 2 << 8 | 1), (ADDR_X, 3), (TIME_LOW, 9), (TRIGGER, 2 << 8)
    )
    recording = open_source(put(tmp_path, "a.raw", HEADER_EVT3 + words.tobytes()))
    assert recording.streams == ("events", "triggers")
    assert columns(all_triggers(recording)) == [[4101, 4105], [2, 2], [1, 0]]
    words = evt2((TIME_HIGH, 1), (TRIGGER, 3 << 22 | 1 << 8 | 1), (0, 3 << 22 | 1 << 11 | 1))
    recording = open_source(put(tmp_path, "a.raw", HEADER_EVT2 + words.tobytes()))
    assert columns(all_triggers(recording)) == [[67], [1], [1]]


def test_triggers_pass_over_a_reserved_word_and_end_at_a_truncated_one(tmp_path):
    words = evt3((TIME_HIGH, 1), (TRIGGER, 1), (0x9, 1), (TRIGGER, 0))
    recording = open_source(put(tmp_path, "a.raw", HEADER_EVT3 + words.tobytes()))
    assert columns(all_triggers(recording)) == [[4096, 4096], [0, 0], [1, 0]]
    assert not recording.faults.found
    recording = open_source(put(tmp_path, "a.raw", HEADER_EVT3 + words[:2].tobytes() + b"\0"))
    assert columns(all_triggers(recording)) == [[4096], [0], [1]]
    (fault,) = recording.faults.found
    assert (fault.stream, fault.reason, fault.where) == ("triggers", "unread", f"byte {len(HEADER_EVT3) + 4}")


def test_the_real_recordings_have_no_triggers():
    assert not list(open_source(str(shared("prophesee/evt3.raw"))).triggers())
    assert not list(open_source(str(shared("prophesee/evt2.raw")), Sensor(640, 480)).triggers())


# --- headers and words of RAW ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "header",
    [
        b"% evt 3.0\n% geometry 64x48\n",
        b"% evt 3.0\r\n% geometry 64x48\r\n% end\r\n",
        b"% format EVT3;height=48;width=64\n% evt 3.0\n% end\n",
        b"% Format EVT3\n% Width 64\n% Height 48\n",
    ],
)
def test_the_geometry_is_found_in_every_form_of_the_header(header, tmp_path):
    words = write_evt3(EVENTS).words
    path = put(tmp_path, "A.RAW", header + words.tobytes())
    assert open_source(path).sensor == SENSOR
    assert_same(read(open_source(path)), EVENTS)
    assert open_source(path, Sensor(640, 480)).sensor == Sensor(640, 480)


def test_a_first_word_that_begins_with_a_percent_sign_is_not_a_header_line(tmp_path):
    words = evt3((TIME_HIGH, 0x25), (ADDR_Y, 1), (ADDR_X, 1))
    assert words.tobytes().startswith(b"%")
    assert read(open_source(put(tmp_path, "a.raw", b"% evt 3.0\n% geometry 64x48\n" + words.tobytes()))).n == 1


@pytest.mark.parametrize(
    "header",
    [b"% evt 3.0\n", b"% evt 3.0\n% geometry 0x0\n", b"% evt 3.0\n% geometry wide\n", b"% format EVT2;width=64\n"],
)
def test_a_header_without_geometry_requires_a_sensor_size(header, tmp_path):
    path = put(tmp_path, "a.raw", header)
    with pytest.raises(MissingGeometry, match=r"a\.raw.*--sensor WIDTHxHEIGHT"):
        open_source(path)
    assert open_source(path, SENSOR).sensor == SENSOR


@pytest.mark.parametrize(
    ("header", "why"),
    [
        (b"", "does not name a word format"),
        (b"% geometry 64x48\n", "does not name a word format"),
        (b"% evt 5.0\n", "its words are EVT 5.0; supported: EVT2, EVT21, EVT3, EVT4"),
        (b"% format HISTO3D;width=64;height=48\n", "its words are HISTO3D"),
        (
            b"% format EVT21;width=64;height=48;endianness=middle\n",
            "its endianness is 'middle'; supported: little, big",
        ),
    ],
)
def test_words_of_another_format_are_refused(header, why, tmp_path):
    with pytest.raises(UnknownSource, match=why):
        open_source(put(tmp_path, "a.raw", header + b"\0\0\0\0"), SENSOR)


@pytest.mark.parametrize(
    ("bad", "where", "why"),
    [
        (0x9123, f"byte {len(HEADER_EVT3) + 6}", "the word 0x9123 has a reserved type"),
        (ADDR_X << 12 | 64, "event 1", "x=64 y=7 lies outside the sensor 64x48"),
    ],
)
def test_a_bad_word_is_skipped_and_counted_with_its_place(bad, where, why, tmp_path):
    good = evt3((TIME_HIGH, 1), (ADDR_Y, 7), (ADDR_X, 63))
    words = np.concatenate([good, np.array([bad], np.uint16), good])
    events, error = read_broken(open_source(put(tmp_path, "a.raw", HEADER_EVT3 + words.tobytes())))
    assert events.n == 2
    assert error is not None
    assert error.details["where"] == where
    assert why in error.message
