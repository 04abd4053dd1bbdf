"""neurove evaluate, end to end on a tiny model and tiny sequences."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from neurove_core.sources import open_source
from tests.refusing import environment

SOURCE = "sim://street?seed=3&seconds=0.8&camera=pinhole:24x18:75"


def test_evaluate_prints_all_figures_as_json(trained, run):
    code, out, _ = run("evaluate", str(trained / "out" / "tiny.safetensors"), SOURCE, "--json")
    found = json.loads(out)
    assert code == 0
    for key in ("rmse_v_l_m_s", "rmse_v_a_deg_s", "re_v_l", "re_v_a", "per_axis", "windows", "firing_rate"):
        assert key in found
    assert found["zero"]["re_v_l"] == pytest.approx(1)
    assert found["recordings"][0]["name"].startswith("street driving 3")


def test_evaluate_prints_a_table_and_draws(trained, run, tmp_path):
    model = str(trained / "out" / "tiny.safetensors")
    code, out, err = run("evaluate", model, SOURCE, "--plot", str(tmp_path / "plots"))
    assert code == 0
    assert {"tiny", "zero velocity", "mean of the truth", "wy"} <= {line[:24].strip() for line in out.splitlines()} | {
        line.split()[0] for line in out.splitlines() if line
    }
    assert err.count("wrote ") == 4  # the drive and the reliability, each as PNG and SVG
    assert {file.suffix for file in (tmp_path / "plots").iterdir()} == {".png", ".svg"}


def test_processes_give_the_figures_of_this_process(run):
    words = ("evaluate", "untrained", SOURCE, SOURCE.replace("seed=3", "seed=20320"), "--json")
    (_, here, _), (code, there, err) = run(*words), run(*words, "--workers", "2")
    found, wanted = json.loads(there), json.loads(here)
    assert (code, "evaluated 2/2" in err) == (0, True), err
    for figure in ("windows", "rmse_v_l_m_s", "per_axis", "firing_rate", "source_share"):
        assert found[figure] == wanted[figure]
    assert [one["name"] for one in found["recordings"]] == [one["name"] for one in wanted["recordings"]]


def test_the_network_on_a_device_gives_the_figures_of_the_engine(trained, run):
    words = ("evaluate", trained / "out" / "tiny.safetensors", SOURCE, SOURCE.replace("seed=3", "seed=20321"), "--json")
    (_, engine, _), (code, device, err) = run(*words), run(*words, "--device", "cpu")
    assert code == 0, err
    found, wanted = json.loads(device), json.loads(engine)
    assert [one["name"] for one in found["recordings"]] == [one["name"] for one in wanted["recordings"]]
    assert found["windows"] == wanted["windows"]
    for figure in ("rmse_v_l_m_s", "rmse_v_a_deg_s"):
        assert found[figure] == pytest.approx(wanted[figure], rel=1e-3)
    assert found["firing_rate"] == pytest.approx(wanted["firing_rate"], abs=0.01)


@pytest.mark.parametrize(
    "command",
    [
        ("evaluate", "default", SOURCE),
        ("reproduce", "motion", "--quick"),
        ("reproduce", "velocity", "--quick"),
        ("calibrate", "default", "--out", "mine.safetensors"),
        ("adapt", "none.bag", "--out", "mine.safetensors"),
    ],
)
@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--device", "cuda:999"), "--device='cuda:999': (this build of torch has no CUDA|torch sees)"),
        (("--device", "gpu"), "--device='gpu': cpu, cuda or cuda:N is expected"),
    ],
)
def test_a_device_that_is_missing_is_refused_in_one_line(run, tmp_path, monkeypatch, command, words, why):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*command, *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert re.search(why, err)


def test_a_device_and_other_processes_are_refused(run):
    code, _, err = run("evaluate", "default", SOURCE, "--device", "cpu", "--workers", "2")
    assert code == 2
    assert "--device='cpu': not together with --workers or --dask" in err


def test_without_torch_the_device_is_refused_by_name(tmp_path):
    words = ("-m", "neurove_service.cli", "evaluate", "default", SOURCE, "--device", "cuda")
    env = os.environ | environment(tmp_path, ["torch"])
    run = subprocess.run([sys.executable, *words], env=env, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr == (
        "neurove: evaluate: --device='cuda': torch is needed and not installed: pip install 'neurove[train]'\n"
    )


@pytest.mark.parametrize(
    ("source", "why"),
    [("pattern://", "it never ends"), ("sim://street", "it never ends"), ("sim://nowhere?seconds=1", "nowhere")],
)
def test_a_recording_without_truth_is_refused_in_one_line(run, source, why):
    code, out, err = run("evaluate", "untrained", source)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert why in err


@pytest.mark.parametrize(
    ("text", "why"),
    [(None, "No such file or directory"), ("0.1 5 6 1\n", "columns=4: expected 8 columns: t x y z qx qy qz qw")],
)
def test_a_wrong_truth_file_is_named_and_not_called_a_source(run, tmp_path, text, why):
    truth = tmp_path / "truth.txt"
    if text:
        truth.write_text(text)
    code, _, err = run("evaluate", "untrained", SOURCE, "--truth", truth)
    assert (code, truth.name in err, why in err, "source" in err, err.count("\n")) == (2, True, True, False, 1), err


def test_a_truth_of_another_time_is_refused_with_both_spans(run, tmp_path):
    truth = tmp_path / "truth.txt"
    truth.write_text("".join(f"{t / 10} 0 0 0 0 0 0 1\n" for t in range(1000, 1010)))
    code, _, err = run("evaluate", "untrained", SOURCE, "--truth", truth)
    assert (code, "windows 0.000 to 0.700 s, truth 100.000 to 100.900 s on the sensor clock" in err) == (2, True), err


def test_evaluate_uses_one_unit_for_error_and_sigma_and_judges_in_one_sentence(trained, run):
    model, source = str(trained / "out" / "tiny.safetensors"), "sim://street?seconds=0.8&trajectory=slider?vz=3"
    code, text, _ = run("evaluate", model, source + "&camera=pinhole:24x18:75")
    units = [line.split()[-1] for line in text.splitlines() if line[:2] in ("vx", "wy")]
    assert (code, units) == (0, ["m/s", "deg/s", "m/s", "deg/s"])
    assert "e+" not in text
    assert "constant truth, constant truth" in text
    assert text.count("linear velocity has a constant truth, and is ") == 1
    found = json.loads(run("evaluate", model, source + "&camera=pinhole:24x18:75", "--json")[1])
    sigma = found["uncertainty"]["per_axis"]["wy"]
    assert sigma["median_sigma_deg_s"] == pytest.approx(np.degrees(sigma["median_sigma_rad_s"]))
    assert found["judgement"] in text
    assert found["r2_v_l"] is None


def test_evaluate_refuses_a_folder_for_plots_before_it_runs(run, tmp_path):
    (tmp_path / "file").write_text("")
    code, out, err = run("evaluate", "untrained", SOURCE, "--plot", tmp_path / "file")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "--plot=" in err


def test_a_missing_recording_and_an_unknown_parameter_are_one_short_line(run, tmp_path):
    _, _, err = run("evaluate", "untrained", tmp_path / "nothing.h5")
    assert err == f"neurove: source '{tmp_path / 'nothing.h5'}': no such file or folder\n"
    _, _, err = run("evaluate", "untrained", "sim://street?sped=3")
    assert "unknown parameter 'sped'; known parameters: trajectory, seed, camera, height, pitch, seconds" in err


def test_a_file_of_poses_can_be_the_truth(trained, run, tmp_path):

    poses = open_source(SOURCE).trajectory.poses
    made = poses(np.arange(0, 800_001, 5_000))
    lines = [
        " ".join(f"{value:.9f}" for value in (t / 1e6, *position, *q))
        for t, position, q in zip(made.t, made.position_m, made.orientation, strict=True)
    ]
    truth = tmp_path / "truth.txt"
    truth.write_text("\n".join(lines) + "\n")
    model = str(trained / "out" / "tiny.safetensors")
    code, out, _ = run("evaluate", model, SOURCE, "--truth", str(truth), "--json")
    exact = json.loads(run("evaluate", model, SOURCE, "--json")[1])
    assert code == 0
    assert json.loads(out)["rmse_v_l_m_s"] == pytest.approx(exact["rmse_v_l_m_s"], rel=0.02)


def test_evaluate_reports_the_coverage_of_a_calibrated_model_and_draws_its_reliability(trained, run, tmp_path):
    path = trained / "out" / "tiny.safetensors"
    code, text, _ = run("evaluate", str(path), SOURCE, "--plot", str(tmp_path), "--json")
    found = json.loads(text)["uncertainty"]
    assert code == 0
    assert set(found["coverage"]) == {"vx", "vy", "vz", "wx", "wy", "wz"}
    assert found["coverage"]["wy"]["0.5"] <= found["coverage"]["wy"]["0.99"] <= 1
    assert found["per_axis"]["vz"]["median_sigma_m_s"] > 0
    assert (tmp_path / "reliability.png").stat().st_size > 1000
    _, text, _ = run("evaluate", str(path), SOURCE)
    assert "share of the truth in its interval" in text
    _, text, _ = run("evaluate", "untrained", SOURCE)
    assert "`neurove calibrate` adds it" in text


LENS = """image_width: {0.width}
image_height: {0.height}
distortion_model: plumb_bob
camera_matrix: {{rows: 3, cols: 3, data: [{fx!r}, 0, {0.cx!r}, 0, {0.fy!r}, {0.cy!r}, 0, 0, 1]}}
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
"""


def figures(run, model, *arguments):
    code, out, err = run("evaluate", model, SOURCE, "--json", *arguments)
    assert code == 0, err
    return json.loads(out)


def test_the_height_of_the_command_line_scales_the_linear_part_only(trained, run):
    model = trained / "out" / "tiny.safetensors"
    found = [figures(run, model, "--height", height)["per_axis"] for height in (1.5, 3.0, 4.5)]
    first, second, third = ([one[axis]["bias_m_s"] for axis in ("vx", "vy", "vz")] for one in found)
    assert np.subtract(third, second) == pytest.approx(np.subtract(second, first), rel=1e-6)  # truth cancels out
    assert np.abs(np.subtract(second, first)).max() > 1e-3
    assert found[0] == figures(run, model)["per_axis"]  # the height of the scene
    assert {axis: found[2][axis] for axis in ("wx", "wy", "wz")} == {
        axis: found[0][axis] for axis in ("wx", "wy", "wz")
    }


def test_the_lens_of_the_command_line_replaces_that_of_the_recording(run, tmp_path):
    pytest.importorskip("ruamel.yaml")
    lens, file = open_source(SOURCE).camera("cam0"), tmp_path / "lens.yaml"
    arguments = ("--calibration", file, "--height", lens.height_m)
    file.write_text(LENS.format(lens, fx=lens.fx))
    expected = figures(run, "untrained")["per_axis"]
    assert figures(run, "untrained", *arguments)["per_axis"] == expected
    file.write_text(LENS.format(lens, fx=0.5 * lens.fx))
    assert figures(run, "untrained", *arguments)["per_axis"]["wy"] != expected["wy"]


def test_a_lens_of_another_sensor_is_refused_in_one_line(run, tmp_path):
    pytest.importorskip("ruamel.yaml")
    lens, file = open_source(SOURCE).camera("cam0"), tmp_path / "lens.yaml"
    file.write_text(LENS.format(lens.model_copy(update={"width": 25}), fx=lens.fx))
    code, out, err = run("evaluate", "untrained", SOURCE, "--calibration", file)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "image size='25x18': the events' sensor is 24x18" in err
