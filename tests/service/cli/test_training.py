"""neurove train, calibrate and evaluate, end to end on a tiny model and tiny sequences."""

import json
import shutil

import numpy as np
import pytest

from neurove_core.models import bundle
from neurove_core.sources import open_source
from neurove_service.cli import main

CONFIG = """
name = "tiny"
[model.canonical]
width = 22
height = 16
[model.network]
channels = [4, 8]
features = 16
hidden = 16
[data]
sequences = 2
seconds = 0.5
[data.cameras]
"pinhole:24x18" = 1.0
[recipe]
steps = 8
batch = 2
segment_windows = 4
chunk_windows = 2
"""
SOURCE = "sim://street?seed=3&seconds=0.8&camera=pinhole:24x18:75"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("train")
    (folder / "tiny.toml").write_text(CONFIG)
    arguments = [
        "train",
        str(folder / "tiny.toml"),
        "--out",
        str(folder / "out"),
        "--calibration-sequences",
        "16",
        "--json",
    ]
    assert main.main(arguments) == 0
    return folder


def test_training_writes_a_bundle_a_checkpoint_and_a_summary(trained):
    out = trained / "out"
    model = bundle.load(out / "tiny.safetensors")
    assert (model.name, model.trained) == ("tiny", True)
    about = json.loads((out / "run.json").read_text())
    assert (about["step"], about["seed"], about["config"]["name"]) == (8, 0, "tiny")
    assert about["curve"][-1]["step"] == 8


def test_training_tells_the_error_on_scenes_that_it_did_not_train_on(trained, run, tmp_path):
    out = shutil.copytree(trained / "out", tmp_path / "out")  # without calibration, so not in the folder of the others
    arguments = ("train", trained / "tiny.toml", "--out", out, "--resume", "--calibration-sequences", "0")
    _, text, _ = run(*arguments)
    assert text.startswith("error on simulated scenes: linear ")
    _, text, _ = run(*arguments, "--json")
    assert json.loads(text)["validated"][0].startswith("error on simulated scenes: linear ")
    curve = json.loads((out / "run.json").read_text())["validation"]
    assert (curve[0]["step"], curve[-1]["step"]) == (0, 8)


@pytest.mark.parametrize("flag", ["--workers", "--threads", "--devices"])
def test_counts_of_a_run_are_above_0(run, capsys, flag):
    with pytest.raises(SystemExit):
        run("train", "default", flag, "0")
    assert "give a whole number above 0" in capsys.readouterr().err


def test_a_finished_run_resumed_gives_the_same_model(trained, run):
    path = trained / "out" / "tiny.safetensors"
    weights = bundle.load(path).network.state_dict()
    code, out, err = run(
        "train", str(trained / "tiny.toml"), "--out", str(trained / "out"), "--resume", "--calibration-sequences", "16"
    )
    assert (code, out.splitlines()[-1].startswith("wrote ")) == (0, True)
    assert "simulated" not in err
    again = bundle.load(path).network.state_dict()
    assert all((tensor == again[name]).all() for name, tensor in weights.items())


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


def test_a_wrong_configuration_ends_in_one_line(run, tmp_path):
    (tmp_path / "bad.toml").write_text("[recipe]\nsteps = 0\n")
    code, _, err = run("train", str(tmp_path / "bad.toml"))
    assert (code, err.count("\n")) == (2, 1)
    assert "recipe.steps" in err


def test_a_start_model_of_another_shape_is_refused_before_the_simulation(run, tmp_path):
    code, _, err = run("train", "velocity-quick", "--start", "default", "--out", str(tmp_path / "out"))
    assert code == 2
    assert err.strip() == "neurove: model default: it has canonical.width=86, the configuration has 22"
    assert not (tmp_path / "out").exists()


def test_training_ends_with_a_calibrated_model_and_calibrate_reports_its_coverage(trained, run):
    path = trained / "out" / "tiny.safetensors"
    assert bundle.load(path).uncertainty.provenance.startswith("neurove calibrate: 16 simulated sequences")
    arguments = (
        "calibrate",
        str(path),
        "--config",
        str(trained / "tiny.toml"),
        "--data",
        str(trained / "out" / "data"),
    )
    out = trained / "again.safetensors"
    code, text, err = run(*arguments, "--calibration-sequences", "16", "--out", str(out))
    assert (code, "simulated" in err) == (0, False)
    assert text.startswith(f"wrote {out}\nshare of the truth in the 90% interval")
    assert bundle.load(out).digest == bundle.load(path).digest
    code, text, _ = run(*arguments, "--calibration-sequences", "16", "--out", str(out), "--json", "--force")
    assert json.loads(text)["groups"]["unchanged"]["vz"]["0.9"] > 0.8


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
