"""A corrupt or truncated file is read or raises a NeuroVEError, and all data that is read is valid."""

from pathlib import Path

import numpy as np
import pytest

from neurove_core.io import Recording
from neurove_core.sources import open_source
from neurove_protocol import Events, NeuroVEError, Sensor
from neurove_protocol.events import check_events
from tests.builders import SENSOR, make_events
from tests.neurove_core.io import test_aedat2, test_carla, test_ecd, test_evbench, test_eventstream
from tests.neurove_core.io.test_prophesee import dat
from tests.recordings import put

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


WRITTEN = {
    "a.dat": lambda folder: dat(EVENTS),
    "a.es": lambda folder: test_eventstream.header() + b"".join(test_eventstream.write(EVENTS)),
    "a.aedat": lambda folder: aedat2(),
    "a.zip": lambda folder: Path(test_ecd.put_zip(folder, test_ecd.FILES)).read_bytes(),
    "a.mat": lambda folder: Path(test_evbench.put_mat(folder)).read_bytes(),
    "a.npz": lambda folder: Path(test_carla.written(folder, EVENTS)).read_bytes(),
}
each_format = pytest.mark.parametrize("name", WRITTEN)


def read_all(recording: Recording) -> None:
    """Read everything up to an error, and check the guarantees of every recording."""
    last_us = None
    for chunk in recording.chunks():
        check_events(chunk, recording.sensor, last_us)
        assert not (chunk.p > 1).any()
        last_us = int(chunk.t[-1])
    last_us = -(1 << 63)
    for imu in recording.imu():
        assert imu.t[0] >= last_us
        assert (np.diff(imu.t) >= 0).all()
        assert np.isfinite(imu.gyro_rad_s).all()
        last_us = int(imu.t[-1])
    assert isinstance(list(recording.triggers()), list)
    assert isinstance(list(recording.frames()), list)
    poses = recording.poses()
    if poses is not None:
        np.testing.assert_allclose(np.linalg.norm(poses.orientation, axis=1), 1)


def read_or_refused(path: str) -> None:
    try:
        read_all(open_source(path, DAVIS if path.endswith(("aedat", "mat")) else SENSOR))
    except NeuroVEError as error:
        assert path in error.message  # noqa: PT017 no error is valid too


@each_format
@pytest.mark.parametrize("seed", range(2))
def test_a_corrupt_file_is_read_or_raises_a_neurove_error(name, seed, tmp_path):
    data = WRITTEN[name](tmp_path)
    rng = np.random.default_rng(seed)
    for _ in range(60):
        corrupt = bytearray(data)
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            corrupt[at] = rng.integers(0, 256)
        read_or_refused(put(tmp_path, name, bytes(corrupt)))


@each_format
def test_a_truncated_file_is_read_or_raises_a_neurove_error(name, tmp_path):
    data = WRITTEN[name](tmp_path)
    for size in np.random.default_rng(0).integers(0, len(data), 60).tolist():
        read_or_refused(put(tmp_path, name, data[:size]))


@each_format
def test_the_suffix_of_a_file_may_be_in_capitals(name, tmp_path):
    sensor = DAVIS if name.endswith(("aedat", "mat")) else SENSOR
    recording = open_source(put(tmp_path, name.upper(), WRITTEN[name](tmp_path)), sensor)
    assert Events.join(list(recording.chunks())).n > 0
