"""Prophesee's DAT files, and the triggers of RAW and DAT."""

import numpy as np
import pytest

from neurove_core.io import BrokenRecording, MissingGeometry, Triggers, UnknownSource, open_source
from neurove_core.io.dat import RECORD, SEEK_RECORDS
from neurove_core.io.recording import BLOCK_BYTES
from protocol import Events, Sensor
from tests.builders import SENSOR, make_events
from tests.builders_evt import ADDR_X, ADDR_Y, TIME_HIGH, TIME_LOW, TRIGGER, evt2, evt3
from tests.neurove_core.test_io import HEADER_EVT2, HEADER_EVT3, assert_same, put, read, read_broken
from tests.recordings import shared

HEADER = b"% Data file containing CD events.\n% Version 2\n% Width 64\n% Height 48\n"


def dat(events: Events, header: bytes = HEADER + b"\x0c\x08") -> bytes:
    t, x, y, p = (column.astype(np.int64) for column in events)
    rows = np.empty(events.n, RECORD)
    rows["t"], rows["bits"] = t % (1 << 32), x | y << 14 | p << 28
    return header + rows.tobytes()


def all_triggers(recording) -> Triggers:
    return Triggers(*(np.concatenate(columns) for columns in zip(*recording.triggers(), strict=True)))


def columns(triggers: Triggers) -> list[list[int]]:
    return [column.tolist() for column in triggers]


@pytest.mark.parametrize("start_us", [5, (1 << 32) - 50_000])
def test_what_was_written_is_read_across_a_wrap_of_the_clock(start_us, tmp_path):
    events = make_events(3000, seed=1, start_us=start_us)
    recording = open_source(put(tmp_path, "a.dat", dat(events)))
    assert (recording.sensor, recording.streams) == (SENSOR, ("events",))
    assert_same(read(recording), events)


@pytest.mark.parametrize("start_us", [5, (1 << 32) - 2_000_000])
def test_a_time_is_found_in_the_file_as_by_reading_it(start_us, tmp_path):
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


def test_a_time_is_found_in_a_real_file():
    recording = open_source(str(shared("prophesee/gen4.dat")))
    late = Events.join(list(recording.since(10_000_000)))
    events = read(recording)
    assert_same(late, events.span(int(events.t.searchsorted(10_000_000)), events.n))


def test_a_file_larger_than_what_is_read_at_once_comes_whole(tmp_path):
    events = make_events(700_000, seed=3, duration_us=700_000)
    data = dat(events)
    assert len(data) > BLOCK_BYTES
    assert_same(read(open_source(put(tmp_path, "a.dat", data))), events)


@pytest.mark.parametrize(
    ("x", "y", "t", "why"),
    [(64, 3, 30, "outside the sensor"), (3, 48, 30, "outside the sensor"), (3, 4, 19, "comes after t=20 us")],
)
def test_a_bad_record_ends_the_recording_at_its_byte(x, y, t, why, tmp_path):
    events = Events.from_columns([10, 20, t, 40], [1, 2, x, 4], [1, 2, y, 4], [0, 1, 0, 1])
    got, error = read_broken(open_source(put(tmp_path, "a.dat", dat(events))))
    assert_same(got, events.span(0, 2))
    assert error is not None
    assert error.details["where"] == f"byte {len(HEADER) + 2 + 16}"
    assert why in error.message


@pytest.mark.parametrize("cut", range(1, 17))
def test_a_cut_file_gives_its_whole_records_and_then_the_byte(cut, tmp_path):
    events = make_events(10, seed=1)
    got, error = read_broken(open_source(put(tmp_path, "a.dat", dat(events)[:-cut])))
    assert_same(got, events.span(0, 10 - (cut + 7) // 8))
    assert (error is None) == (cut % 8 == 0)
    if error is not None:
        assert error.details["where"] == f"byte {len(HEADER) + 2 + 8 * got.n}"


def test_a_header_that_does_not_tell_what_it_must_is_refused(tmp_path):
    with pytest.raises(MissingGeometry, match="--sensor"):
        open_source(put(tmp_path, "a.dat", b"% Version 1\n\x00\x08"))
    assert open_source(put(tmp_path, "a.dat", b"% Version 1\n\x00\x08"), SENSOR).sensor == SENSOR
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
    with pytest.raises(BrokenRecording, match=f"byte {len(HEADER) + 2 + 8}: time runs backwards"):
        all_triggers(open_source(put(tmp_path, "a.dat", HEADER + b"\x0e\x08" + backwards.tobytes())))


def test_the_triggers_of_raw_files_are_found_between_their_events(tmp_path):
    words = evt3(
        (TIME_HIGH, 1), (TIME_LOW, 5), (ADDR_Y, 1), (TRIGGER, 2 << 8 | 1), (ADDR_X, 3), (TIME_LOW, 9), (TRIGGER, 2 << 8)
    )
    recording = open_source(put(tmp_path, "a.raw", HEADER_EVT3 + words.tobytes()))
    assert recording.streams == ("events", "triggers")
    assert columns(all_triggers(recording)) == [[4101, 4105], [2, 2], [1, 0]]
    words = evt2((TIME_HIGH, 1), (TRIGGER, 3 << 22 | 1 << 8 | 1), (0, 3 << 22 | 1 << 11 | 1))
    recording = open_source(put(tmp_path, "a.raw", HEADER_EVT2 + words.tobytes()))
    assert columns(all_triggers(recording)) == [[67], [1], [1]]


def test_triggers_end_where_a_word_is_unknown_or_cut(tmp_path):
    words = evt3((TIME_HIGH, 1), (TRIGGER, 1), (0x9, 1), (TRIGGER, 0))
    for data, where in ((words.tobytes(), 4), (words[:2].tobytes() + b"\0", 4)):
        recording = open_source(put(tmp_path, "a.raw", HEADER_EVT3 + data))
        triggers = recording.triggers()
        assert columns(next(iter(triggers))) == [[4096], [0], [1]]
        with pytest.raises(BrokenRecording, match=f"byte {len(HEADER_EVT3) + where}"):
            next(iter(triggers))


def test_the_real_recordings_have_no_triggers():
    assert not list(open_source(str(shared("prophesee/evt3.raw"))).triggers())
    assert not list(open_source(str(shared("prophesee/evt2.raw")), Sensor(640, 480)).triggers())
