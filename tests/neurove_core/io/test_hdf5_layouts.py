"""HDF5 files of Prophesee, v2e, EDS and `events/xs`. The tests write the files."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from neurove_core.io import BrokenRecording, MissingFilter, MissingGeometry, UnknownSource
from neurove_core.sources import open_source
from neurove_protocol import Events, NeuroVEError, Sensor
from neurove_protocol.events import check_events
from tests.builders import SENSOR
from tests.datasets import CHUNK, EVENTS, corrupt_chunk
from tests.recordings import all_triggers, assert_same, read, read_broken

CD = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
EDGE = np.dtype({"names": ["p", "t", "id"], "formats": ["<i2", "<i8", "<i2"], "offsets": [0, 8, 16], "itemsize": 24})
ECF = 0x8ECF


def cd(events: Events) -> np.ndarray:
    rows = np.empty(events.n, CD)
    for name in "xypt":
        rows[name] = getattr(events, name)
    return rows


def prophesee(folder: Path) -> str:
    path = folder / "prophesee.hdf5"
    with h5py.File(path, "w") as file:
        file.create_dataset("CD/events", data=cd(EVENTS), chunks=(CHUNK,), compression="gzip")
        file["CD/indexes"] = np.zeros(3, [("id", "u8"), ("ts", "i8")])
        file["EXT_TRIGGER/events"] = np.array([(1, 5, 0), (0, 9, 0), (1, 12, 6)], EDGE)
        file.attrs["geometry"] = "64x48"
    return str(path)


def v2e(folder: Path) -> str:
    path = folder / "v2e.h5"
    with h5py.File(path, "w") as file:
        rows = np.stack([*EVENTS], axis=1).astype("u4")
        file.create_dataset("events", data=rows, chunks=(CHUNK, 4), maxshape=(None, 4), compression="gzip")
    return str(path)


def eds(folder: Path) -> str:
    path = folder / "events.h5"
    with h5py.File(path, "w") as file:
        for name in "txyp":
            column = getattr(EVENTS, name)
            file.create_dataset(name, data=column, chunks=(CHUNK,), compression=hdf5plugin.Blosc(cname="zstd"))
    return str(path)


def xs(folder: Path, names: str = "xs ys ts ps", resolution: tuple[int, int] | None = (48, 64)) -> str:
    path = folder / "xs.h5"
    columns = (EVENTS.x.astype("i2"), EVENTS.y.astype("i2"), EVENTS.t / 1e6, EVENTS.p == 1)
    with h5py.File(path, "w") as file:
        for name, column in zip(names.split(), columns, strict=True):
            file.create_dataset(f"events/{name}", data=column, chunks=(CHUNK,))
        if resolution:
            file.attrs["sensor_resolution"] = resolution
    return str(path)


def old_xs(folder: Path) -> str:
    return xs(folder, "x y ts p")


LAYOUTS: tuple[Callable[[Path], str], ...] = (prophesee, v2e, eds, xs, old_xs)
each_layout = pytest.mark.parametrize("written", LAYOUTS)


@each_layout
def test_each_layout_gives_the_same_events(written, tmp_path):
    recording = open_source(written(tmp_path), SENSOR)
    assert_same(read(recording), EVENTS)
    assert recording.sensor == SENSOR
    after_us = int(EVENTS.t[400])
    first = int(EVENTS.t.searchsorted(after_us))
    assert_same(Events.join(list(recording.since(after_us))), EVENTS.span(first, EVENTS.n))
    with pytest.raises(UnknownSource, match="no topic 'left'"):
        open_source(written(tmp_path), topic="left")


def test_the_sensor_comes_from_the_file_where_it_has_one(tmp_path):
    assert open_source(prophesee(tmp_path)).sensor == SENSOR
    assert open_source(xs(tmp_path)).sensor == SENSOR
    assert open_source(xs(tmp_path, resolution=(64, 48))).sensor == SENSOR
    assert open_source(eds(tmp_path)).sensor == Sensor(640, 480)
    for path in (v2e(tmp_path), xs(tmp_path, resolution=None)):
        with pytest.raises(MissingGeometry, match="give --sensor WIDTHxHEIGHT"):
            open_source(path)


def test_the_error_for_an_event_outside_the_assumed_sensor_names_the_flag(tmp_path):
    path = eds(tmp_path)
    with h5py.File(path, "r+") as file:
        file["x"][500] = 700
    _, error = read_broken(open_source(path))
    assert error is not None
    assert "x=700" in error.message
    assert "640x480, which is EDS's" in error.message
    assert "--sensor" in error.message


@pytest.mark.parametrize("geometry", ["64", "64x", "0x48", "axb", b"64x-1"])
def test_an_invalid_geometry_is_refused_and_named(geometry, tmp_path):
    path = prophesee(tmp_path)
    with h5py.File(path, "r+") as file:
        file.attrs["geometry"] = geometry
    with pytest.raises(BrokenRecording, match="attribute geometry"):
        open_source(path)
    assert_same(read(open_source(path, SENSOR)), EVENTS)


def test_the_triggers_of_a_prophesee_file_are_read(tmp_path):
    recording = open_source(prophesee(tmp_path))
    assert recording.streams == ("events", "triggers")
    triggers = all_triggers(recording)
    assert triggers.t.tolist() == [5, 9, 12]
    assert triggers.channel.tolist() == [0, 0, 6]
    assert triggers.level.tolist() == [1, 0, 1]
    assert list(open_source(v2e(tmp_path), SENSOR).triggers()) == []


def test_times_of_events_xs_are_seconds_if_they_are_floats_and_otherwise_us(tmp_path):
    path = xs(tmp_path)
    with h5py.File(path, "r+") as file:
        del file["events/ts"]
        file["events/ts"] = EVENTS.t
    assert_same(read(open_source(path)), EVENTS)


def packed_with(path: Path, number: int, data: bytes, mask: int) -> str:
    """A Prophesee file whose events have an optional filter of this number, which this machine need not have."""
    with h5py.File(path, "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((EVENTS.n,))
        plist.set_filter(number, h5py.h5z.FLAG_OPTIONAL, (1, 2))
        space = h5py.h5s.create_simple((EVENTS.n,))
        events = h5py.h5d.create(
            file.create_group("CD").id, b"events", h5py.h5t.py_create(CD, logical=True), space, plist
        )
        events.write_direct_chunk((0,), data, mask)
        file.attrs["geometry"] = "64x48"
    return str(path)


@pytest.mark.parametrize(("number", "name"), [(ECF, "ECF (HDF5 filter 36559)"), (41000, "HDF5 filter 41000")])
def test_a_filter_that_is_not_installed_is_named_with_its_cure(number, name, tmp_path):
    path = packed_with(tmp_path / "ecf.hdf5", number, b"packed events", 0)
    with pytest.raises(MissingFilter) as caught:
        open_source(path)
    assert name in caught.value.message
    assert "HDF5_PLUGIN_PATH" in caught.value.message
    assert caught.value.details["filter"] == number
    assert caught.value.code == "missing_filter"


PLUGIN = """
#include <stddef.h>
typedef struct {
    int version, id;
    unsigned encoder, decoder;
    const char *name;
    void *can_apply, *set_local;
    size_t (*filter)(unsigned, size_t, const unsigned *, size_t, size_t *, void **);
} H5Z_class2;
static size_t invert(unsigned flags, size_t n, const unsigned *values, size_t size, size_t *space, void **data) {
    for (size_t i = 0; i < size; i++) ((unsigned char *)*data)[i] ^= 0xFF;
    return size;
}
static const H5Z_class2 info = {1, 0x8ECF, 1, 1, "inverts", 0, 0, invert};
int H5PLget_plugin_type(void) { return 0; }
const void *H5PLget_plugin_info(void) { return &info; }
"""
"""A filter with the number of ECF that inverts all bits. It stands for Prophesee's, which is not distributed by pip."""

READ = """
import sys
from neurove_core.sources import open_source
print(sum(chunk.n for chunk in open_source(sys.argv[1]).chunks()))
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_filter_in_the_folder_of_hdf5_plugin_path_is_used(tmp_path):
    path = packed_with(tmp_path / "ecf.hdf5", ECF, bytes(0xFF ^ byte for byte in cd(EVENTS).tobytes()), 0)
    (tmp_path / "plugin").mkdir()
    (tmp_path / "plugin.c").write_text(PLUGIN)
    library = str(tmp_path / "plugin/libecf.so")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, str(tmp_path / "plugin.c")], check=True, timeout=60)
    environment = os.environ | {"HDF5_PLUGIN_PATH": str(tmp_path / "plugin")}
    ran = subprocess.run(
        [sys.executable, "-c", READ, path], env=environment, capture_output=True, text=True, timeout=60
    )
    assert ran.stdout == "1000\n", ran.stderr


def test_a_chunk_that_is_stored_without_its_optional_filter_is_read(tmp_path):
    path = packed_with(tmp_path / "plain.hdf5", ECF, cd(EVENTS).tobytes(), 1)
    assert_same(read(open_source(path)), EVENTS)


def test_events_of_another_type_are_refused_by_name(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["CD/events"] = np.zeros(4, [("x", "u2"), ("y", "u2"), ("t", "i8")])
    with pytest.raises(BrokenRecording, match="CD/events: expected records of t, x, y, p"):
        open_source(str(tmp_path / "a.hdf5"), SENSOR)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["events"] = np.zeros((4, 5))
    with pytest.raises(BrokenRecording, match=r"events: expected numbers of shape \(N, 4\)"):
        open_source(str(tmp_path / "b.h5"), SENSOR)


@each_layout
@pytest.mark.parametrize("seed", range(2))
def test_a_corrupt_file_is_refused_with_our_error_or_read_without_an_invalid_event(written, seed, tmp_path):
    data = Path(written(tmp_path)).read_bytes()
    rng = np.random.default_rng(seed)
    path = tmp_path / "corrupt.h5"
    for i in range(40):
        bad = bytearray(data)
        for at in rng.integers(0, len(data) if i % 2 else min(len(data), 8000), 8):
            bad[at] = rng.integers(0, 256)
        path.write_bytes(bad)
        try:
            recording = open_source(str(path), SENSOR)
            events, _ = read_broken(recording)
            check_events(events, SENSOR)
            list(recording.triggers())
        except NeuroVEError as error:
            assert str(tmp_path) in error.message  # noqa: PT017 the file may also be readable


def test_a_corrupt_chunk_of_records_is_named_by_its_row(tmp_path):
    path = Path(prophesee(tmp_path))
    with h5py.File(path) as file:
        corrupt_chunk(path, file["CD/events"], 4)
    events, error = read_broken(open_source(str(path)))
    assert_same(events.span(0, 4 * CHUNK), EVENTS.span(0, 4 * CHUNK))
    assert error is not None
    assert f"row {4 * CHUNK} of CD/events" in error.message
