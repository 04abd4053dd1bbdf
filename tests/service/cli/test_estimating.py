"""neurove estimate: its files hold what the service gives for the same packets."""

import csv
import json

import numpy as np
import pytest

from neurove_core.estimator import Estimator
from neurove_core.io.formats.containers.mcap import McapFile
from neurove_core.io.formats.estimate_files import CSV_HEADER, estimate_file
from neurove_core.io.formats.packet_log.writer import PacketWriter
from neurove_core.io.formats.pose_files import read_poses
from neurove_core.models import bundle
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo, Events, Twist, TwistEstimate
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import encode_packet, open_packet
from neurove_protocol.velocity import Trace
from neurove_service.streams.intake import Arrival
from neurove_service.streams.stream import Stream
from tests.builders import SENSOR, make_packets
from tests.recordings import ecd_text
from tests.service.conftest import SMALL

CAMERA = CameraInfo(
    stream="left", width=SENSOR.width, height=SENSOR.height, lens="pinhole", fx=40.0, fy=40.0, cx=31.5, cy=23.5
)
PACKETS = make_packets(100, stream="left")
LOST = PACKETS[:30] + PACKETS[31:60] + [PACKETS[59]] + PACKETS[60:]  # one is lost, one comes twice


@pytest.fixture
def model(models_dir):
    """The model that `slot` serves."""
    return models_dir / "one.safetensors"


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "drive.mcap"
    with PacketWriter(path) as writer:
        writer.camera(CAMERA.encode())
        for number, packet in enumerate(LOST):
            writer.write("left", encode_packet(packet), number * 4_000_000)
    return path


def messages(path, stream="left"):
    return [TwistEstimate.decode(record.data) for record in McapFile.open(path).records((f"{stream}/velocity",))]


def rows(path):
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def served(slot, packets, camera):
    """What the stream of a service gives for the bytes of these packets, each received when it is sent."""
    now_ns = 10**12
    stream = Stream("left", slot, lambda: now_ns)
    stream.set_camera(camera)
    found = []
    for packet in packets:
        now_ns = 10**12 + (packet.t0_us + 4000) * 1000
        found += stream.accept(open_packet(encode_packet(packet)), Arrival(now_ns, now_ns))
    return found


def test_the_estimates_are_those_of_the_service_for_the_same_packets(run, slot, model, log, tmp_path):
    out = tmp_path / "a.mcap"
    code, text, err = run("estimate", log, "--out", out, "--model", model, "--height", 1.5, "--json")
    assert (code, err) == (0, "")
    expected = served(slot, LOST, CAMERA.model_copy(update={"height_m": 1.5}))
    same = {"trace": None, "host": None}
    assert [one.model_copy(update=same) for one in messages(out)] == [one.model_copy(update=same) for one in expected]
    assert len(expected) == 7
    assert [one.start_us for one in expected if "gap" in one.flags] == [100_000]
    assert not any("unscaled" in one.flags for one in expected)
    summary = json.loads(text.splitlines()[-1])  # the slot has printed that it compiles
    assert summary["lost"] == {"gap_packets": 1, "duplicate_packets": 1}
    assert summary["flags"]["gap"] == 1


def test_a_csv_file_has_a_row_for_each_bin(run, model, log, tmp_path):
    code, text, _ = run("estimate", log, "--out", tmp_path / "a.csv", "--model", model)
    assert code == 0
    assert "7 estimates of drive.mcap by one" in text
    assert "not used: 1 gap packets, 1 duplicate packets" in text
    assert "1 m above the ground" in text
    run("estimate", log, "--out", tmp_path / "a.mcap", "--model", model)
    found = rows(tmp_path / "a.csv")
    assert tuple(found[0]) == CSV_HEADER
    assert len(found) == 7 * SMALL.window.bins
    for number, one in enumerate(messages(tmp_path / "a.mcap")):
        for k, (end_us, twist) in enumerate(zip(one.bin_end_us, one.twists, strict=True)):
            row = found[number * SMALL.window.bins + k]
            assert (int(row["seq"]), int(row["bin_end_us"]), row["flags"].split()) == (one.seq, end_us, list(one.flags))
            assert tuple(float(row[name]) for name in CSV_HEADER[4:10]) == tuple(twist)
            assert row["sigma_vx_m_s"] == ""


def test_a_recording_that_is_no_packet_log_gives_the_estimates_of_the_estimator(run, model, tmp_path):
    source = "sim://wall?seed=4&seconds=0.3&camera=pinhole:24x18:75"
    code, _, _ = run("estimate", source, "--out", tmp_path / "a.csv", "--model", model)
    expected = list(Estimator(bundle.load(model)).estimates(open_source(source)))
    twists = np.array([[float(row[name]) for name in CSV_HEADER[4:10]] for row in rows(tmp_path / "a.csv")])
    assert code == 0
    np.testing.assert_array_equal(twists, np.concatenate([one.twists for one in expected]))


def estimate_of(start_us, twist, bins=5, bin_us=10_000):
    ends = tuple(start_us + bin_us * (k + 1) for k in range(bins))
    trace = Trace(received_ns=0, queued_ns=0, computed_ns=0, published_ns=0)
    return TwistEstimate(
        stream="cam0",
        seq=start_us // 50_000,
        start_us=start_us,
        end_us=ends[-1],
        bin_end_us=ends,
        twists=(twist,) * bins,
        model="one",
        digest="0" * 64,
        epoch=0,
        events=1,
        trace=trace,
    )


def test_the_trajectory_of_a_constant_turn_is_a_circle(tmp_path):
    turn = Twist(0.0, 0.0, 2.0, 0.0, np.pi / 2, 0.0)  # 2 m/s forward, 90 deg/s to the right: a radius of 4 / pi
    with estimate_file(tmp_path / "a.tum") as add:
        for start_us in range(0, 2_000_000, 50_000):
            add(estimate_of(start_us, turn))
    poses = read_poses(tmp_path / "a.tum")
    radius = 4 / np.pi
    angle = np.pi / 2 * poses.t / 1e6
    expected = np.stack([radius * (1 - np.cos(angle)), np.zeros(angle.size), radius * np.sin(angle)], 1)
    np.testing.assert_allclose(poses.position_m, expected, atol=1e-6)
    assert poses.t.tolist() == list(range(0, 2_000_001, 10_000))


def test_a_trajectory_rests_where_windows_are_missing_and_has_no_pose_where_time_goes_back(tmp_path):
    with estimate_file(tmp_path / "a.tum") as add:
        for start_us in (0, 150_000, 50_000, 200_000):
            add(estimate_of(start_us, Twist(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    poses = read_poses(tmp_path / "a.tum")
    at = dict(zip(poses.t.tolist(), poses.position_m[:, 0].round(6).tolist(), strict=True))
    assert (at[50_000], at[150_000], at[200_000], at[250_000]) == (0.05, 0.05, 0.1, 0.15)
    assert 60_000 not in at


def test_a_file_that_exists_is_replaced_only_with_force(run, model, log, tmp_path):
    out = tmp_path / "a.csv"
    out.write_text("mine")
    arguments = ("estimate", log, "--out", out, "--model", model)
    code, _, err = run(*arguments)
    assert code == 2
    assert err.startswith("neurove: estimate: --out='")  # a long path is shortened
    assert err.endswith("a.csv': the file exists; --force replaces it\n")
    assert out.read_text() == "mine"
    assert run(*arguments, "--force")[0] == 0
    assert out.read_text().startswith("seq,")
    code, _, err = run("estimate", log, "--out", log, "--force")
    assert (code, "it is the input recording" in err) == (2, True)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["sim://street", "--out", "a.csv"], "it never ends: give --seconds S"),
        (["a.mcap", "--out", "a.txt"], "its name must end in .csv, .tum, .mcap"),
        (["sim://wall?seconds=0.1", "--out", "no/a.csv"], "No such file or directory"),
        (["nothing.mcap", "--out", "a.csv"], "no such file"),
    ],
)
def test_what_cannot_be_estimated_is_one_line_and_leaves_no_file(run, tmp_path, monkeypatch, arguments, why):
    monkeypatch.chdir(tmp_path)
    code, _, err = run("estimate", *arguments, "--model", "untrained")
    assert (code, why in err, err.count("\n")) == (2, True, 1), err
    assert list(tmp_path.iterdir()) == []


def test_a_truncated_recording_gives_the_estimates_up_to_its_end_and_exits_with_1(run, model, log, tmp_path):
    whole, cut = tmp_path / "whole.csv", tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-2000])  # the end of its packets is in one chunk before the index
    assert run("estimate", log, "--out", whole, "--model", model)[0] == 0
    code, text, err = run("estimate", cut, "--out", tmp_path / "cut.csv", "--model", model, "--json")
    assert (code, "the file ends within" in err) == (1, True), err
    assert json.loads(text)["broken"]
    assert rows(tmp_path / "cut.csv") == rows(whole)[: len(rows(tmp_path / "cut.csv"))]


def test_a_damaged_packet_of_a_log_is_counted_and_flags_its_window(run, model, tmp_path):
    path = tmp_path / "bad.mcap"
    with PacketWriter(path) as writer:
        for number, packet in enumerate(PACKETS):
            payload = encode_packet(packet)
            writer.write("left", payload[:50] if number == 30 else payload, number * 4_000_000)
    code, text, _ = run("estimate", path, "--out", tmp_path / "a.mcap", "--model", model, "--json")
    found = json.loads(text)
    assert (code, found["lost"]) == (0, {"malformed_packets": 1})
    assert [one.start_us for one in messages(tmp_path / "a.mcap") if "gap" in one.flags] == [100_000]


def test_a_lens_from_a_file_is_used(run, model, tmp_path):
    (tmp_path / "events.txt").write_bytes(ecd_text(Events.join([packet.events for packet in PACKETS])))
    (tmp_path / "lens.yaml").write_text(
        "image_width: 64\nimage_height: 48\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [40.0, 0, 31.5, 0, 40.0, 23.5, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
    )
    arguments = ("estimate", tmp_path / "events.txt", "--sensor", "64x48", "--model", model, "--json", "--out")
    _, without, _ = run(*arguments, tmp_path / "a.csv")
    lens = ("--calibration", tmp_path / "lens.yaml", "--height", 2)
    code, text, err = run(*arguments, tmp_path / "b.csv", *lens)
    assert code == 0, err
    assert {"uncalibrated", "unscaled"} <= json.loads(without)["flags"].keys()
    assert not {"uncalibrated", "unscaled"} & json.loads(text)["flags"].keys()


def test_a_height_without_a_lens_is_refused(run, tmp_path):
    (tmp_path / "events.txt").write_bytes(ecd_text(make_packets(1)[0].events))
    code, _, err = run("estimate", tmp_path, "--sensor", "64x48", "--out", tmp_path / "a.csv", "--height", 1)
    assert (code, "--height=1.0: a height needs a lens, and" in err) == (2, True), err


def test_a_height_that_is_no_length_is_refused(run, capsys):
    with pytest.raises(SystemExit):
        run("estimate", "sim://", "--out", "a.csv", "--height", "nan")
    assert "give metres above 0" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".csv", ".tum", ".mcap"])
def test_an_error_in_between_leaves_the_old_file_and_no_other(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_text("old")

    def half() -> None:
        with estimate_file(path) as add:
            add(estimate_of(0, Twist(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
            raise InvalidField("recording", "byte", 7, "broken")

    with pytest.raises(InvalidField):
        half()
    assert (path.read_text(), len(list(tmp_path.iterdir()))) == ("old", 1)


def test_seconds_bound_a_source_without_end(run, model, tmp_path):
    code, _, _ = run("estimate", "pattern://", "--seconds", "0.4", "--out", tmp_path / "a.csv", "--model", model)
    assert code == 0
    assert int(rows(tmp_path / "a.csv")[-1]["end_us"]) <= 450_000
