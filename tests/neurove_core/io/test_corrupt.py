"""A damaged file of any format is read as far as possible or refused with a declared error; what is read is valid."""

import bz2
import struct
import tracemalloc
import zipfile

import h5py
import hdf5plugin
import numpy as np
import pytest

from neurove_core.io import BrokenRecording
from neurove_core.io.formats.pose_files import read_poses
from neurove_core.io.unpack import FREE_BYTES, MAX_RATIO, unpacked
from neurove_core.sources import open_source
from neurove_protocol import Events, NeuroVEError
from neurove_protocol.errors import InvalidField
from tests import ros_bags
from tests.builders import SENSOR, make_events
from tests.mutations import DAVIS, WRITTEN, mutated, read_or_refused
from tests.recordings import put, read

RUNS = 40

each_format = pytest.mark.parametrize("name", WRITTEN)


@each_format
def test_a_mutated_file_is_read_or_refused_with_a_declared_error(name, tmp_path):
    data = WRITTEN[name](tmp_path)
    rng = np.random.default_rng(sum(name.encode()))
    for _ in range(RUNS):
        error = read_or_refused(put(tmp_path, name, mutated(data, rng)), name)
        assert error is None or error.message


@each_format
def test_a_file_whose_name_is_in_capitals_is_read(name, tmp_path):
    sensor = DAVIS if name.endswith(("aedat", "mat")) else SENSOR
    recording = open_source(put(tmp_path, name.upper(), WRITTEN[name](tmp_path)), sensor)
    assert Events.join(list(recording.chunks())).n > 0
    assert not recording.faults.found


def test_pages_of_a_bag_that_come_again_are_not_read_again(tmp_path):
    """All later pages of the messages are replaced by the first one, so that SQLite gives its rows again and again."""
    store, events = ros_bags.Store(2), make_events(6000, duration_us=600_000)
    messages = [("/cam/events", i, ros_bags.dvs(store, events.span(100 * i, 100 * i + 100))) for i in range(60)]
    path = next(ros_bags.write_bag(tmp_path / "bag", store, messages).glob("*.db3"))
    data, size = bytearray(path.read_bytes()), 4096
    for page in range(size, len(data), size):
        cells = int.from_bytes(data[page + 3 : page + 5], "big")
        if data[page] == 5 and cells > 10:  # an inner page of a table: in each cell, four bytes give the page below
            pointers = struct.unpack_from(f">{cells}H", data, page + 12)
            for pointer in pointers[5:]:
                data[page + pointer : page + pointer + 4] = data[page + pointers[0] : page + pointers[0] + 4]
    path.write_bytes(data)
    recording = open_source(str(path))
    got = read(recording)
    assert 0 < got.n < events.n
    assert (np.diff(got.t) >= 0).all()
    assert any("the numbers must increase" in fault.why for fault in recording.faults.found)


# --- decompression is bounded --------------------------------------------------------------------------------------


def test_a_small_bag_that_decompresses_to_gigabytes_is_refused_at_once(tmp_path):
    packed = bz2.compress(bytes(32 << 20))
    assert len(packed) < 1000

    def record(header: dict[str, bytes], data: bytes) -> bytes:
        fields = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in header.items())
        return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data

    size = struct.pack("<I", (1 << 32) - 1)
    chunk = record({"op": b"\x05", "compression": b"bz2", "size": size}, packed)
    bag = b"#ROSBAG V2.0\n" + record({"op": b"\x03", "index_pos": bytes(8)}, b" " * 100) + chunk
    with pytest.raises(NeuroVEError):
        open_source(put(tmp_path, "a.bag", bag))
    data, why = unpacked("bz2", packed, 1 << 30)
    assert len(data) <= FREE_BYTES + MAX_RATIO * len(packed)
    assert "more than 250 times" in why


def test_a_zip_bomb_ends_the_events_with_the_reason(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr("events.txt", b"0.1 1 1 1\n" + b"\n" * (16 << 20))
    recording = open_source(str(tmp_path / "a.zip"))
    assert read(recording).n == 1
    assert "more than 250 times" in recording.faults.unread[0].why


def test_an_hdf5_file_of_few_bytes_and_many_rows_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "pxyt":
            file.create_dataset(f"events/{name}", data=np.zeros(8_000_000, "u8"), compression=hdf5plugin.Zstd())
    recording = open_source(str(tmp_path / "a.h5"))
    assert read(recording).n == 0
    assert "more than 250 times" in recording.faults.unread[0].why


@pytest.mark.parametrize(("at", "size", "why"), [(0, 1 << 20, "past the end"), (2, 3985, "free space")])
def test_a_damaged_heap_of_texts_is_refused_because_the_library_does_not_return(at, size, why, tmp_path):
    data = bytearray(WRITTEN["m3ed.h5"](tmp_path))
    place = data.index(b"GCOL\x01\0\0\0") + 16
    for _ in range(at):
        place += 16 + -(-struct.unpack_from("<Q", data, place + 8)[0] // 8) * 8
    struct.pack_into("<Q", data, place + 8, size)
    with pytest.raises(BrokenRecording, match=why):
        open_source(put(tmp_path, "a.h5", bytes(data)), SENSOR)


def test_many_poses_are_read_in_blocks(tmp_path):
    rows = 200_000
    with h5py.File(tmp_path / "gt.h5", "w") as file:
        file["davis/left/odometry_ts"] = np.arange(rows) / 200
        poses = np.zeros((rows, 4, 4))
        poses[:] = np.eye(4)
        file["davis/left/odometry"] = poses
    del poses
    tracemalloc.start()
    assert read_poses(tmp_path / "gt.h5").t.size == rows
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 << 20


def test_more_poses_than_the_limit_are_refused(tmp_path):
    rows = (1 << 20) + 1
    with h5py.File(tmp_path / "gt.h5", "w") as file:
        file["davis/left/odometry_ts"] = np.zeros(rows)
        file.create_dataset("davis/left/odometry", (rows, 4, 4), "f8", chunks=(100, 4, 4))[0] = np.eye(4)
    with pytest.raises(InvalidField, match="at most 1048576"):
        read_poses(tmp_path / "gt.h5")


def test_poses_that_compress_to_nothing_are_refused(tmp_path):
    with h5py.File(tmp_path / "gt.h5", "w") as file:
        file["davis/left/odometry_ts"] = np.arange(900_000) / 200
        file.create_dataset("davis/left/odometry", (900_000, 4, 4), "f8", chunks=(5000, 4, 4), compression="gzip")
        file["davis/left/odometry"][:5000] = np.eye(4)
    with pytest.raises(BrokenRecording, match="more than 250 times"):
        read_poses(tmp_path / "gt.h5")
