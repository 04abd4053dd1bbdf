"""neurove convert: what it writes, what it says, and what it refuses."""

import json

import pytest

from neurove_core.io import open_source
from protocol import Sensor
from service import cli
from tests.builders import make_events
from tests.recordings import ecd_text, shared


@pytest.fixture
def run(capsys):
    def call(*arguments):
        code = cli.main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return call


def test_convert_writes_a_recording_of_ours(run, tmp_path):
    events = make_events(2000)
    (tmp_path / "events.txt").write_bytes(ecd_text(events))
    out = tmp_path / "a.mcap"
    code, told, err = run("convert", tmp_path, out, "--sensor", "64x48", "--json")
    assert (code, err) == (0, "")
    assert (json.loads(told)["events"], json.loads(told)["streams"]) == (2000, ["events"])
    assert sum(chunk.n for chunk in open_source(str(out)).chunks()) == 2000
    code, told, _ = run("convert", out, tmp_path / "b.mcap")
    assert (code, told.startswith(f"{tmp_path / 'b.mcap'}: 2,000 events of a.mcap")) == (0, True)


def test_convert_writes_the_layout_of_dsec(run, tmp_path):
    pytest.importorskip("hdf5plugin")
    (tmp_path / "events.txt").write_bytes(ecd_text(make_events(2000)))
    code, told, err = run("convert", tmp_path, tmp_path / "a.h5", "--sensor", "64x48")
    assert (code, err) == (0, "")
    assert "2,000 events" in told
    again = open_source(str(tmp_path / "a.h5"), Sensor(64, 48))
    assert sum(chunk.n for chunk in again.chunks()) == 2000


def test_convert_keeps_what_lies_beside_the_events_of_a_real_bag(run, tmp_path):
    bag = shared("rosbag/test_events_1")
    assert run("convert", bag, tmp_path / "a.mcap", "--topic", "/event_camera/events")[0] == 0
    recording = open_source(str(tmp_path / "a.mcap"))
    assert recording.streams == ("events", "triggers")
    assert sum(part.t.size for part in recording.triggers()) == 4157


def test_a_broken_recording_is_told_and_leaves_no_file(run, tmp_path):
    (tmp_path / "events.txt").write_bytes(ecd_text(make_events(200)) + b"0.9 7 br\n")
    code, _, err = run("convert", tmp_path, tmp_path / "c.mcap")
    assert (code, "line 201" in err, err.count("\n")) == (1, True, 1)
    assert [one.name for one in tmp_path.iterdir()] == ["events.txt"]


@pytest.mark.parametrize(
    ("source", "out", "topic", "why"),
    [
        ("a.txt", "a.xyz", [], "its name must end in .mcap or .h5"),
        ("pattern://", "a.mcap", [], "it has no end"),
        ("a.txt", "no/a.mcap", [], "No such file or directory"),
        ("a.mcap", "b.mcap", ["--topic", "up"], "no stream 'up'; its streams are cam0"),
        ("a.mcap", "a.mcap", [], "it is the recording that is read"),
    ],
)
def test_what_can_not_be_converted_is_one_line(run, tmp_path, monkeypatch, source, out, topic, why):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.txt").write_bytes(ecd_text(make_events(10)))
    if source == "a.mcap":
        run("convert", "a.txt", "a.mcap")
    code, _, err = run("convert", source, out, *topic)
    assert (code, why in err, err.count("\n")) == (2, True, 1), err
