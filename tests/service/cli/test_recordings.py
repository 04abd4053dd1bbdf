"""neurove convert, info and simulate: their files, their output and what they refuse."""

import json

import numpy as np
import pytest

from neurove_core.io.formats.packet_log.layout import pack_columns, pack_frame
from neurove_core.io.formats.packet_log.writer import PacketWriter
from neurove_core.io.recording import Frame, Triggers
from neurove_core.sources import open_source
from neurove_protocol import Sensor
from neurove_protocol.events import encode_packet
from tests.builders import make_events, make_packet
from tests.neurove_core.io.test_prophesee import dat
from tests.recordings import ecd_text, shared


def test_convert_writes_a_packet_log(run, tmp_path):
    events = make_events(2000)
    (tmp_path / "events.txt").write_bytes(ecd_text(events))
    out = tmp_path / "a.mcap"
    code, found, err = run("convert", tmp_path, out, "--sensor", "64x48", "--json")
    assert (code, err) == (0, "")
    assert (json.loads(found)["events"], json.loads(found)["streams"]) == (2000, ["events"])
    assert sum(chunk.n for chunk in open_source(str(out)).chunks()) == 2000
    code, found, _ = run("convert", out, tmp_path / "b.mcap")
    assert (code, found.startswith(f"{tmp_path / 'b.mcap'}: 2,000 events of a.mcap")) == (0, True)


def test_convert_writes_the_layout_of_dsec(run, tmp_path):
    pytest.importorskip("hdf5plugin")
    (tmp_path / "events.txt").write_bytes(ecd_text(make_events(2000)))
    code, found, err = run("convert", tmp_path, tmp_path / "a.h5", "--sensor", "64x48")
    assert (code, err) == (0, "")
    assert "2,000 events" in found
    again = open_source(str(tmp_path / "a.h5"), Sensor(64, 48))
    assert sum(chunk.n for chunk in again.chunks()) == 2000


def test_convert_says_what_the_target_cannot_hold(run, tmp_path):
    pytest.importorskip("hdf5plugin")
    edges = Triggers(np.array([5, 9]), np.array([0, 0], np.uint8), np.array([1, 0], np.uint8))
    with PacketWriter(tmp_path / "a.mcap") as writer:
        writer.write("cam0", encode_packet(make_packet()), 0)
        writer.add("cam0", "triggers", pack_columns("triggers", edges), 0)
        writer.add("cam0", "frames", pack_frame(Frame(0, np.zeros((4, 4), np.uint8))), 0)
    out = tmp_path / "a.h5"
    code, found, err = run("convert", tmp_path / "a.mcap", out, "--json")
    assert (code, json.loads(found)["left_out"]) == (0, ["frames", "triggers"])
    assert err == f"neurove: {out} lacks frames, triggers: .h5 cannot hold them, .mcap can\n"
    _, found, err = run("convert", tmp_path / "a.mcap", tmp_path / "b.mcap", "--json")
    assert (json.loads(found)["left_out"], err) == ([], "")


@pytest.mark.parametrize("arguments", [["convert", "sim://wall?seconds=0.1"], ["simulate", "wall", "--out"]])
def test_a_file_that_exists_is_replaced_only_with_force(run, tmp_path, arguments):
    out = tmp_path / "a.mcap"
    out.write_text("mine")
    code, _, err = run(*arguments, out, *(["--seconds", 0.1] if arguments[0] == "simulate" else []))
    assert (code, "the file exists; --force replaces it" in err, out.read_text()) == (2, True, "mine")
    code, _, _ = run(*arguments, out, "--force", *(["--seconds", 0.1] if arguments[0] == "simulate" else []))
    assert (code, out.read_bytes()[1:5]) == (0, b"MCAP")


LENS = """image_width: 64
image_height: 48
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [32, 0, 31.5, 0, 24, 23.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 4, data: [-0.1, 0, 0, 0]}
"""


def test_info_shows_the_lens_and_the_height(run, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    pytest.importorskip("ruamel.yaml")
    (tmp_path / "events.txt").write_bytes(ecd_text(make_events(2000)))
    (tmp_path / "lens.yaml").write_text(LENS)
    code, found, _ = run("info", tmp_path, "--sensor", "64x48")
    assert (code, "unknown: --calibration FILE gives it" in found) == (0, True)
    given = ("--calibration", tmp_path / "lens.yaml", "--height", 0.4)
    code, found, _ = run("info", tmp_path, "--sensor", "64x48", *given)
    assert code == 0
    for words in ("pinhole, fx 32.00 fy 24.00 cx 31.50 cy 23.50 px", "-0.1 0 0 0", "field of view", "0.4 m above"):
        assert words in found
    lens = json.loads(run("info", tmp_path, "--sensor", "64x48", *given, "--json")[1])["lens"]
    assert (lens["lens"], lens["fx"], lens["height_m"]) == ("pinhole", 32, 0.4)
    code, _, err = run("info", tmp_path, "--sensor", "64x50", *given)
    assert (code, "image size='64x48': the events' sensor is 64x50" in err) == (2, True)


def test_convert_keeps_the_triggers_of_a_real_bag(run, tmp_path):
    bag = shared("rosbag/test_events_1")
    assert run("convert", bag, tmp_path / "a.mcap", "--topic", "/event_camera/events")[0] == 0
    recording = open_source(str(tmp_path / "a.mcap"))
    assert recording.streams == ("events", "triggers")
    assert sum(part.t.size for part in recording.triggers()) == 4157


def test_a_bad_line_costs_itself_and_is_told(run, tmp_path):
    (tmp_path / "events.txt").write_bytes(b"0.0 7 br\n" + ecd_text(make_events(200)))
    code, found, err = run("convert", tmp_path, tmp_path / "c.mcap", "--json", "--sensor", "64x48")
    assert (code, "line 1" in err, err.count("\n")) == (0, True, 1)
    about = json.loads(found)
    assert (about["events"], about["faults"][0]["reason"]) == (200, "damaged")
    assert len(list(open_source(str(tmp_path / "c.mcap")).chunks())) == 1


@pytest.mark.parametrize("name", ["c.mcap", "c.h5"])
def test_a_gap_of_years_is_converted_and_told(run, tmp_path, name):
    lines = "0.0 1 1 1\n" + "".join(f"{1564587893 + i / 1000:.6f} {i % 64} {i % 48} 1\n" for i in range(500))
    (tmp_path / "a.txt").write_text(lines)
    code, found, err = run("convert", tmp_path / "a.txt", tmp_path / name, "--sensor", "64x48", "--json")
    if name == "c.h5":  # its index has an entry for each millisecond
        assert (code, "span_s" in err) == (2, True)
        return
    assert (code, json.loads(found)["events"], "long gap in time" in err) == (0, 501, True)
    again = open_source(str(tmp_path / name))
    assert sum(chunk.n for chunk in again.chunks()) == 501
    assert (tmp_path / name).stat().st_size < 50_000


def test_what_can_be_read_of_a_truncated_recording_is_converted_and_the_exit_code_is_1(run, tmp_path):
    (tmp_path / "a.dat").write_bytes(dat(make_events(200))[:-3])
    code, found, err = run("convert", tmp_path / "a.dat", tmp_path / "c.h5", "--json")
    assert (code, "the file ends within a record" in err, err.count("\n")) == (1, True, 1)
    assert json.loads(found)["events"] == 199
    assert (tmp_path / "c.h5").exists()


@pytest.mark.parametrize(
    ("source", "out", "topic", "why"),
    [
        ("a.txt", "a.xyz", [], "its name must end in .mcap or .h5"),
        ("pattern://", "a.mcap", [], "it has no end"),
        ("a.txt", "no/a.mcap", [], "No such file or directory"),
        ("a.mcap", "b.mcap", ["--topic", "up"], "no stream 'up'; its streams are cam0"),
        ("a.mcap", "a.mcap", [], "it is the input recording"),
    ],
)
def test_an_impossible_conversion_is_one_line(run, tmp_path, monkeypatch, source, out, topic, why):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.txt").write_bytes(ecd_text(make_events(10)))
    if source == "a.mcap":
        run("convert", "a.txt", "a.mcap")
    code, _, err = run("convert", source, out, *topic)
    assert (code, why in err, err.count("\n")) == (2, True, 1), err


def test_info_shows_what_a_recording_holds(run, tmp_path):
    (tmp_path / "events.txt").write_bytes(ecd_text(make_events(2000)))
    picture = tmp_path / "a.png"
    code, found, err = run("info", tmp_path, "--sensor", "64x48", "--json", "--plot", picture)
    about = json.loads(found)
    assert (code, err) == (0, f"wrote {picture}\n")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert (about["sensor"], about["events"], about["streams"]) == ({"width": 64, "height": 48}, 2000, ["events"])
    assert (about["imu"], about["truth"], about["broken"]) == (None, None, None)
    assert about.keys() >= {"on_fraction", "first_us", "last_us", "duration_s"}
    code, found, _ = run("info", tmp_path, "--sensor", "64x48")
    assert code == 0
    assert "2,000" in found


def test_info_of_a_real_recording_with_an_imu(run):
    code, found, _ = run("info", shared("aedat4/davis346.aedat4"))
    assert code == 0
    assert all(text in found for text in ("78,830, 52.3 % ON", "2,363 samples at 1,001.2 Hz", "59", "truth"))


def test_info_of_a_recording_with_a_fault_ends_with_1(run, tmp_path):
    (tmp_path / "events.txt").write_bytes(ecd_text(make_events(2000)) + b"and then\n")
    code, found, err = run("info", tmp_path, "--sensor", "64x48", "--json")
    assert code == 1
    assert json.loads(found)["events"] == 2000
    assert "the first at line 2001" in err
    assert json.loads(found)["faults"][0]["count"] == 1


def test_a_simulation_contains_its_truth(run, tmp_path):
    out = tmp_path / "a.mcap"
    code, found, err = run("simulate", "wall", "--seconds", 0.2, "--seed", 4, "--out", out, "--json")
    assert (code, err) == (0, "")
    assert json.loads(found)["streams"] == ["events", "twists"]
    recording = open_source(str(out))
    twists = recording.twists()
    assert sum(chunk.n for chunk in recording.chunks()) == json.loads(found)["events"] > 0
    assert twists.twist[:, 0] == pytest.approx(0.3, abs=1e-6)  # the wall's trajectory slides at 0.3 m/s
    assert recording.camera("cam0").height_m == 1.5
    code, found, _ = run("info", "sim://wall?seed=4&seconds=0.2", "--json")
    assert (code, json.loads(found)["truth"]["from"]) == (0, "twists")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "scene='nowhere': known scenes: street, bare-street, corridor, room, plain-room, wall"),
        (["street", "--camera", "nikon"], "camera='nikon': known cameras:"),
        (["street", "--trajectory", "flying"], "'flying': neither a known trajectory nor a file"),
        (["street", "--height", "0"], "height"),
        (["street", "--seed", "-1"], "seed='-1'"),
    ],
)
def test_an_impossible_simulation_is_named_and_leaves_no_file(run, tmp_path, arguments, message):
    code, _, err = run("simulate", *arguments, "--out", tmp_path / "a.mcap")
    assert (code, message in err) == (2, True), err
    assert list(tmp_path.iterdir()) == []


def test_simulations_are_written_in_known_formats_only(run, tmp_path):
    code, _, err = run("simulate", "wall", "--out", tmp_path / "a.avi")
    assert (code, "must end in .mcap or .h5" in err) == (2, True)


def test_a_wrong_address_of_carla_is_named(run, tmp_path):
    code, _, err = run("simulate", "carla", "--out", tmp_path / "a.npz", "--server", "nowhere")
    assert (code, "--server='nowhere': give HOST:PORT" in err) == (2, True)
