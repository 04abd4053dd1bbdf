"""neurove train and calibrate, end to end on a tiny model and tiny sequences."""

import json
import shutil

import pytest

from neurove_core.models import bundle


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
