"""Recordings: content of real ones, place of the damage in broken ones, and errors of unknown sources."""

import itertools
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from neurove_core.io import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.recording import BLOCK_BYTES
from neurove_core.sources import open_source, supported
from neurove_protocol import Events, NeuroVEError, Sensor
from neurove_protocol.events import check_events
from tests.builders import SENSOR, make_events
from tests.builders_evt import HEADER_EVT2, HEADER_EVT3, TIME_HIGH, write_evt2, write_evt3
from tests.recordings import aedat4, assert_same, ecd_text, put, read, read_broken, shared

# --- real recordings -------------------------------------------------------------------------------------------------


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
def test_a_real_recording_gives_its_known_events_on_each_read(path, sensor, n, first_us, last_us):
    recording = open_source(str(shared(path)), sensor if path.endswith("evt2.raw") else None)
    assert recording.sensor == sensor
    assert not recording.endless
    assert recording.name == Path(path).name
    events = read(recording)
    assert (events.n, events.t[0], events.t[-1]) == (n, first_us, last_us)
    assert_same(read(recording), events)


def test_evt3_and_dat_of_one_camera_differ_only_by_a_constant_time():
    events = read(open_source(str(shared("prophesee/evt3.raw"))))
    dat = read(open_source(str(shared("prophesee/gen4.dat"))))
    assert np.unique(events.t - dat.t).size == 1
    assert_same(events._replace(t=dat.t), dat)


def test_a_raw_file_without_geometry_requires_a_sensor_size():
    path = shared("prophesee/evt2.raw")
    with pytest.raises(MissingGeometry, match="--sensor WIDTHxHEIGHT") as caught:
        open_source(str(path))
    assert caught.value.code == "missing_geometry"
    error = read_broken(open_source(str(path), Sensor(320, 240)))[1]
    assert error is not None
    assert "outside the sensor 320x240" in error.message


def test_the_event_camera_dataset_gives_its_camera_parameters():
    camera = open_source(str(shared("ecd/shapes_rotation"))).camera("left")
    assert camera is not None
    assert (camera.stream, camera.lens, camera.sensor) == ("left", "pinhole", Sensor(240, 180))
    assert (camera.fx, camera.fy) == (199.092366542, 198.82882047)
    assert (camera.cx, camera.cy) == (132.192071378, 110.712660011)
    assert camera.distortion == (-0.368436311798, 0.150947243557, -0.000296130534385, -0.000759431726241, 0.0)
    assert open_source(str(shared("ecd/shapes_rotation_1.43s.txt"))).camera("left") is None
    assert open_source(str(shared("aedat4/davis346.aedat4"))).camera("left") is None


# --- small recordings, written by these tests -------------------------------------------------------------------------


class Written(NamedTuple):
    """A small recording, with the end of each unit (word, line or packet) and the number of complete events there."""

    name: str
    data: bytes
    header: int  # [bytes]
    stops: list[int]  # byte after each unit
    complete: list[int]  # number of complete events up to each stop
    where: Callable[[int], str]  # place of the first truncated unit, by its number
    error_at_stop: bool = False  # whether truncation at the end of a unit is an error too
    events_end: int | None = None  # truncation at this byte or later loses no event


def written_evt(name: str, header: bytes, events: Events) -> Written:
    words, ends = (write_evt2 if name == "evt2" else write_evt3)(events)
    size = words.itemsize
    stops = [len(header) + size * (i + 1) for i in range(words.size)]
    complete = np.searchsorted(ends, np.arange(1, words.size + 1), "right").tolist()
    return Written(
        f"{name}.raw",
        header + words.tobytes(),
        len(header),
        stops,
        complete,
        lambda i: f"byte {len(header) + size * i}",
    )


def written_aedat4(events: Events, *, finished: bool) -> Written:
    bounds = list(range(0, events.n + 1, events.n // 6))
    file = aedat4([events.span(a, b) for a, b in itertools.pairwise(bounds)], SENSOR, finished=finished)
    # packets of events and of triggers alternate
    triggers = [*file.starts[1:], file.end]
    stops = [stop for pair in zip(file.stops, triggers, strict=True) for stop in pair]
    complete = [n for n in bounds[1:] for _ in range(2)]
    header = file.starts[0]
    return Written(
        "a.aedat4",
        file.data,
        header,
        stops,
        complete,
        lambda i: f"byte {[header, *stops][i]}",
        error_at_stop=finished,
        events_end=file.end,
    )


def written_ecd(events: Events) -> Written:
    data = ecd_text(events)
    stops = [i for i, byte in enumerate(data) if byte == ord("\n")]  # the end of the file also ends a line
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


@each_format
def test_a_written_recording_reads_back_identical(file, tmp_path):
    recording = open_source(put(tmp_path, file.name, file.data), SENSOR)
    assert_same(read(recording), EVENTS)
    assert_same(read(recording), EVENTS)


@each_format
@pytest.mark.parametrize("seed", range(3))
def test_a_truncated_recording_gives_its_complete_events_and_then_names_the_place(file, seed, tmp_path):
    sizes = np.random.default_rng(seed).integers(file.header, len(file.data), 40)
    near = np.random.default_rng(seed).choice(file.stops, 8)
    for size in {*sizes.tolist(), *near.tolist(), *(near + 1).tolist(), *(near - 1).tolist()}:
        events, error = read_broken(open_source(put(tmp_path, file.name, file.data[:size]), SENSOR))
        units = int(np.searchsorted(file.stops, size, "right"))
        assert_same(events, EVENTS.span(0, [0, *file.complete][units]))
        reached = [file.header, *file.stops][units]
        past_the_end = file.events_end is not None and size >= file.events_end
        between_units = size == reached or (file.name == "a.txt" and file.data[size - 1 : size] == b"\n")
        if past_the_end or (between_units and not file.error_at_stop):
            assert error is None
        else:
            assert error is not None
            assert error.details["where"] == file.where(units)
            assert error.code == "broken_recording"


@each_format
def test_a_recording_truncated_within_its_header_is_refused_or_has_no_events(file, tmp_path):
    for size in range(file.header):
        path = put(tmp_path, file.name, file.data[:size])
        try:
            events, _ = read_broken(open_source(path))
        except (BrokenRecording, MissingGeometry, UnknownSource) as error:
            assert path in error.message  # noqa: PT017 a truncated text header can still be valid
        else:
            assert events.n == 0


@each_format
@pytest.mark.parametrize("seed", range(3))
def test_a_corrupt_recording_is_read_or_raises_a_neurove_error(file, seed, tmp_path):
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
            assert str(tmp_path) in error.message  # noqa: PT017 no error is valid too


@pytest.mark.parametrize("name", ["a.raw", "a.txt", "a.aedat4"])
def test_a_recording_larger_than_a_block_gives_several_bounded_chunks(name, tmp_path):
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
    """The words of write_evt2, vectorised for a million events."""
    high = np.unique(events.t >> 6)
    x, y, p = (column.astype(np.int64) for column in events[1:])
    words = np.concatenate([TIME_HIGH << 28 | high, p << 28 | (events.t & 63) << 22 | x << 11 | y])
    order = np.argsort(np.concatenate([high << 6, events.t]), kind="stable")
    return HEADER_EVT2 + words[order].astype("<u4").tobytes()


# --- unknown sources -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "why"),
    [
        ("", "the folder has no events.txt"),
        ("a.xyz", "unknown suffix '.xyz'"),
        ("events", "the file has no suffix"),
        ("zenoh://cam0", "unknown scheme zenoh://"),
        ("pattern://stripes", "its only parameter is seed"),
        ("pattern://?speed=3", "its only parameter is seed"),
    ],
)
def test_the_error_of_an_unknown_source_lists_the_supported_sources(source, why, tmp_path):
    put(tmp_path, "a.xyz", b"")
    put(tmp_path, "events", b"")
    with pytest.raises(UnknownSource) as caught:
        open_source(source if "://" in source else str(tmp_path / source))
    assert why in caught.value.message
    assert source in caught.value.message
    if "pattern" not in source:
        names = {re.sub(r" \([^)]*\)", "", line) for line in supported()}
        assert all(name in caught.value.message for name in names)
    assert caught.value.code == "unknown_source"
    assert caught.value.details["why"]


def test_the_error_of_a_missing_file_is_one_line_without_the_list_of_formats(tmp_path):
    with pytest.raises(UnknownSource) as caught:
        open_source(str(tmp_path / "missing.raw"))
    assert caught.value.message == f"source {str(tmp_path / 'missing.raw')!r}: no such file or folder"
