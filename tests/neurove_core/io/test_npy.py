"""Events in NumPy arrays (.npy, .npz, EVIMO, EVIMO2), and the .bin files of N-MNIST. The tests write the files."""

import gzip
import io
import os
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neurove_core.io import DoubtfulUnit, MissingGeometry, RecordingError, UnknownSource
from neurove_core.io.recording import CHUNK_EVENTS
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from neurove_protocol.events import check_events
from tests.builders import SENSOR, make_events
from tests.recordings import assert_same, put, read, read_broken

EVENTS = make_events(2000, seed=6, start_us=3_000_000)
T, X, Y, P = EVENTS
SECONDS = T / 1e6


def records(dtype: list[tuple[str, str]], **columns: Any) -> np.ndarray:
    rows = np.zeros(EVENTS.n, dtype)
    for name, column in columns.items():
        rows[name] = column
    return rows


ARRAYS = {
    "records": records([("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")], t=T, x=X, y=Y, p=P),
    "records, signed, with others": records(
        [("ts", "f8"), ("w", "f4"), ("x", "u2"), ("y", "u2"), ("polarity", "i1")],
        ts=SECONDS,
        x=X,
        y=Y,
        polarity=P * 2 - 1,
    ),
    "records, ns": records([("t_ns", ">i8"), ("x", "u1"), ("y", "u1"), ("p", "i4")], t_ns=T * 1000, x=X, y=Y, p=P),
    "records (N, 1)": records([("x", "i2"), ("y", "i2"), ("t", "i8"), ("p", "i2")], t=T, x=X, y=Y, p=P)[:, None],
    "t x y p": np.stack([T, X, Y, P], axis=1),
    "t x y p, float": np.stack([SECONDS, X, Y, P * 2.0 - 1], axis=1),
    "t x y p, float us": np.stack([T, X, Y, P], axis=1).astype("f8"),
    "x y t p": np.stack([X, Y, T, P], axis=1),
    "x y p t": np.stack([X, Y, P, SECONDS], axis=1),
    "(4, N)": np.stack([X, Y, T, P]),
    "(4, N) transposed": np.stack([SECONDS, X, Y, P]).T,
    "(N, 4) transposed": np.stack([X, Y, T, P], axis=1).T,
}


@pytest.mark.parametrize("name", ARRAYS)
def test_each_array_gives_the_same_events_from_a_file_and_from_an_archive(name, tmp_path):
    np.save(tmp_path / "a.npy", ARRAYS[name])
    np.savez(tmp_path / "b.npz", labels=np.zeros(3), events=ARRAYS[name])
    np.savez_compressed(tmp_path / "c.npz", event_data=ARRAYS[name])
    for file in ("a.npy", "b.npz", "c.npz"):
        recording = open_source(str(tmp_path / file), SENSOR)
        assert_same(read(recording), EVENTS)
        assert recording.faults.found == ()
        assert recording.name == file
    with pytest.raises(MissingGeometry, match="give --sensor"):
        open_source(str(tmp_path / "a.npy"))
    with pytest.raises(UnknownSource, match="no topic 'left'"):
        open_source(str(tmp_path / "a.npy"), topic="left")


def test_the_content_decides_before_the_suffix(tmp_path):
    np.save(tmp_path / "a.npy", ARRAYS["t x y p"])
    np.savez(tmp_path / "b.npz", events=ARRAYS["t x y p"])
    (tmp_path / "a.npy").rename(tmp_path / "a.data")
    (tmp_path / "b.npz").rename(tmp_path / "b")
    with gzip.open(tmp_path / "c.npy.gz", "wb") as file:
        np.save(file, ARRAYS["t x y p"])  # type: ignore[arg-type]
    for name in ("a.data", "b", "c.npy.gz"):
        assert_same(read(open_source(str(tmp_path / name), SENSOR)), EVENTS)
    with pytest.raises(UnknownSource, match=r"d\.npy is not a NumPy array"):
        open_source(put(tmp_path, "d.npy", b"no array"))


def test_an_implausible_unit_of_time_is_refused_with_a_guess_and_the_caller_can_give_it(tmp_path):
    np.save(tmp_path / "a.npy", np.stack([T * 1000 + 10**18, X, Y, P], axis=1))
    with pytest.raises(DoubtfulUnit, match="probably they are in ns: give --time-unit ns"):
        open_source(str(tmp_path / "a.npy"), SENSOR)
    got = read(open_source(str(tmp_path / "a.npy"), SENSOR, time_unit="ns"))
    assert_same(got, EVENTS._replace(t=T + 10**15))
    np.save(tmp_path / "b.npy", np.stack([T // 1000, X, Y, P], axis=1))
    got = read(open_source(str(tmp_path / "b.npy"), SENSOR, time_unit="ms"))
    assert_same(got, EVENTS._replace(t=T // 1000 * 1000))


def test_an_archive_with_one_array_for_each_column_is_read(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", x=X, y=Y, t=SECONDS, p=P == 1, label=3)
    assert_same(read(open_source(str(tmp_path / "a.npz"), SENSOR)), EVENTS)


def evimo2(folder: Path, image: str = "dataset_depth.npz") -> str:
    folder.mkdir()
    np.save(folder / "dataset_events_t.npy", SECONDS[:, None])
    np.save(folder / "dataset_events_xy.npy", np.stack([X, Y], axis=1))
    np.save(folder / "dataset_events_p.npy", P[:, None])
    np.savez(folder / image, depth_0000000000=np.zeros((48, 64), "u2"))
    np.savez(folder / "dataset_info.npz", meta=np.array({"a": 1}, object), K=np.eye(3))
    return str(folder)


@pytest.mark.parametrize("image", ["dataset_depth.npz", "dataset_mask.npz", "dataset_classical.npz"])
def test_a_folder_of_evimo2_gives_events_and_the_sensor_of_its_images(image, tmp_path):
    folder = evimo2(tmp_path / "scene13_dyn_test_00", image)
    for source in (folder, f"{folder}/dataset_events_t.npy", f"{folder}/dataset_info.npz"):
        recording = open_source(source)
        assert_same(read(recording), EVENTS)
        assert recording.sensor == SENSOR
    assert open_source(folder, Sensor(640, 480)).sensor == Sensor(640, 480)
    os.remove(f"{folder}/{image}")  # noqa: PTH107
    with pytest.raises(MissingGeometry):
        open_source(folder)


def test_an_archive_of_evimo_gives_events_and_the_sensor_of_its_depth(tmp_path):
    rows = np.stack([SECONDS, X, Y, P], axis=1)
    np.savez(tmp_path / "a.npz", events=rows, depth=np.zeros((2, 48, 64)), meta=np.array({"a": 1}, object))
    recording = open_source(str(tmp_path / "a.npz"))
    assert_same(read(recording), EVENTS)
    assert recording.sensor == SENSOR


@pytest.mark.parametrize(
    ("array", "why"),
    [
        (np.zeros(4), r"expected numbers of shape \(N, 4\), not float64 of \(4,\)"),
        (np.zeros((9, 5)), r"expected numbers of shape \(N, 4\)"),
        (np.zeros((9, 4), "c16"), r"expected numbers of shape \(N, 4\), not complex128"),
        (np.zeros(9, [("t", "i8"), ("x", "i2"), ("y", "i2")]), "no column is named as the polarity"),
        (np.zeros(9, [("t", "S3"), ("x", "i2"), ("y", "i2"), ("p", "i2")]), "expected records of numbers"),
        (np.array([{"a": 1}], object), "holds Python objects, which are not read"),
        (np.stack([X, Y, X, Y], axis=1), "no column is a polarity of 0 and 1 or of -1 and 1; save it as records"),
        (np.tile([5, 7, 1, 100], (300, 1)), "the time can be column 1 or 2 or 4; save it as records"),
    ],
)
def test_an_array_without_clear_events_is_refused_with_the_reason(array, why, tmp_path):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(UnknownSource, match=why):
        open_source(str(tmp_path / "a.npy"), SENSOR)


def test_invalid_events_are_skipped_and_counted_by_reason(tmp_path):
    rows = np.stack([SECONDS, X, Y, P], axis=1)
    rows[[500, 510], 1] = 1.5
    rows[600, 0] = np.nan
    rows[700, 3] = 7
    rows[800, 1] = 64
    rows[900, 0] -= 0.5
    np.save(tmp_path / "a.npy", rows)
    recording = open_source(str(tmp_path / "a.npy"), SENSOR)
    keep = np.delete(np.arange(EVENTS.n), [500, 510, 600, 700, 800, 900])
    assert_same(read(recording), Events(*(column[keep] for column in EVENTS)))
    found = {(fault.reason.value, fault.count, fault.where) for fault in recording.faults.found}
    assert found == {("invalid", 4, "event 600"), ("outside_sensor", 1, "event 800"), ("late", 1, "event 900")}


@pytest.mark.parametrize("name", ["t x y p", "(4, N)", "records"])
def test_a_truncated_array_gives_its_complete_events_and_then_names_the_row(name, tmp_path):
    np.save(tmp_path / "a.npy", ARRAYS[name])
    data = (tmp_path / "a.npy").read_bytes()
    events, error = read_broken(open_source(put(tmp_path, "a.npy", data[: len(data) - 3]), SENSOR))
    assert_same(events, EVENTS.span(0, EVENTS.n - 1))
    assert error is not None
    assert "row 1999" in error.message
    assert "the file ends here, expected 2000 rows" in error.message


def test_arrays_of_unequal_length_give_their_common_rows_and_then_an_error(tmp_path):
    np.savez(tmp_path / "a.npz", x=X, y=Y[:900], t=T, p=P)
    events, error = read_broken(open_source(str(tmp_path / "a.npz"), SENSOR))
    assert_same(events, EVENTS.span(0, 900))
    assert error is not None
    assert "unequal lengths: [2000, 2000, 900, 2000]" in error.message


def test_a_header_that_claims_more_than_the_file_has_takes_no_memory(tmp_path):
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<i8", "fortran_order": False, "shape": (200_000_000_000, 4)})
    path = put(tmp_path, "b.npy", file.getvalue() + ARRAYS["t x y p"].tobytes())
    tracemalloc.start()
    events, error = read_broken(open_source(path, SENSOR))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert_same(events, EVENTS)
    assert error is not None
    assert "expected 200000000000 rows" in error.message
    assert peak < 32 << 20


def test_a_long_array_in_an_archive_is_read_in_bounded_memory(tmp_path):
    events = make_events(500_000, seed=2, start_us=5, duration_us=3_000_000)
    np.savez_compressed(tmp_path / "a.npz", events=np.stack([*events]))
    recording = open_source(str(tmp_path / "a.npz"), SENSOR)
    tracemalloc.start()
    sizes = [chunk.n for chunk in recording.chunks()]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert max(sizes) <= CHUNK_EVENTS
    assert sum(sizes) == events.n
    assert peak < 48 << 20


def test_an_archive_that_unpacks_to_far_more_than_it_holds_is_stopped(tmp_path):
    with (
        zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("events.npy", "w") as file,
    ):
        np.lib.format.write_array_header_1_0(file, {"descr": "<i8", "fortran_order": False, "shape": (10**7, 4)})
        for _ in range(40):
            file.write(bytes(1 << 20))
    recording = open_source(str(tmp_path / "a.npz"), SENSOR)
    assert sum(chunk.n for chunk in recording.chunks()) < (40 << 20) // 32
    assert "become more than 250 times as many" in recording.faults.unread[0].why


# --- N-MNIST ---------------------------------------------------------------------------------------------------------

SMALL = Sensor(34, 34)
DIGIT = make_events(500, seed=3, sensor=SMALL, duration_us=300_000)


def atis(events: Events) -> bytes:
    words = (events.x.astype(np.int64) << 32) | (events.y.astype(np.int64) << 24) | (events.p.astype(np.int64) << 23)
    return b"".join(int(word).to_bytes(5, "big") for word in words | events.t)


def test_a_bin_of_n_mnist_gives_its_events(tmp_path):
    recording = open_source(put(tmp_path, "00002.bin", atis(DIGIT)))
    assert_same(read(recording), DIGIT)
    assert recording.sensor == SMALL


def test_an_overflow_in_a_bin_adds_to_the_times_and_is_no_event(tmp_path):
    overflow = (240 << 24).to_bytes(5, "big")
    data = atis(DIGIT.span(0, 200)) + overflow + atis(DIGIT.span(200, 400)) + overflow + atis(DIGIT.span(400, 500))
    want = DIGIT.t + np.repeat([0, 8192, 16384], [200, 200, 100])
    assert_same(read(open_source(put(tmp_path, "a.bin", data))), DIGIT._replace(t=want))


def test_the_error_for_a_bin_of_n_caltech101_names_the_sensor(tmp_path):
    events = make_events(300, seed=3, sensor=Sensor(240, 180), duration_us=300_000)
    path = put(tmp_path, "a.bin", atis(events))
    _, error = read_broken(open_source(path))
    assert error is not None
    assert "give --sensor 240x180 for N-Caltech101" in error.message
    assert_same(read(open_source(path, Sensor(240, 180))), events)


def test_a_truncated_bin_gives_its_complete_events_and_the_byte_and_another_format_is_refused(tmp_path):
    events, error = read_broken(open_source(put(tmp_path, "a.bin", atis(DIGIT)[:-2])))
    assert_same(events, DIGIT.span(0, 499))
    assert error is not None
    assert error.details["where"] == "byte 2495"
    with pytest.raises(UnknownSource, match="not ordered, so it is not a .bin of N-MNIST"):
        open_source(put(tmp_path, "b.bin", np.random.default_rng(0).bytes(1000)))


# --- mutated files ---------------------------------------------------------------------------------------------------


def saved(name: str, save: Callable[..., None], **arrays: np.ndarray) -> Callable[[Path], str]:
    def write(folder: Path) -> str:
        save(folder / name, *arrays.values()) if name.endswith(".npy") else save(folder / name, **arrays)
        return str(folder / name)

    return write


WRITTEN = {
    "records.npy": saved("records.npy", np.save, a=ARRAYS["records"][:60]),
    "matrix.npy": saved("matrix.npy", np.save, a=ARRAYS["x y t p"][:60]),
    "events.npz": saved("events.npz", np.savez_compressed, events=ARRAYS["(4, N)"][:, :60]),
    "columns.npz": saved("columns.npz", np.savez, t=SECONDS[:60], x=X[:60], y=Y[:60], p=P[:60]),
    "a.bin": lambda folder: put(folder, "a.bin", atis(DIGIT)),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_mutated_file_gives_valid_events_or_a_declared_error(name, tmp_path):
    data = Path(WRITTEN[name](tmp_path)).read_bytes()
    rng = np.random.default_rng(len(name))
    for i in range(300):
        bad = bytearray(data)
        for at in rng.integers(0, len(data) if i % 2 else min(len(data), 130), 1 + i % 4):
            bad[at] = rng.integers(0, 256)
        path = put(tmp_path, name, bytes(bad[: rng.integers(0, len(bad))] if i % 5 == 0 else bad))
        try:
            events, _ = read_broken(open_source(path, SENSOR))
            check_events(events, SENSOR)
        except RecordingError as error:
            assert str(tmp_path) in error.message  # noqa: PT017 the file may also be readable
