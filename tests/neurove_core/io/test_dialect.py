"""Events as text: other columns, separators, headers and units than those of the Event Camera Dataset."""

import numpy as np
import pytest

from neurove_core.io import MissingGeometry, UnknownSource
from neurove_core.io.formats.columns import Columns, Unclear, by_name, by_values
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from tests.builders import SENSOR, make_events
from tests.recordings import assert_same, put, read, read_broken

EVENTS = make_events(400, seed=4, start_us=1_000_000)


def rows(order: str = "txyp", *, unit: str = "s", signed: bool = False, sep: str = " ", end: str = "\n") -> str:
    """One line for each event, with these columns."""
    lines = []
    for t, x, y, p in zip(*(column.tolist() for column in EVENTS), strict=True):
        time = f"{t // 1_000_000}.{t % 1_000_000:06d}" if unit == "s" else str(t * {"us": 1, "ns": 1000}[unit])
        values = {"t": time, "x": str(x), "y": str(y), "p": str(2 * p - 1 if signed else p), "a": "0.5"}
        lines.append(sep.join(values[name] for name in order) + end)
    return "".join(lines)


DIALECTS = {
    "mark": ("\ufeff" + rows()).encode(),
    "mark and header": ("\ufefft x y p\n" + rows()).encode(),
    "minus": rows(signed=True).encode(),
    "size first": ("64 48\n" + rows()).encode(),
    "size, then a header": ("64 48\ntimestamp x y polarity\n" + rows()).encode(),
    "header": ("timestamp x y polarity\n" + rows()).encode(),
    "header in a comment": ("# made today\n# x y t p\n" + rows("xytp")).encode(),
    "header with a unit": ("x, y, timestamp [us], pol\n" + rows("xytp", unit="us", sep=", ")).encode(),
    "header with a unit and spaces": ("x y time [ns] pol\n" + rows("xytp", unit="ns")).encode(),
    "header in quotes": ('"Time_s";"X";"Y";"Polarity"\n' + rows(sep=";")).encode(),
    "header with other columns": (",t,x,a,y,p\n" + rows("atxayp", sep=",")).encode(),
    "commas": rows(sep=",").encode(),
    "tabs": rows(sep="\t").encode(),
    "decimal commas": rows(sep=";").replace(".", ",").encode(),
    "decimal commas and tabs": rows(sep="\t").replace(".", ",").encode(),
    "quotes": rows(sep='","').replace("\n", '"\n"').removesuffix('"').encode().join([b'"', b""]),
    "windows": rows(end="\r\n").encode(),
    "us": rows(unit="us").encode(),
    "us first in x y p t": rows("xypt", unit="us", sep=",").encode(),
    "x y t p": rows("xytp").encode(),
    "p x y t": rows("pxyt").encode(),
    "t p x y": rows("tpxy", signed=True).encode(),
    "words": rows(signed=True).replace(" -1\n", " False\n").replace(" 1\n", " True\n").encode(),
    "of numpy": "\n".join(" ".join(f"{v:.18e}" for v in row) for row in np.stack([*EVENTS], axis=1).tolist()).encode(),
    "geometry in a comment": ("% geometry:64,48\n" + rows("xypt", unit="us", sep=",")).encode(),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_each_dialect_gives_the_same_events(name, tmp_path):
    for suffix in ("txt", "csv", "tsv"):
        recording = open_source(put(tmp_path, f"a.{suffix}", DIALECTS[name]), SENSOR)
        assert_same(read(recording), EVENTS)
        assert recording.faults.found == ()


@pytest.mark.parametrize("name", ["size first", "size, then a header", "geometry in a comment"])
def test_the_size_in_a_file_is_that_of_the_sensor(name, tmp_path):
    path = put(tmp_path, "a.txt", DIALECTS[name])
    assert open_source(path).sensor == SENSOR
    assert open_source(path, Sensor(100, 90)).sensor == Sensor(100, 90)


def test_the_lines_of_a_header_count_in_the_place_of_a_fault(tmp_path):
    text = "64 48\nt,x,y,p\n" + rows(sep=",") + "9.5,1,2\n9.6,64,2,1\n9.7,1.5,2,1\n9.8,1,2,1\n"
    recording = open_source(put(tmp_path, "a.csv", text.encode()))
    assert read(recording).n == EVENTS.n + 1
    found = {(fault.reason.value, fault.where) for fault in recording.faults.found}
    assert found == {("damaged", "line 403"), ("outside_sensor", "line 404"), ("invalid", "line 405")}
    assert "the line is not 4 numbers with t, x, y, p: '9.5,1,2'" in str(recording.faults.found)


def test_an_event_outside_the_assumed_sensor_names_the_flag(tmp_path):
    path = put(tmp_path, "a.csv", b"t,x,y,p\n0.1,1,2,1\n0.2,300,2,1\n")
    _, error = read_broken(open_source(path))
    assert error is not None
    assert "x=300 y=2 lies outside the sensor 240x180, which is assumed" in error.message
    assert "--sensor" in error.message
    _, error = read_broken(open_source(path, Sensor(240, 180)))
    assert error is not None
    assert "assumed" not in error.message


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("t,x,y\n1,2,3\n2,3,4\n", "no column is named as the polarity; the columns are 't', 'x', 'y'"),
        ("x,y,p\n1,2,1\n2,3,0\n", "no column is named as the time"),
        ("t x y p\n" + "1 2 3 1 5\n" * 3, r"the header names 4 columns \(t, x, y, p\), the lines have 5"),
        ("1 2 3\n2 3 4\n", "the lines have 3 numbers: add a header line that names t, x, y and p"),
        ("0.1 2 3 7\n0.2 3 4 8\n0.3 4 5 9\n", "no column is a polarity of 0 and 1 or of -1 and 1"),
        ("3 9 1 2\n2 8 0 1\n1 7 1 0\n" * 9, "no column is a time"),
        ("0.5 1 0.1 2\n0.4 0 0.2 3\n0.3 1 0.3 5\n", "no two columns are x and y"),
        ("5 7 1 100\n" * 300, "the time can be column 1 or 2 or 4; add a header line"),
        ("0.1 2 3 1\r0.2 3 4 0\r", "its lines end with CR: save it with LF or CR LF"),
        ("t\u0000,x".encode("utf-16").decode("latin1"), "the text is UTF-16: save it as UTF-8"),
    ],
)
def test_a_file_whose_columns_are_not_clear_is_refused_and_the_column_is_named(text, why, tmp_path):
    with pytest.raises(UnknownSource, match=why):
        open_source(put(tmp_path, "a.txt", text.encode("latin1")))


def test_names_of_columns_are_recognised_with_their_units():
    assert by_name(["p", "y", "x", "t"]) == Columns(3, 2, 1, 0)
    assert by_name(["Timestamp (ns)", "X", "Y", "on"]) == Columns(0, 1, 2, 3, 1e-3)
    assert by_name(["x", "y", "t_\u00b5s", "is_increase"]) == Columns(2, 0, 1, 3, 1.0)
    with pytest.raises(Unclear, match="as x or the polarity; the columns are 't', 'q', 'y'"):
        by_name(["t", "q", "y"])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("order", ["txyp", "xypt", "xytp", "pxyt", "tpxy", "ptxy"])
def test_the_order_of_columns_is_guessed_although_a_few_events_are_late(order, seed):
    events = make_events(1000, seed=seed)
    late = events.t.copy()
    late[np.random.default_rng(seed).integers(1, 1000, 5)] -= 3000
    table = np.stack([{"t": late, "x": events.x, "y": events.y, "p": events.p}[name] for name in order], axis=1)
    columns = by_values(table.astype(np.float64))
    assert columns.order == tuple(order.index(name) for name in "txyp")


@pytest.mark.parametrize("order", ["txyp", "xypt", "xytp"])
def test_times_without_order_are_recognised_because_they_are_no_pixels(order):
    events = make_events(1000, seed=1, start_us=1_000_000)
    times = np.random.default_rng(0).permutation(events.t)
    table = np.stack([{"t": times, "x": events.x, "y": events.y, "p": events.p}[name] for name in order], axis=1)
    assert by_values(table.astype(np.float64)).order == tuple(order.index(name) for name in "txyp")


def test_random_bytes_and_lines_give_declared_errors_and_valid_events(tmp_path):
    rng = np.random.default_rng(0)
    texts = list(DIALECTS.values())
    for i in range(60):
        data = bytearray(texts[i % len(texts)])
        for at in rng.integers(0, len(data), 1 + i % 9):
            data[at] = rng.integers(0, 256)
        try:
            read(open_source(put(tmp_path, "a.csv", bytes(data)), SENSOR))
        except (UnknownSource, MissingGeometry) as error:
            assert "a.csv" in error.message  # noqa: PT017 most files can be read


@pytest.mark.parametrize(
    "line", ["0.5 1\r 2 1", "0.5\v1 2 1", "0.5 1 2 1\r\r", "\x1c0.5 1 2 1", "0_5 1 2 1", "0x1 1 2 1"]
)
def test_a_line_with_other_white_space_or_digits_is_counted_and_the_others_are_read(line, tmp_path):
    recording = open_source(put(tmp_path, "a.txt", f"0.1 1 2 1\n{line}\n0.6 1 2 1\n".encode()))
    assert read(recording).n + sum(fault.count for fault in recording.faults.found) == 3
    assert all(fault.reason == "damaged" and fault.where == "line 2" for fault in recording.faults.found)


def test_a_line_without_an_end_is_bounded_and_counted(tmp_path):
    path = put(tmp_path, "a.csv", b"t,x,y,p\n" + b"1," * (3 << 20) + b"\n0.5,1,2,1\n")
    recording = open_source(path)
    events: Events = read(recording)
    assert events.n == 1
    assert recording.faults.found[0].reason == "damaged"
