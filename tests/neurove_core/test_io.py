"""Recordings: what real ones hold, where broken ones end, and what is said about those that can not be read."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from neurove_core.io import SUPPORTED, BrokenRecording, MissingGeometry, Recording, UnknownSource, open_source
from neurove_core.io.pattern import FRAME_US, shift_px
from neurove_core.io.recording import BLOCK_BYTES, CHUNK_EVENTS
from protocol import Events, NeuroVEError, Sensor
from protocol.errors import InvalidField
from protocol.events import check_events
from tests.builders import SENSOR, make_events
from tests.builders_evt import ADDR_X, ADDR_Y, TIME_HIGH, evt3, write_evt2, write_evt3
from tests.recordings import aedat4, ecd_text, shared

HEADER_EVT2 = b"% date 2020-09-25 07:48:31\n% evt 2.0\n% geometry 64x48\n"
HEADER_EVT3 = b"% evt 3.0\n% format EVT3;height=48;width=64\n% end\n"


def read(recording: Recording) -> Events:
    """All of it, after checking what every recording promises of its chunks."""
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
    """What is whole, and what ended it."""
    parts = []
    try:
        for chunk in recording.chunks():
            parts.append(chunk)  # noqa: PERF402 what came before the error counts
    except BrokenRecording as error:
        return Events.join(parts), error
    return Events.join(parts), None


def assert_same(got: Events, want: Events) -> None:
    for name, a, b in zip("txyp", got, want, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)


# --- real recordings ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "sensor", "n", "first_us", "last_us"),
    [
        ("aedat4/davis346.aedat4", Sensor(346, 260), 78_830, 1589163147368868, 1589163149728813),
        ("aedat4/dvxplorer.aedat4", Sensor(320, 240), 111_954, 1605537493718345, 1605537494308262),
        ("prophesee/evt3.raw", Sensor(1280, 720), 1_218_618, 11_200_224, 21_968_221),
        ("prophesee/gen4.dat", Sensor(1280, 720), 1_218_618, 5856, 10_773_853),
        ("prophesee/evt2.raw", Sensor(640, 480), 521_252, 913_716_224, 913_812_095),
        ("ecd/shapes_rotation", Sensor(240, 180), 30_000, 43_499_029, 43_605_033),
        ("ecd/shapes_rotation/events.txt", Sensor(240, 180), 30_000, 43_499_029, 43_605_033),
        ("ecd/shapes_rotation_1.43s.txt", Sensor(240, 180), 120_000, 0, 1_428_658),
    ],
)
def test_a_real_recording_holds_its_known_events_each_time_it_is_read(path, sensor, n, first_us, last_us):
    recording = open_source(str(shared(path)), sensor if path.endswith("evt2.raw") else None)
    assert recording.sensor == sensor
    assert not recording.endless
    assert recording.name == Path(path).name
    events = read(recording)
    assert (events.n, events.t[0], events.t[-1]) == (n, first_us, last_us)
    assert_same(read(recording), events)


def test_evt3_and_dat_of_one_camera_agree_up_to_a_constant_in_time():
    events = read(open_source(str(shared("prophesee/evt3.raw"))))
    dat = read(open_source(str(shared("prophesee/gen4.dat"))))
    assert np.unique(events.t - dat.t).size == 1
    assert_same(events._replace(t=dat.t), dat)


def test_a_raw_file_without_geometry_asks_for_it_and_never_guesses():
    path = shared("prophesee/evt2.raw")
    with pytest.raises(MissingGeometry, match="--sensor WIDTHxHEIGHT") as caught:
        open_source(str(path))
    assert caught.value.code == "missing_geometry"
    with pytest.raises(BrokenRecording, match="outside the sensor 320x240"):
        read(open_source(str(path), Sensor(320, 240)))


def test_the_event_camera_dataset_knows_its_lens():
    camera = open_source(str(shared("ecd/shapes_rotation"))).camera("left")
    assert camera is not None
    assert (camera.stream, camera.lens, camera.sensor) == ("left", "pinhole", Sensor(240, 180))
    assert (camera.fx, camera.fy) == (199.092366542, 198.82882047)
    assert (camera.cx, camera.cy) == (132.192071378, 110.712660011)
    assert camera.distortion == (-0.368436311798, 0.150947243557, -0.000296130534385, -0.000759431726241, 0.0)
    assert open_source(str(shared("ecd/shapes_rotation_1.43s.txt"))).camera("left") is None
    assert open_source(str(shared("aedat4/davis346.aedat4"))).camera("left") is None


# --- small recordings, written here ---------------------------------------------------------------------------------


class Written(NamedTuple):
    """A small recording: where the words, lines or packets in it end, and how many events are whole by then."""

    name: str
    data: bytes
    header: int  # [bytes]
    stops: list[int]  # byte after each word, line or packet
    whole: list[int]  # events up to there
    where: Callable[[int], str]  # of the first unit that is not whole, by its number
    cut_at_stop: bool = False  # whether the end of a unit is noticed as a premature end too
    events_end: int | None = None  # a cut from this byte on costs nothing


def written_evt(name: str, header: bytes, events: Events) -> Written:
    words, ends = (write_evt2 if name == "evt2" else write_evt3)(events)
    size = words.itemsize
    stops = [len(header) + size * (i + 1) for i in range(words.size)]
    whole = np.searchsorted(ends, np.arange(1, words.size + 1), "right").tolist()
    return Written(
        f"{name}.raw", header + words.tobytes(), len(header), stops, whole, lambda i: f"byte {len(header) + size * i}"
    )


def written_aedat4(events: Events, *, finished: bool) -> Written:
    bounds = list(range(0, events.n + 1, events.n // 6))
    file = aedat4([events.span(a, b) for a, b in itertools.pairwise(bounds)], SENSOR, finished=finished)
    # packets of events and of triggers by turns
    triggers = [*file.starts[1:], file.end]
    stops = [stop for pair in zip(file.stops, triggers, strict=True) for stop in pair]
    whole = [n for n in bounds[1:] for _ in range(2)]
    header = file.starts[0]
    return Written(
        "a.aedat4",
        file.data,
        header,
        stops,
        whole,
        lambda i: f"byte {[header, *stops][i]}",
        cut_at_stop=finished,
        events_end=file.end,
    )


def written_ecd(events: Events) -> Written:
    data = ecd_text(events)
    stops = [i for i, byte in enumerate(data) if byte == ord("\n")]  # an end of file does for an end of line
    return Written("a.txt", data, 0, stops, list(range(1, events.n + 1)), lambda i: f"line {i + 1}")


EVENTS = make_events(300, seed=1, start_us=16_700_000)
WRITTEN = {
    "evt2": written_evt("evt2", HEADER_EVT2, EVENTS),
    "evt3": written_evt("evt3", HEADER_EVT3, EVENTS),
    "ecd": written_ecd(EVENTS),
    "aedat4": written_aedat4(EVENTS, finished=True),
    "aedat4-killed": written_aedat4(EVENTS, finished=False),
}
each_format = pytest.mark.parametrize("file", WRITTEN.values(), ids=WRITTEN.keys())


def put(folder: Path, name: str, data: bytes) -> str:
    (folder / name).write_bytes(data)
    return str(folder / name)


@each_format
def test_what_was_written_is_read(file, tmp_path):
    recording = open_source(put(tmp_path, file.name, file.data), SENSOR)
    assert_same(read(recording), EVENTS)
    assert_same(read(recording), EVENTS)


@each_format
@pytest.mark.parametrize("seed", range(3))
def test_a_cut_recording_gives_its_whole_prefix_and_then_the_place_where_it_broke(file, seed, tmp_path):
    cuts = np.random.default_rng(seed).integers(file.header, len(file.data), 40)
    near = np.random.default_rng(seed).choice(file.stops, 8)
    for cut in {*cuts.tolist(), *near.tolist(), *(near + 1).tolist(), *(near - 1).tolist()}:
        events, error = read_broken(open_source(put(tmp_path, file.name, file.data[:cut]), SENSOR))
        units = int(np.searchsorted(file.stops, cut, "right"))
        assert_same(events, EVENTS.span(0, [0, *file.whole][units]))
        reached = [file.header, *file.stops][units]
        past_the_end = file.events_end is not None and cut >= file.events_end
        at_a_seam = cut == reached or (file.name == "a.txt" and file.data[cut - 1 : cut] == b"\n")
        if past_the_end or (at_a_seam and not file.cut_at_stop):
            assert error is None
        else:
            assert error is not None
            assert error.details["where"] == file.where(units)
            assert error.code == "broken_recording"


@each_format
def test_a_recording_cut_within_its_header_is_refused_or_has_no_events(file, tmp_path):
    for cut in range(file.header):
        path = put(tmp_path, file.name, file.data[:cut])
        try:
            events, _ = read_broken(open_source(path))
        except (BrokenRecording, MissingGeometry, UnknownSource) as error:
            assert path in error.message  # noqa: PT017 a text header may be cut after all that matters
        else:
            assert events.n == 0


@each_format
@pytest.mark.parametrize("seed", range(3))
def test_a_garbled_recording_is_refused_in_our_own_words_or_read(file, seed, tmp_path):
    rng = np.random.default_rng(seed)
    for _ in range(60):
        data = bytearray(file.data)
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            data[at] = rng.integers(0, 256)
        try:
            recording = open_source(put(tmp_path, file.name, bytes(data)), SENSOR)
            events, _ = read_broken(recording)
            check_events(events, SENSOR)
            assert not (events.p > 1).any()
        except NeuroVEError as error:
            assert str(tmp_path) in error.message  # noqa: PT017 not raising is fine too


@pytest.mark.parametrize("name", ["a.raw", "a.txt", "a.aedat4"])
def test_a_recording_larger_than_what_is_read_at_once_comes_in_bounded_chunks(name, tmp_path):
    n = 1_100_000 if name == "a.raw" else 300_000
    events = make_events(n, seed=2, start_us=5, duration_us=n)
    data = {"a.raw": large_evt2, "a.txt": ecd_text, "a.aedat4": lambda events: aedat4([events], SENSOR).data}[name](
        events
    )
    assert len(data) > BLOCK_BYTES
    recording = open_source(put(tmp_path, name, data), SENSOR)
    assert_same(read(recording), events)
    assert sum(1 for _ in recording.chunks()) > 1


def large_evt2(events: Events) -> bytes:
    """The words of write_evt2, for a million events."""
    high = np.unique(events.t >> 6)
    x, y, p = (column.astype(np.int64) for column in events[1:])
    words = np.concatenate([TIME_HIGH << 28 | high, p << 28 | (events.t & 63) << 22 | x << 11 | y])
    order = np.argsort(np.concatenate([high << 6, events.t]), kind="stable")
    return HEADER_EVT2 + words[order].astype("<u4").tobytes()


# --- Prophesee ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "header",
    [
        b"% evt 3.0\n% geometry 64x48\n",
        b"% evt 3.0\r\n% geometry 64x48\r\n% end\r\n",
        b"% format EVT3;height=48;width=64\n% evt 3.0\n% end\n",
        b"% Format EVT3\n% Width 64\n% Height 48\n",
    ],
)
def test_the_geometry_is_found_however_the_header_writes_it(header, tmp_path):
    words = write_evt3(EVENTS).words
    path = put(tmp_path, "A.RAW", header + words.tobytes())
    assert open_source(path).sensor == SENSOR
    assert_same(read(open_source(path)), EVENTS)
    assert open_source(path, Sensor(640, 480)).sensor == Sensor(640, 480)


def test_a_first_word_that_looks_like_a_percent_sign_is_no_header(tmp_path):
    words = evt3((TIME_HIGH, 0x25), (ADDR_Y, 1), (ADDR_X, 1))
    assert words.tobytes().startswith(b"%")
    assert read(open_source(put(tmp_path, "a.raw", b"% evt 3.0\n% geometry 64x48\n" + words.tobytes()))).n == 1


@pytest.mark.parametrize(
    "header",
    [b"% evt 3.0\n", b"% evt 3.0\n% geometry 0x0\n", b"% evt 3.0\n% geometry wide\n", b"% format EVT2;width=64\n"],
)
def test_a_header_without_a_geometry_asks_for_one(header, tmp_path):
    path = put(tmp_path, "a.raw", header)
    with pytest.raises(MissingGeometry, match=r"a\.raw.*--sensor WIDTHxHEIGHT"):
        open_source(path)
    assert open_source(path, SENSOR).sensor == SENSOR


@pytest.mark.parametrize(
    ("header", "why"),
    [
        (b"", "names no word format"),
        (b"% geometry 64x48\n", "names no word format"),
        (b"% evt 2.1\n", "its words are EVT21"),
        (b"% format EVT4;width=64;height=48\n", "its words are EVT4"),
    ],
)
def test_words_of_another_format_are_refused(header, why, tmp_path):
    with pytest.raises(UnknownSource, match=why):
        open_source(put(tmp_path, "a.raw", header + b"\0\0\0\0"), SENSOR)


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (0x9123, "0x9123 is of no known word type"),
        (ADDR_X << 12 | 64, "x=64 y=7 lies outside the sensor 64x48"),
    ],
)
def test_a_bad_word_ends_the_recording_at_its_byte(bad, why, tmp_path):
    good = evt3((TIME_HIGH, 1), (ADDR_Y, 7), (ADDR_X, 63))
    words = np.concatenate([good, np.array([bad], np.uint16), good])
    events, error = read_broken(open_source(put(tmp_path, "a.raw", HEADER_EVT3 + words.tobytes())))
    assert events.n == 1
    assert error is not None
    assert error.details["where"] == f"byte {len(HEADER_EVT3) + 6}"
    assert why in error.message


# --- AEDAT4 ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("t", "x", "why"),
    [
        ((20, 30, 40), (1, 64, 3), "event 1 at x=64 y=2 lies outside the sensor 64x48"),
        ((20, 19, 40), (1, 2, 3), "event 1 at t=19 us comes after t=20 us"),
        ((9, 30, 40), (1, 2, 3), "event 0 at t=9 us comes after t=10 us"),
        ((9, 30, 20), (1, 2, 3), "event 0 at t=9 us comes after t=10 us"),
    ],
)
def test_a_packet_with_a_bad_event_ends_the_recording_before_that_event(t, x, why, tmp_path):
    first = Events.from_columns([5, 10], [1, 2], [3, 4], [0, 1])
    second = Events.from_columns(t, x, [2, 2, 2], [1, 1, 1])
    file = aedat4([first, second, second], SENSOR)
    events, error = read_broken(open_source(put(tmp_path, "a.aedat4", file.data)))
    assert_same(events, Events.join([first, second.span(0, int(why[6]))]))
    assert error is not None
    assert error.details["where"] == f"byte {file.starts[1]}"
    assert why in error.message


def test_a_packet_without_events_is_no_chunk(tmp_path):
    file = aedat4([Events.empty(), EVENTS, Events.empty()], SENSOR)
    assert_same(read(open_source(put(tmp_path, "a.aedat4", file.data))), EVENTS)


def test_an_aedat4_file_without_an_event_stream_or_a_size_says_so(tmp_path):
    data = aedat4([EVENTS], SENSOR).data
    with pytest.raises(UnknownSource, match="no event stream"):
        open_source(put(tmp_path, "a.aedat4", data.replace(b">EVTS<", b">FRME<")))
    nowhere = put(tmp_path, "a.aedat4", data.replace(b">64<", b">00<"))
    with pytest.raises(MissingGeometry):
        open_source(nowhere)
    assert_same(read(open_source(nowhere, SENSOR)), EVENTS)
    with pytest.raises(UnknownSource, match="does not begin as AEDAT4 does"):
        open_source(put(tmp_path, "a.aedat4", b"#!AER-DAT3.1\r\n"))


def test_of_several_event_streams_the_first_is_read_and_the_name_says_so(tmp_path):
    data = aedat4([EVENTS], SENSOR).data
    size = b'<attr key="sizeX" type="int">64</attr><attr key="sizeY" type="int">48</attr>'
    both = data.replace(b">TRIG<", b">EVTS<").replace(b'1/info/"></node>', b'1/info/">' + size + b"</node>")
    longer = len(both) - len(data)
    header = bytearray(both)
    for at, form in ((14, "<u4"), (46, "<i8"), (58, "<u4")):  # lengths of header and text, and where the packets end
        header[at : at + int(form[2])] = (np.frombuffer(both, form, 1, at) + longer).astype(form).tobytes()
    recording = open_source(put(tmp_path, "a.aedat4", bytes(header)))
    assert recording.name == "a.aedat4 (stream 0, the first of 2 event streams)"


# --- Event Camera Dataset -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ("0.000003 1 2", "not `t[s] x y p`"),
        ("0.000003 1 2 1 1", "not `t[s] x y p`"),
        ("0.000003 -1 2 1", "not `t[s] x y p`"),
        ("0.000003 1 2 2", "not `t[s] x y p`"),
        ("nan 1 2 1", "not `t[s] x y p`"),
        ("inf 1 2 1", "not `t[s] x y p`"),
        ("one 1 2 1 " + 100 * "x", "not `t[s] x y p`"),
        ("0.000003 240 2 1", "outside the sensor 240x180"),
        ("0.000003 1 180 1", "outside the sensor 240x180"),
        ("0.0000005 1 2 1", "time runs backwards"),
    ],
)
def test_a_bad_line_ends_the_recording_with_its_number_and_its_text(bad, why, tmp_path):
    path = put(tmp_path, "a.txt", f"0.000001 1 2 1\n\n0.000002 3 4 0\r\n{bad}\n0.000004 1 2 1\n".encode())
    events, error = read_broken(open_source(path))
    assert_same(events, Events.from_columns([1, 2], [1, 3], [2, 4], [1, 0]))
    assert error is not None
    assert error.details["where"] == "line 4"
    assert why in error.message
    assert bad[:60] in error.message
    assert len(error.message) < len(path) + 200


def test_of_several_bad_lines_the_first_is_told(tmp_path):
    path = put(tmp_path, "a.txt", b"0.1 1 2 1\n0.2 999 2 1\n0.1 1 2 1\nno event\n")
    _, error = read_broken(open_source(path))
    assert error is not None
    assert error.details["where"] == "line 2"
    assert "outside the sensor" in error.message


def test_a_line_is_counted_over_all_blocks_of_a_large_file(tmp_path):
    lines = ecd_text(make_events(300_000, seed=3)).splitlines()
    lines[250_000] = b"\xff\x00 no text"
    events, error = read_broken(open_source(put(tmp_path, "a.txt", b"\n".join(lines))))
    assert events.n == 250_000
    assert error is not None
    assert error.details["where"] == "line 250001"
    assert repr("\\xff\x00 no text") in error.message


def test_time_may_not_run_backwards_from_one_block_of_a_file_to_the_next_either(tmp_path):
    block = ecd_text(make_events(150_000, seed=3, start_us=1000))
    block += b"\n" * (BLOCK_BYTES - len(block))
    events, error = read_broken(open_source(put(tmp_path, "a.txt", block + b"0.000999 1 2 1\n")))
    assert events.n == 150_000
    assert error is not None
    assert error.details["where"] == f"line {len(block.splitlines()) + 1}"
    assert "time runs backwards: '0.000999 1 2 1'" in error.message


def test_a_file_that_is_no_text_is_broken_at_its_first_line(tmp_path):
    events, error = read_broken(open_source(put(tmp_path, "a.txt", bytes(3 * BLOCK_BYTES))))
    assert events.n == 0
    assert error is not None
    assert error.details["where"] == "line 1"


def test_times_in_seconds_become_the_nearest_us(tmp_path):
    path = put(tmp_path, "a.txt", b"0.0000014 1 1 1\n0.0000016 1 1 1\n1.0e1 1 1 0\n1506117902.290381 1 1 0\n")
    assert read(open_source(path)).t.tolist() == [1, 2, 10_000_000, 1506117902290381]


@pytest.mark.parametrize("empty", [b"", b"\n", b"\n \n\n"])
def test_a_text_without_events_has_none(empty, tmp_path):
    assert read(open_source(put(tmp_path, "a.txt", empty))).n == 0


@pytest.mark.parametrize(
    "calib", ["", "1 2 3 4", "1 2 3 4 5 6 7 8 9 10", "-1 2 3 4 0 0 0 0 0", "1 2 3 4 0 0 0 0 nan", "a b c d e f g h i"]
)
def test_a_wrong_calibration_is_named_when_the_recording_is_opened(calib, tmp_path):
    put(tmp_path, "events.txt", ecd_text(EVENTS))
    put(tmp_path, "calib.txt", calib.encode())
    with pytest.raises(InvalidField, match=r"calib\.txt: calib=.* nine numbers") as caught:
        open_source(str(tmp_path))
    assert str(tmp_path / "calib.txt") in caught.value.message


def test_a_folder_is_called_by_its_own_name_and_given_a_sensor_takes_it(tmp_path):
    put(tmp_path, "events.txt", ecd_text(EVENTS))
    put(tmp_path, "calib.txt", b"60 61 32 24 0 0 0 0 0\n")
    recording = open_source(str(tmp_path), SENSOR)
    assert recording.name == tmp_path.name
    camera = recording.camera("cam0")
    assert camera is not None
    assert (camera.sensor, camera.fx, camera.fy) == (SENSOR, 60, 61)


# --- what is no source ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "why"),
    [
        ("missing.raw", "no such file or folder"),
        ("", "the folder has no events.txt"),
        ("a.xyz", "unknown suffix '.xyz'"),
        ("events", "a file without suffix"),
        ("zenoh://cam0", "unknown scheme zenoh://"),
        ("pattern://stripes", "a seed and nothing else"),
        ("pattern://?speed=3", "a seed and nothing else"),
    ],
)
def test_an_unknown_source_is_told_what_would_be_known(source, why, tmp_path):
    put(tmp_path, "a.xyz", b"")
    put(tmp_path, "events", b"")
    with pytest.raises(UnknownSource) as caught:
        open_source(source if "://" in source else str(tmp_path / source))
    assert why in caught.value.message
    assert source in caught.value.message
    assert all(line in caught.value.message for line in SUPPORTED)
    assert caught.value.code == "unknown_source"
    assert caught.value.details["why"]


@pytest.mark.parametrize("seed", ["", "-1", "x", "1.5", "99999999999999999999"])
def test_a_seed_is_a_whole_number(seed):
    with pytest.raises(InvalidField, match="seed="):
        open_source(f"pattern://?seed={seed}")


# --- the built-in pattern -------------------------------------------------------------------------------------------


def seconds(recording: Recording, duration_s: float) -> Events:
    chunks = itertools.takewhile(lambda chunk: chunk.t[0] < duration_s * 1e6, recording.chunks())
    return Events.join(list(chunks))


@pytest.mark.parametrize("seed", range(3))
def test_the_pattern_is_the_same_for_a_seed_ordered_on_the_sensor_and_of_a_usual_rate(seed):
    recording = open_source(f"pattern://?seed={seed}")
    assert recording.endless
    events = seconds(recording, 1.0)
    assert_same(seconds(open_source(f"pattern://?seed={seed}"), 1.0), events)
    assert seconds(open_source("pattern://?seed=9"), 0.1).n != seconds(recording, 0.1).n
    check_events(events, recording.sensor, 0)
    assert 0 <= events.t[0] < 1000
    assert recording.sensor == Sensor(173, 130)
    assert 100_000 < events.n < 400_000
    assert 0.3 < events.p.mean() < 0.7


@pytest.mark.parametrize("seed", range(3))
def test_the_pattern_moves_as_it_says(seed):
    """Events moved back along its path make a sharper image than where they were seen, or moved the other way."""
    events = seconds(open_source(f"pattern://?seed={seed}"), 0.2)
    path = np.array([shift_px(t) for t in events.t.tolist()])

    def sharpness(direction: int) -> float:
        x, y = np.rint(np.stack([events.x, events.y], 1) - direction * path).astype(int).T
        image = np.zeros((260, 346))
        np.add.at(image, (y + 65, x + 86), np.where(events.p, 1, -1))
        return float(np.var(image))

    assert sharpness(1) > 1.5 * max(sharpness(0), sharpness(-1))


def test_the_times_of_the_pattern_do_not_show_its_frames():
    events = seconds(open_source("pattern://"), 0.5)
    share = np.histogram(events.t % FRAME_US, 5)[0] / events.n
    assert (np.abs(share - 0.2) < 0.02).all()


def test_the_pattern_has_the_lens_of_half_a_davis346():
    camera = open_source("pattern://").camera("cam0")
    assert camera is not None
    assert (camera.sensor, camera.lens, camera.distortion) == (Sensor(173, 130), "pinhole", ())
    assert (camera.cx, camera.cy) == (86, 64.5)
    assert camera.fx == camera.fy == pytest.approx(113.19)


def test_the_pattern_fills_another_sensor_too():
    recording = open_source("pattern://?seed=1", Sensor(64, 48))
    check_events(seconds(recording, 0.1), Sensor(64, 48), 0)
    camera = recording.camera("cam0")
    assert camera is not None
    assert camera.sensor == Sensor(64, 48)
