"""Content goes before suffix: names that say nothing, compressed files, pipes, and files that are no recording."""

import bz2
import contextlib
import gzip
import os
import resource
import threading
from collections.abc import Iterator
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from neurove_core.files import LFS_POINTER
from neurove_core.io import BrokenRecording, RecordingError, UnknownSource
from neurove_core.io.calibration import read_calibration
from neurove_core.io.formats.pose_files import read_poses
from neurove_core.io.spool import plain_file
from neurove_core.io.unpack import FREE_BYTES, MAX_RATIO
from neurove_core.models.container import read_container
from neurove_core.sources import open_source
from neurove_protocol import Events
from neurove_protocol.errors import NeuroVEError
from tests import ros_bags
from tests.builders import SENSOR, make_events
from tests.builders_evt import HEADER_EVT2, HEADER_EVT3, write_evt2, write_evt3
from tests.recordings import aedat4, assert_same, ecd_text, put, read, read_broken

EVENTS = make_events(200, seed=3, start_us=1_000_000)
TOPIC = "/cam/events"
COMPRESSORS = {
    ".gz": gzip.compress,
    ".zst": zstandard.compress,
    ".zstd": zstandard.compress,
    ".bz2": bz2.compress,
    ".lz4": lz4.frame.compress,
}


def raw() -> bytes:
    return HEADER_EVT3 + write_evt3(EVENTS).words.tobytes()


def dat() -> bytes:
    rows = b"".join(
        t.to_bytes(4, "little") + (x | y << 14 | p << 28).to_bytes(4, "little")
        for t, x, y, p in zip(*(column.tolist() for column in EVENTS), strict=True)
    )
    return b"% Data file containing CD events.\n% Version 2\n% Width 64\n% Height 48\n\x0c\x08" + rows


def bag(folder: Path, ros: int = 1, *, mcap: bool = False, kind: str = ros_bags.DVS) -> Path:
    """A bag of EVENTS; its only file."""
    store = ros_bags.Store(ros)
    message = ros_bags.dvs(store, EVENTS, kind=kind)
    path = ros_bags.write_bag(folder / "run.bag", store, [(TOPIC, 1_000_000_000, message)], mcap=mcap)
    return path if path.is_file() else next(path.glob("*.mcap" if mcap else "*.db3"))


@contextlib.contextmanager
def pipe(path: Path, data: bytes) -> Iterator[str]:
    """A named pipe that gives these bytes once."""
    os.mkfifo(path)

    def write() -> None:
        with contextlib.suppress(BrokenPipeError):  # the reader refused it
            path.write_bytes(data)

    writer = threading.Thread(target=write)
    writer.start()
    yield str(path)
    writer.join()


# --- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["recording", "recording.bin", "recording.txt", "recording.raw", "recording.h5"])
def test_the_content_decides_on_the_format_whatever_the_name_says(name, tmp_path):
    for folder, data in (("raw", raw()), ("dat", dat()), ("aedat4", aedat4([EVENTS], SENSOR).data)):
        (tmp_path / folder).mkdir()
        assert_same(read(open_source(put(tmp_path / folder, name, data))), EVENTS)


@pytest.mark.parametrize(("ros", "mcap"), [(1, False), (2, False), (2, True)], ids=["bag", "db3", "mcap"])
@pytest.mark.parametrize("name", ["run.bag.active", "run", "run.db3", "run.mcap", "run.bag"])
def test_a_bag_opens_under_any_name(name, ros, mcap, tmp_path):
    path = bag(tmp_path, ros, mcap=mcap)
    other = tmp_path / "renamed" / name
    other.parent.mkdir()
    path.rename(other)
    assert_same(read(open_source(str(other))), EVENTS)


@pytest.mark.parametrize(("ros", "mcap"), [(1, False), (2, False), (2, True)], ids=["bag", "db3", "mcap"])
def test_prophesee_event_msgs_have_the_layout_of_dvs_msgs(ros, mcap, tmp_path):
    recording = open_source(str(bag(tmp_path, ros, mcap=mcap, kind=ros_bags.PROPHESEE)))
    assert recording.sensor == SENSOR
    assert_same(read(recording), EVENTS)


def test_a_bag_without_events_is_refused_with_its_topics_and_their_types(tmp_path):
    store = ros_bags.Store(2)
    messages = [("/imu", 5, store.of("std_msgs/msg/String", "a"))]
    with pytest.raises(UnknownSource, match=r"it has /imu \(std_msgs/String\); types with events are .*prophesee"):
        open_source(str(ros_bags.write_bag(tmp_path / "run", store, messages)))


# --- compression -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", COMPRESSORS)
def test_a_compressed_file_is_read_as_the_file_in_it(suffix, tmp_path):
    pack = COMPRESSORS[suffix]
    recording = open_source(put(tmp_path, "a.raw" + suffix, pack(raw())))
    assert recording.name == "a.raw"
    for _ in range(2):
        assert_same(read(recording), EVENTS)
    text = open_source(put(tmp_path, "events.txt" + suffix, pack(ecd_text(EVENTS))), SENSOR)
    assert_same(read(text), EVENTS)
    assert_same(read(open_source(put(tmp_path, "no_suffix", pack(raw())))), EVENTS)


def test_several_frames_or_members_are_one_file(tmp_path):
    data = raw()
    for name, pack in (("a.gz", gzip.compress), ("a.zst", zstandard.compress), ("a.bz2", bz2.compress)):
        packed = pack(data[:500]) + pack(data[500:])
        assert_same(read(open_source(put(tmp_path, name, packed))), EVENTS)


def test_the_compressed_files_of_a_bag_folder_are_read_in_order(tmp_path):
    store, folder = ros_bags.Store(2), tmp_path / "drive"
    folder.mkdir()
    for number, (first, stop) in enumerate([(0, 50), (50, 120), (120, 200)], start=9):
        part = ros_bags.dvs(store, EVENTS.span(first, stop))
        written = ros_bags.write_bag(tmp_path / f"part{number}", store, [(TOPIC, number, part)], mcap=True)
        packed = zstandard.compress(next(written.glob("*.mcap")).read_bytes())
        (folder / f"drive_{number}.mcap.zstd").write_bytes(packed)
    assert_same(read(open_source(str(folder))), EVENTS)
    assert_same(read(open_source(str(folder / "drive_9.mcap.zstd"))), EVENTS.span(0, 50))


@pytest.mark.parametrize("suffix", [".gz", ".zst", ".lz4"])
def test_a_truncated_compressed_file_gives_what_it_holds_and_says_so(suffix, tmp_path):
    events = make_events(60_000, seed=4)
    packed = COMPRESSORS[suffix](HEADER_EVT2 + write_evt2(events).words.tobytes())
    recording = open_source(put(tmp_path, "a.raw" + suffix, packed[: len(packed) * 2 // 3]))
    got, _ = read_broken(recording)
    assert 0 <= got.n < events.n
    assert_same(got, events.span(0, got.n))
    fault = next(one for one in recording.faults.unread if one.stream == "file")
    assert fault.where == "a.raw" + suffix
    assert "decompressed bytes" in fault.why


def test_a_compressed_file_without_a_complete_block_is_broken(tmp_path):
    with pytest.raises(BrokenRecording, match="broken at its compressed content: after 0 decompressed bytes"):
        open_source(put(tmp_path, "a.raw.bz2", bz2.compress(raw())[:-20]))


@pytest.mark.parametrize("suffix", [".gz", ".zst", ".bz2"])
def test_a_small_file_does_not_become_a_huge_one(suffix, tmp_path):
    zeros = bytes(4 * FREE_BYTES)
    packed = COMPRESSORS[suffix](HEADER_EVT3 + zeros)
    path = tmp_path / ("a.raw" + suffix)
    path.write_bytes(packed)
    plain = plain_file(path)
    assert f"more than {MAX_RATIO} times" in plain.why
    assert plain.path.stat().st_size <= FREE_BYTES + MAX_RATIO * len(packed) < len(zeros)


def test_a_copy_beyond_the_bound_is_refused_and_removed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    path = Path(put(tmp_path, "a.raw.gz", gzip.compress(os.urandom(1000))))
    with pytest.raises(UnknownSource, match="larger than 999 bytes, the bound for a temporary copy"):
        plain_file(path, max_bytes=999)
    assert not list((tmp_path / "tmp").iterdir())


# --- pipes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["raw", "dat", "aedat4", "text", "bag", "gz"])
def test_a_pipe_is_read_like_a_file_and_more_than_once(kind, tmp_path):
    data = {
        "raw": raw,
        "dat": dat,
        "aedat4": lambda: aedat4([EVENTS], SENSOR).data,
        "text": lambda: ecd_text(EVENTS),
        "bag": lambda: bag(tmp_path).read_bytes(),
        "gz": lambda: gzip.compress(raw()),
    }[kind]()
    with pipe(tmp_path / "pipe", data) as source:
        recording = open_source(source, SENSOR)
    for _ in range(2):
        assert_same(read(recording), EVENTS)


@pytest.mark.parametrize(("data", "why"), [(b"", "it gives nothing"), (bytes(100_000), "of no known format")])
def test_a_pipe_without_known_content_is_refused_by_name(data, why, tmp_path):
    with pipe(tmp_path / "pipe", data) as source, pytest.raises(UnknownSource, match=why) as caught:
        open_source(source)
    assert caught.value.details["value"] == source


def test_what_is_no_plain_file_is_refused(tmp_path):
    with pytest.raises(UnknownSource, match="no plain file, pipe or folder"):
        open_source("/dev/null")
    with pytest.raises(UnknownSource, match="the name of the source is empty"):
        open_source("")


def test_a_folder_with_a_link_to_a_missing_file_names_that_file(tmp_path):
    (tmp_path / "x.mcap").symlink_to(tmp_path / "gone.mcap")
    with pytest.raises(UnknownSource, match=r"No such file or directory: .*x\.mcap"):
        open_source(str(tmp_path))


# --- pointers --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "suffix", ["aedat4", "aedat", "raw", "dat", "es", "bag", "db3", "mcap", "txt", "h5", "mat", "zip"]
)
def test_a_git_lfs_pointer_is_named(suffix, tmp_path):
    pointer = LFS_POINTER + b"v1\noid sha256:" + b"ab" * 32 + b"\nsize 6144209\n"
    with pytest.raises(UnknownSource, match=r"this is a Git LFS pointer.*git lfs pull"):
        open_source(put(tmp_path, f"sample.{suffix}", pointer))


@pytest.mark.parametrize(
    "suffix", ["aedat4", "aedat", "raw", "dat", "es", "bag", "db3", "mcap", "txt", "h5", "mat", "zip"]
)
def test_a_file_of_zeros_raises_a_declared_error_or_gives_no_event(suffix, tmp_path):
    try:
        events, _ = read_broken(open_source(put(tmp_path, f"a.{suffix}", bytes(5000)), SENSOR))
    except RecordingError:
        events = Events.empty()
    assert events.n == 0


def test_a_pointer_among_the_files_of_a_recording_is_named(tmp_path):
    pointer = LFS_POINTER + b"v1\noid sha256:" + b"ab" * 32 + b"\nsize 6144209\n"
    for name, folder in (("run_0.db3", "bag"), ("events.txt", "ecd"), ("events.h5", "dsec")):
        (tmp_path / folder).mkdir()
        path = put(tmp_path / folder, name, pointer)
        with pytest.raises(UnknownSource, match="Git LFS pointer") as caught:
            open_source(path if folder == "dsec" else str(tmp_path / folder))
        assert caught.value.details["value"] == path


def test_a_pointer_in_place_of_poses_a_lens_or_a_model_is_named(tmp_path):
    pointer = put(tmp_path, "file", LFS_POINTER + b"v1\noid sha256:" + b"ab" * 32 + b"\nsize 6144209\n")
    for read_ in (
        read_poses,
        lambda path: read_calibration(str(path), SENSOR),
        lambda path: read_container(path.read_bytes(), "m"),
    ):
        with pytest.raises(NeuroVEError, match="Git LFS pointer"):
            read_(Path(pointer))


# --- temporary copies ------------------------------------------------------------------------------------------------


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def test_a_copy_of_what_is_no_recording_is_removed(temporary, tmp_path):
    with pytest.raises(UnknownSource):
        open_source(put(tmp_path, "a.raw.gz", gzip.compress(b"no recording")))
    with pipe(tmp_path / "pipe", gzip.compress(raw())) as source:
        open_source(source)
    assert [path.name for path in temporary.glob("*/*")] == ["pipe"]  # the decompressed one


def test_without_a_temporary_folder_or_space_the_error_is_declared(temporary, tmp_path):
    path = put(tmp_path, "a.raw.gz", gzip.compress(raw() * 1000))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))  # Python ignores the signal: writing fails
    try:
        with pytest.raises(UnknownSource, match="no temporary copy can be made in .*temporary.*: File too large"):
            open_source(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(temporary.iterdir())
    temporary.rmdir()
    with pytest.raises(UnknownSource, match="No such file or directory: .*temporary"):
        open_source(path)
