"""Small files of every format, and how they are damaged: for the gate and for `tests.long.fuzz`."""

import gzip
import io
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import zstandard

from neurove_core.io import Recording
from neurove_core.io.formats.packet_log.writer import write_mcap
from neurove_core.sources import open_source
from neurove_protocol import NeuroVEError, Sensor
from neurove_protocol.events import check_events
from tests import datasets, ros_bags
from tests.builders import SENSOR, make_events
from tests.builders_evt import (
    HEADER_EVT2,
    HEADER_EVT3,
    HEADER_EVT4,
    HEADER_EVT21,
    legacy,
    write_evt2,
    write_evt3,
    write_evt4,
    write_evt21,
)
from tests.neurove_core.io import (
    test_aedat2,
    test_aedat3,
    test_carla,
    test_ecd,
    test_evbench,
    test_eventstream,
    test_hdf5_layouts,
    test_npy,
)
from tests.neurove_core.io.test_prophesee import dat
from tests.neurove_core.io.test_rosbag import imu_and_pose, in_packets
from tests.recordings import aedat4, ecd_text, put

EVENTS = make_events(200, seed=1)
DAVIS = Sensor(240, 180)


def aedat2() -> bytes:
    events = make_events(100, seed=1, sensor=DAVIS)
    samples = test_aedat2.imu_words(list(range(7)))
    return (
        test_aedat2.header(b"DAVIS240C", test_aedat2.SCALE % (1000, 8))
        + test_aedat2.pairs(test_aedat2.davis(events, DAVIS), events.t)
        + test_aedat2.pairs(samples, np.full(7, events.t[-1]))
    )


def aedat3() -> bytes:
    events = make_events(100, seed=1, sensor=DAVIS)
    others = test_aedat3.special((2, 3), (3, 9)) + test_aedat3.imu(5, (0, -1, 0), (1, 2, 3))
    return test_aedat3.DAVIS240 + others + test_aedat3.polarity(events) + others


def words_in_bag(folder: Path, ros: int, encoding: str) -> bytes:
    """A bag with Prophesee words in a few messages."""
    store = ros_bags.Store(ros)
    words = (write_evt21 if encoding == "evt21" else write_evt4)(EVENTS).words
    messages = [
        ("/cam/events", 10**9 + seq, ros_bags.packet(store, part.tobytes(), ns=10**9, seq=seq, encoding=encoding))
        for seq, part in enumerate(np.array_split(words, 5))
    ]
    path = ros_bags.write_bag(folder / f"{encoding}.bag", store, messages)
    return (path if path.is_file() else next(path.glob("*.db3"))).read_bytes()


def bag(folder: Path, ros: int, *, mcap: bool = False, compression: str = "", dvs: bool = False) -> bytes:
    """A bag with events and poses."""
    store = ros_bags.Store(ros)
    messages = list(in_packets(store, EVENTS, per=40, encoding="mono"))
    if dvs:
        messages = [("/dvs/events", 1_000_000_000, ros_bags.dvs(store, EVENTS))]
    for i in range(3):
        messages += list(imu_and_pose(store, i))
    name = f"bag{ros}{mcap}{compression}{dvs}" + (".bag" if ros == 1 else "")
    path = ros_bags.write_bag(folder / name, store, messages, compression=compression, mcap=mcap)
    file = path if path.is_file() else next(path.glob("*.mcap" if mcap else "*.db3"))
    return file.read_bytes()


def packet_log(folder: Path) -> bytes:
    write_mcap(open_source(put(folder, "log.txt", ecd_text(EVENTS)), SENSOR), folder / "log.mcap")
    return (folder / "log.mcap").read_bytes()


def _at(path: str) -> bytes:
    return Path(path).read_bytes()


def _npy(_: Path) -> bytes:
    out = io.BytesIO()
    np.save(out, np.stack([EVENTS.t, EVENTS.x, EVENTS.y, EVENTS.p], axis=1))
    return out.getvalue()


WRITTEN: Final[dict[str, Callable[[Path], bytes]]] = {
    "evt2.raw": lambda _: HEADER_EVT2 + write_evt2(EVENTS).words.tobytes(),
    "evt3.raw": lambda _: HEADER_EVT3 + write_evt3(EVENTS).words.tobytes(),
    "evt21.raw": lambda _: HEADER_EVT21 + write_evt21(EVENTS).words.tobytes(),
    "legacy.raw": lambda _: HEADER_EVT21 + legacy(write_evt21(EVENTS).words).tobytes(),
    "evt4.raw": lambda _: HEADER_EVT4 + write_evt4(EVENTS).words.tobytes(),
    "evt4.raw.zst": lambda _: zstandard.compress(HEADER_EVT4 + write_evt4(EVENTS).words.tobytes()),
    "a.bin": lambda _: test_npy.atis(test_npy.DIGIT),
    "a.npy": _npy,
    "a.dat": lambda _: dat(EVENTS),
    "a.es": lambda _: test_eventstream.header() + b"".join(test_eventstream.write(EVENTS)),
    "a.aedat": lambda _: aedat2(),
    "aedat3.aedat": lambda _: aedat3(),
    "a.aedat4": lambda _: aedat4([EVENTS.span(0, 80), EVENTS.span(80, 200)], SENSOR).data,
    "a.txt": lambda _: ecd_text(EVENTS),
    "a.csv": lambda _: b"t,x,y,p\n" + b"\n".join(b"%d,%d,%d,%d" % row for row in zip(*EVENTS, strict=True)),
    "gzip.txt.gz": lambda _: gzip.compress(ecd_text(EVENTS)),
    "a.zip": lambda folder: _at(test_ecd.put_zip(folder, test_ecd.FILES)),
    "a.mat": lambda folder: _at(test_evbench.put_mat(folder)),
    "a.npz": lambda folder: _at(test_carla.written(folder, EVENTS)),
    "ros1.bag": lambda folder: bag(folder, 1),
    "bz2.bag": lambda folder: bag(folder, 1, compression="bz2"),
    "lz4.bag": lambda folder: bag(folder, 1, compression="lz4", dvs=True),
    "a.db3": lambda folder: bag(folder, 2),
    "ros2.mcap": lambda folder: bag(folder, 2, mcap=True, dvs=True),
    "evt21.db3": lambda folder: words_in_bag(folder, 2, "evt21"),
    "evt4.bag": lambda folder: words_in_bag(folder, 1, "evt4"),
    "log.mcap": packet_log,
    "mvsec.hdf5": lambda folder: _at(datasets.mvsec_file(folder)),
    "dsec.h5": lambda folder: _at(datasets.dsec_file(folder)),
    "m3ed.h5": lambda folder: _at(datasets.m3ed_file(folder)),
    "own.h5": lambda folder: _at(datasets.own_file(folder)),
    "prophesee.hdf5": lambda folder: _at(test_hdf5_layouts.prophesee(folder)),
    "v2e.h5": lambda folder: _at(test_hdf5_layouts.v2e(folder)),
}
"""Name of a file of each format, and a function that gives its bytes; it may write into the folder."""


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with one kind of damage: bytes changed, removed, repeated or zeroed, or the end removed."""
    damaged = bytearray(data)
    first, second = np.sort(rng.integers(0, len(data) + 1, 2)).tolist()
    stop = min(second, first + int(rng.integers(1, 64)))
    match int(rng.integers(0, 6)):
        case 0 | 1:
            for at in rng.integers(0, len(data), rng.integers(1, 5)).tolist():
                damaged[at] = int(rng.integers(0, 256))
        case 2:
            return data[:second]
        case 3:
            del damaged[first:stop]
        case 4:
            damaged[stop:stop] = damaged[first:stop]
        case _:
            damaged[first:stop] = bytes([rng.choice([0, 255])]) * (stop - first)
    return bytes(damaged)


def read_all(recording: Recording) -> None:
    """Read everything of a recording, and check the guarantees of every recording."""
    last_us = None
    for chunk in recording.chunks():
        check_events(chunk, recording.sensor, last_us)
        assert not (chunk.p > 1).any()
        last_us = int(chunk.t[-1])
    last_us = -(1 << 63)
    for imu in recording.imu():
        assert imu.t[0] >= last_us
        assert (np.diff(imu.t) >= 0).all()
        last_us = int(imu.t[-1])
    assert isinstance(list(recording.triggers()), list)
    assert isinstance(list(recording.frames()), list)
    poses = recording.poses()
    if poses is not None:
        np.testing.assert_allclose(np.linalg.norm(poses.orientation, axis=1), 1)
    recording.twists()
    recording.camera("cam0")
    for fault in recording.faults.found:
        assert fault.count > 0
        assert len(str(fault)) < 5000


def read_or_refused(path: str, name: str) -> NeuroVEError | None:
    """Read a damaged file; the declared error that refuses it, or None."""
    sensor = DAVIS if name.endswith(("aedat", "mat")) else SENSOR
    try:
        recording = open_source(path, sensor)
        read_all(recording)
        list(recording.since(500))
    except NeuroVEError as error:
        return error
    return None
