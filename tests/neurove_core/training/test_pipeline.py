"""A training run called from Python does what `neurove train` does."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neurove_core.models import bundle
from neurove_core.training import config as configs
from neurove_core.training import pipeline
from neurove_core.training.loop import RUN_JSON
from neurove_protocol.errors import BadModel, InvalidField
from neurove_service.cli import main
from tests import tiny


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder of a run that was called from Python, and all progress that it reported."""
    folder, reported = tmp_path_factory.mktemp("pipeline"), []
    (folder / "tiny.toml").write_text(tiny.toml())
    config = configs.load(str(folder / "tiny.toml"))
    path = pipeline.train(
        config, folder / "out", calibration_sequences=16, on_progress=lambda *step: reported.append(step)
    )
    assert path == folder / "out" / "tiny.safetensors"
    return folder, reported


def files_in(out: Path) -> set[str]:
    """Relative paths of the files; TensorBoard puts the time into the names of its files."""
    found = (path.relative_to(out) for path in out.rglob("*") if path.is_file())
    return {path.parts[0] if path.parts[0] == "tensorboard" else str(path) for path in found if path.parts[0] != "data"}


def test_a_run_called_from_python_leaves_the_same_files_and_weights_as_the_command(trained):
    folder, _ = trained
    out, by_command = folder / "out", folder / "by-command"
    arguments = ["train", str(folder / "tiny.toml"), "--out", str(by_command), "--data", str(out / "data"), "--json"]
    assert main.main([*arguments, "--calibration-sequences", "16", "--device", "cpu"]) == 0
    assert {"tiny.safetensors", "checkpoint.safetensors", "run.json"} <= files_in(out)
    assert files_in(by_command) == files_in(out)
    one, other = (bundle.load(each / "tiny.safetensors") for each in (out, by_command))
    weights = other.network.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in one.network.state_dict().items())
    assert one.uncertainty is not None
    assert (one.golden.twists == other.golden.twists).all()
    curves = [json.loads((each / RUN_JSON).read_text())["curve"] for each in (out, by_command)]
    assert [point["linear_error_m_s"] for point in curves[0]] == [point["linear_error_m_s"] for point in curves[1]]


def test_progress_is_reported_for_each_task_up_to_its_last_step(trained):
    _, reported = trained
    last = {task: (done, of) for task, done, of, _ in reported}
    assert list(last) == ["simulated", "simulated to validate", "trained", "simulated to calibrate"]
    assert last == {
        "simulated": (2, 2),
        "simulated to validate": (8, 8),
        "trained": (8, 8),
        "simulated to calibrate": (16, 16),
    }
    details = [detail for task, _, _, detail in reported if task == "trained"]
    assert all(" m/s " in detail and ", validation " in detail for detail in details)


def test_existing_sequences_are_not_simulated_again(trained):
    folder, _ = trained
    reported = []
    config = configs.load(str(folder / "tiny.toml"))
    pipeline.train(
        config,
        folder / "again",
        data=folder / "out" / "data",
        calibration_sequences=0,
        on_progress=lambda task, *_: reported.append(task),
    )
    assert set(reported) == {"trained"}
    assert bundle.load(folder / "again" / "tiny.safetensors").uncertainty is None


def test_wrong_arguments_are_refused_before_anything_is_simulated(tmp_path):
    (tmp_path / "tiny.toml").write_text(tiny.toml())
    config = configs.load(str(tmp_path / "tiny.toml"))
    start = replace(bundle.untrained(), linear_unit=bundle.PER_HEIGHT)
    with pytest.raises(BadModel, match="the configuration has"):
        pipeline.train(config, tmp_path / "out", start=start)
    with pytest.raises(InvalidField, match=r"devices=3: recipe.batch=2 does not split"):
        pipeline.check(config, tmp_path / "out", devices=3)
    assert not (tmp_path / "out").exists()
