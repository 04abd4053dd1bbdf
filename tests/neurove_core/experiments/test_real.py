"""Real events: every check gives its figure and its bound, or the reason why it was skipped."""

import json
from pathlib import Path

import numpy as np
import pytest

from neurove_core import models
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import estimate_recording
from neurove_core.experiments import real
from neurove_core.models import bundle
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from neurove_service.cli import main
from tests.builders import make_events
from tests.recordings import SHARED, aedat4, ecd_text, shared

RESULTS = Path(real.__file__).parent / "results"
CALIB = "199.1 198.8 132.2 110.7 -0.368 0.151 -0.0003 -0.0008 0.0\n"
SMALL = ModelConfig(
    canonical=CanonicalConfig(width=24, height=18), network=NetworkConfig(channels=(4, 4), features=8, hidden=8)
)


@pytest.fixture(scope="module")
def estimator():
    return Estimator(bundle.untrained(3, SMALL, "small"))


def rotating_camera(seconds: float, rad_s: float = 1.0) -> Events:
    rotation = f"rotation?wx={rad_s / 2}%26wy={rad_s}"
    source = f"sim://room?seed=2&camera=davis240c&pitch=0&seconds={seconds}&trajectory={rotation}"
    return Events.join(list(open_source(source).chunks()))


def by_name(rows):
    return {(row["recording"].split("/")[0], row["what"].split(",")[0]): row for row in rows}


def test_without_recordings_every_check_is_skipped_with_the_reason(estimator, tmp_path):
    rows = list(real.run(estimator, tmp_path))
    assert len(rows) == len(real.CHECKS)
    assert {row["skipped"] for row in rows} == {"the recording is missing"}
    assert {row["met"] for row in rows} == {None}
    assert real.markdown(rows, "no model").count("skipped") == len(rows)


@pytest.mark.parametrize(("folder", "why"), [("", "has none of the recordings"), ("nowhere", "is not a folder")])
def test_the_command_fails_if_every_check_is_skipped(run, tmp_path, folder, why):
    code, out, err = run("reproduce", "real", "untrained", "--recordings", tmp_path / folder)
    assert (code, out.count("skipped")) == (1, len(real.CHECKS))
    assert f"every check was skipped: {tmp_path / folder} {why}" in err


def test_reproduce_velocity_refuses_a_wrong_folder_of_recordings_before_it_trains(run, tmp_path):
    code, _, err = run("reproduce", "velocity", "--recordings", tmp_path / "nowhere", "--out", tmp_path / "out")
    assert (code, err.count("\n"), "it is not a folder" in err) == (2, 1, True)
    assert not (tmp_path / "out").exists()


def write_gyro(folder: Path, bias: tuple[float, float, float], rate: tuple[float, float, float]) -> None:
    """Samples of a gyro with a bias that is at rest until 0.6 s, then turns."""
    folder.mkdir(parents=True, exist_ok=True)
    t_s = np.arange(0, 1.6, 0.005)[:, None]
    gyro = bias + np.where(t_s < 0.6, 0.0, 1.0) * np.array(rate)
    np.savetxt(folder / "imu.txt", np.hstack([t_s, np.tile([0, -9.8, 0], (len(t_s), 1)), gyro]))


def test_a_rotating_camera_is_compared_with_its_gyro_over_complete_windows_without_its_bias(estimator, tmp_path):
    folder = tmp_path / "ecd" / "shapes_rotation"
    write_gyro(folder, (0.3, -0.2, 0.1), (0.5, 1.0, 0.0))
    events = rotating_camera(0.13)
    events = events._replace(t=events.t + 720_000)  # so that the first and the last window are incomplete
    (folder / "events.txt").write_bytes(ecd_text(events))
    (folder / "calib.txt").write_text(CALIB)
    row = by_name(real.run(estimator, tmp_path))["ecd", "rate of turning at 43.5 s"]
    answers = estimate_recording(estimator, open_source(str(folder)))
    found = answers.twists[answers.start_us.tolist().index(750_000), :, 3:].mean(0)
    true = np.array([0.5, 1.0, 0.0])
    assert row["truth"] == "the gyro, less its bias"
    assert row["made_of"]["gyro [rad/s]"] == pytest.approx(true.tolist())
    assert row["made_of"]["estimate [rad/s]"] == pytest.approx(found.tolist())
    assert row["value"] == pytest.approx(np.linalg.norm(found - true) / np.linalg.norm(true))
    assert row["met"] is (row["value"] <= 0.15)


def test_without_samples_at_rest_or_in_a_window_the_gyro_is_no_truth(estimator, tmp_path):
    folder = tmp_path / "ecd" / "shapes_rotation"
    folder.mkdir(parents=True)
    (folder / "events.txt").write_bytes(ecd_text(rotating_camera(0.11)))
    assert "bias is not known" in by_name(real.run(estimator, tmp_path))["ecd", "rate of turning at 43.5 s"]["skipped"]
    late = rotating_camera(0.11)
    (folder / "events.txt").write_bytes(ecd_text(late._replace(t=late.t + 5_000_000)))
    write_gyro(folder, (0, 0, 0), (0, 1, 0))
    assert "does not cover" in by_name(real.run(estimator, tmp_path))["ecd", "rate of turning at 43.5 s"]["skipped"]


def test_a_recording_without_truth_or_a_complete_window_is_skipped_with_the_reason(estimator, tmp_path):
    for place, events in (
        ("slider_depth/events_chunk.txt", rotating_camera(0.11)),
        ("ecd/shapes_rotation/events.txt", None),
    ):
        file = tmp_path / place
        file.parent.mkdir(parents=True)
        file.write_bytes(ecd_text(events if events is not None else rotating_camera(0.04)))
    rows = by_name(real.run(estimator, tmp_path))
    assert "groundtruth.txt" in rows["slider_depth", "direction of motion"]["skipped"]
    assert "no complete window of 50 ms" in rows["ecd", "rate of turning at 43.5 s"]["skipped"]


def test_profiles_and_stationary_cameras_are_evaluated_over_their_windows(estimator, tmp_path):
    turning = rotating_camera(0.75, rad_s=0.2)
    write_gyro(tmp_path / "ecd" / "shapes_rotation", (0, 0, 0), (0, 0.2, 0))
    (tmp_path / "ecd" / "shapes_rotation" / "events.txt").write_bytes(ecd_text(turning.span(0, 1000)))
    (tmp_path / "ecd" / "shapes_rotation_1.43s.txt").write_bytes(ecd_text(turning))
    (tmp_path / "aedat4").mkdir()
    noise = make_events(3000, duration_us=600_000, sensor=Sensor(346, 260))
    (tmp_path / "aedat4" / "davis346.aedat4").write_bytes(aedat4([noise], Sensor(346, 260)).data)
    found = list(real.run(estimator, tmp_path))
    rows = by_name(found)
    correlation, error = (row for row in found if row["what"].startswith("yaw"))
    assert correlation["made_of"]["windows"] == 3  # complete windows, 0.5 s after the first
    assert -1 <= correlation["value"] <= 1
    assert error["made_of"]["RMS of the gyro"] == pytest.approx(0.2 * np.sqrt(2 / 3), rel=1e-3)
    assert (
        rows["ecd", "turning at rest [rad/s]"]["value"] >= rows["ecd", "turning at rest [rad/s]"]["made_of"]["median"]
    )
    stationary = {row["what"]: row for row in found if row["recording"].endswith("davis346.aedat4")}
    flagged = stationary["share of windows flagged low activity"]
    assert flagged["made_of"]["events in a window"] == pytest.approx(250, abs=40)
    assert 0 <= flagged["value"] <= 1
    assert stationary["speed at rest at 1 m [m/s]"]["value"] >= 0


def test_no_check_is_skipped_if_all_recordings_exist(tmp_path):
    for check in real.CHECKS:
        shared(check.recording)
    rows = by_name(real.run(Estimator(models.find("default")), SHARED))
    assert not any(row["skipped"] for row in rows.values())
    assert all(row["truth"] for row in rows.values())
    turning = rows["ecd", "rate of turning at 43.5 s"]["made_of"]["gyro [rad/s]"]
    assert turning == pytest.approx([1.48, -0.52, 1.89], abs=0.01)
    evbench = rows["evbench", "rotation about x over its truth"]["made_of"]
    assert evbench["truth [rad/s]"] == pytest.approx(-0.142, abs=0.001)
    stationary = rows["ecd", "turning at rest [rad/s]"]
    assert stationary["met"] == (stationary["value"] <= real.STATIONARY_RAD_S)
    slider = rows["slider_depth", "direction of motion"]["made_of"]["truth [m/s]"]
    assert slider == pytest.approx([0.3, 0, 0], abs=0.05)


def test_the_command_prints_the_same_results_as_table_and_json_and_writes_both(tmp_path, capsys):
    arguments = ["reproduce", "real", "untrained", "--recordings", str(tmp_path / "none"), "--out", str(tmp_path)]
    assert main.main(arguments) == 1  # every check is skipped
    table = capsys.readouterr().out
    assert main.main([*arguments, "--json"]) == 1
    results = json.loads(capsys.readouterr().out)
    assert results["model"]["name"] == "untrained"
    assert table == real.markdown(results["checks"], real.title(results)) == (tmp_path / "real.md").read_text()
    assert json.loads((tmp_path / "real.json").read_text())["checks"] == results["checks"]


def test_the_committed_table_matches_the_committed_json():
    results = json.loads((RESULTS / "real.json").read_text())
    assert (RESULTS / "real.md").read_text() == real.markdown(results["checks"], real.title(results))
    assert [row["what"] for row in results["checks"]] == [check.what for check in real.CHECKS]
