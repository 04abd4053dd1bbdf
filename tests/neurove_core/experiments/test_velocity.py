"""The velocity experiment: one recipe for all methods, held-out scenarios, tables of the results."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import estimate_recording
from neurove_core.evaluation.evaluate import evaluate
from neurove_core.experiments import real
from neurove_core.experiments.velocity import report, run
from neurove_core.experiments.velocity.held_out import (
    CONTRAST_GROUPS,
    DAY1_TRAINED_S,
    GROUPS,
    HeldOutCache,
    held_out_scenarios,
    training_drives,
)
from neurove_core.experiments.velocity.tracks import Track, blind_predictors, follow, summary
from neurove_core.models import bundle
from neurove_core.training import config as configs
from neurove_protocol.errors import InvalidField
from neurove_service.cli import main
from tests.recordings import SHARED, shared

RESULTS = Path(real.__file__).parent / "results"
QUICK = run.base_config(quick=True)


def quiet(what: str, done: int, of: int, about: str) -> None:
    pass


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished quick experiment: sequences, two methods, results."""
    folder = tmp_path_factory.mktemp("velocity")
    experiment = run.Experiment(QUICK, ("nve", "ann"), range(1), None, quick=True)
    found = list(run.reproduce(experiment, folder / "data", folder, quiet))
    return folder, experiment, found, run.results(experiment, folder / "data", found)


def test_methods_differ_only_in_their_model():
    base = run.base_config()
    assert base == configs.load("driving")
    made = {method: run.method_config(base, method, 0) for method in run.METHODS}
    assert {method: one.model.kind for method, one in made.items()} == {
        "nve": "neurove",
        "nve-wo": "neurove",
        "ann": "ann",
        "snn-ang": "snn-ang",
    }
    assert not made["nve-wo"].model.network.diffusion
    for one in made.values():
        assert (one.recipe, one.data, one.model.window, one.model.canonical) == (
            base.recipe,
            base.data,
            base.model.window,
            base.model.canonical,
        )
    assert run.method_config(base, "nve", 3).recipe.seed == base.recipe.seed + 3


def test_held_out_scenes_and_trajectories_are_not_used_for_training():
    wanted = held_out_scenarios()
    assert {scenario.group for scenario in wanted} == set(GROUPS) - {"mvsec"}
    learned_from = min(configs.load(name).data.seed for name in ("default", "driving"))
    assert max(scenario.simulation.seed for scenario in wanted) < 1_000_000 <= learned_from
    heights = [scenario.simulation.lens.height_m for scenario in wanted if scenario.group == "heights"]
    assert (min(heights), max(heights)) == (0.3, 2.5)
    assert len({scenario.simulation.lens.name for scenario in wanted if scenario.group == "cameras"}) == 5


def test_training_and_evaluation_use_different_parts_of_day_1():
    for day in ("1", "2"):
        shared(f"mvsec/outdoor_day{day}_odom.h5")
    learned = training_drives(SHARED, 6.0, 1.5)
    tested = [scenario for scenario in held_out_scenarios(SHARED) if scenario.group == "mvsec"]
    on_day1 = [float(scenario.name.split()[2]) for scenario in learned if scenario.name.startswith("outdoor_day1")]
    assert len(learned) == 48
    assert 5 < len(on_day1) < 15
    assert max(on_day1) + 6.0 <= DAY1_TRAINED_S < min(float(scenario.name.split()[1]) for scenario in tested)
    assert {scenario.simulation.lens.info.lens for scenario in (*learned, *tested)} == {"equidistant"}
    twists = [scenario.simulation.trajectory.twist(np.linspace(0, 5, 20)) for scenario in tested]
    assert np.abs(twists).max() < 20
    assert np.mean([twist[:, 2].mean() for twist in twists]) > 2  # it drives forward


def test_without_the_poses_there_are_no_drives_and_the_table_says_so(finished):
    assert training_drives(None, 6.0, 1.5) == []
    assert training_drives(Path("nowhere"), 6.0, 1.5) == []
    _, _, _, results = finished
    assert "mvsec" not in results["groups"]
    assert "Left out: MVSEC's poses are missing" in report.markdown(results)


def test_a_track_has_the_estimates_of_the_estimator_on_the_same_recording(finished):
    folder, experiment, found, _ = finished
    model = bundle.load(folder / "nve-0" / "nve-0.safetensors")
    scenario = next(scenario for scenario in held_out_scenarios(quick=True) if scenario.group == "driving")
    track, _ = follow(model, HeldOutCache(folder / "data", experiment.config.model).path(scenario), scenario)
    evaluated = evaluate(estimate_recording(Estimator(model), scenario.simulation), scenario.simulation.twists())
    bins = len(evaluated.truth)
    assert len(track.truth) - bins in (0, 5)  # an event after the last window of a recording closes it
    np.testing.assert_allclose(track.estimate[:bins], evaluated.estimate, atol=1e-4)
    np.testing.assert_allclose(track.truth[:bins], evaluated.truth, atol=2e-3)
    np.testing.assert_allclose(track.t_s[:bins] * 1e6, evaluated.end_us - 5_000)
    results = found[0].row["recordings"][f"driving: {scenario.name}"]
    assert results["rmse_v_l_m_s"] == pytest.approx(summary([track])["rmse_v_l_m_s"])


def test_finished_methods_and_sequences_are_reused(finished):
    folder, experiment, found, results = finished
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    again = list(run.reproduce(experiment, folder / "data", folder, quiet))
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()} == before
    assert [one.row for one in again] == [one.row for one in found]
    assert run.results(experiment, folder / "data", again) == results


def test_a_folder_of_another_recipe_is_refused(finished):
    folder, experiment, _, _ = finished
    other = experiment._replace(config=run.base_config(None, 8, quick=True), methods=("ann",))
    with pytest.raises(InvalidField, match="out='ann-0': it holds a run of another configuration"):
        list(run.reproduce(other, folder / "data", folder, quiet))


def test_a_method_trained_on_real_drives_too_has_a_folder_of_its_own(finished, tmp_path):
    folder, experiment, _, _ = finished
    held_out = HeldOutCache(folder / "data", experiment.config.model)
    more = [held_out.path(scenario) for scenario in held_out_scenarios(quick=True)[:2]]
    config = run.method_config(run.base_config(None, 4, quick=True), "nve", 0)
    made = run.ensure_trained(config, tmp_path, folder / "data", more, quiet)
    assert made.name == "nve-0-mvsec"
    assert (
        "4 simulated sequences of 0.8 s from seed 1000000 and 2 more"
        in bundle.load(made / "nve-0.safetensors").provenance
    )


def test_a_method_is_trained_on_the_device_of_the_experiment(finished, tmp_path):
    folder, experiment, _, _ = finished
    config = experiment._replace(config=run.base_config(None, 1, quick=True), device=torch.device("meta"))
    with pytest.raises((NotImplementedError, RuntimeError), match="meta"):  # its tensors have no values
        list(run.reproduce(config, folder / "data", tmp_path, quiet))


def test_the_blind_predictors_are_zero_and_the_best_constant():
    rng = np.random.default_rng(0)
    truth = rng.normal(1.0, 1.0, (200, 6))
    track = Track("driving", "one", np.arange(200) / 100, truth, truth, 5)
    results = blind_predictors([track, track._replace(name="two", truth=truth + 1)])
    assert results["zero"]["driving"]["re_v_l"] == pytest.approx(1)
    assert results["mean"]["driving"]["r2_v_l"] == pytest.approx(0, abs=1e-9)
    assert summary([track])["rmse_v_l_m_s"] == 0


def test_the_figures_of_gehrig_2020_are_a_mean_length_and_a_median_ratio():
    truth = np.zeros((4, 6))
    truth[:, 5] = np.radians([0.5, 10, 20, 40])
    estimate = truth.copy()
    estimate[:, 3] = np.radians([5, 1, 4, 4])
    results = summary([Track("driving", "one", np.zeros(4), truth, estimate, 1)])
    assert results["gehrig_mean_error_deg_s"] == pytest.approx(3.5)
    assert results["gehrig_median_re"] == pytest.approx(0.1)


def test_contrast_maximisation_is_evaluated_on_its_groups_and_for_rotation_only(finished):
    _, _, _, results = finished
    assert set(results["blind"]["contrast maximisation"]) == set(CONTRAST_GROUPS) - {"mvsec"}
    hand_held = results["blind"]["contrast maximisation"]["hand-held"]
    assert hand_held["re_v_l"] is None
    assert hand_held["rmse_v_a_deg_s"] > 0


def test_wrong_methods_steps_and_seeds_are_refused():
    with pytest.raises(InvalidField, match="methods=.*known are nve, nve-wo, ann, snn-ang"):
        run.method_config(QUICK, "gru", 0)
    with pytest.raises(InvalidField, match="steps"):
        run.base_config(None, 0)
    experiment = run.Experiment(QUICK, ("nve",), range(0), None, quick=True)
    with pytest.raises(InvalidField, match="seeds=0"):
        list(run.reproduce(experiment, Path("nowhere"), Path("nowhere"), quiet))


def test_the_quick_command_trains_all_methods_and_writes_tables_and_plots(finished, tmp_path, capsys):
    folder, *_ = finished
    arguments = ["reproduce", "velocity", "--quick", "--data", str(folder / "data"), "--out", str(tmp_path)]
    assert main.main(arguments) == 0
    table = capsys.readouterr().out
    results = json.loads((tmp_path / "velocity-quick.json").read_text())
    assert table == report.markdown(results) == (tmp_path / "velocity-quick.md").read_text()
    assert [row["method"] for row in results["runs"]] == list(run.METHODS)
    for name in ("NeuroVE", "NeuroVE w/o", "equal-size ANN", "SNN-ANG", "the mean of this truth", "zero"):
        assert f"| {name} |" in table
    plots = {path.name for path in tmp_path.glob("*.png")}
    assert plots == {f"velocity-quick-{name}.png" for name in ("tracks", "errors", "curves")}
    runs = {row["method"]: row for row in results["runs"]}
    assert runs["nve"]["firing_rate"] > 0
    assert runs["ann"]["firing_rate"] is None
    assert runs["nve"]["cost"] == 1.0


def test_seeds_give_a_mean_and_a_spread(finished):
    *_, results = finished
    other = json.loads(json.dumps(results))
    for row in other["runs"]:
        row["seed"] = 1
        row["groups"]["driving"]["re_v_l"] += 0.1
    both = results | {"runs": results["runs"] + other["runs"]}
    text = report.markdown(both)
    assert "2 seeds, mean ± spread between seeds" in text
    first = results["runs"][0]["groups"]["driving"]["re_v_l"]
    assert f"{first + 0.05:.2f} ± 0.07 /" in text


def test_with_recordings_the_real_drives_and_the_checks_on_real_events_are_included(finished, tmp_path, capsys):
    for check in real.CHECKS:
        shared(check.recording)
    folder, *_ = finished
    arguments = ["--quick", "--methods", "ann", "--data", str(folder / "data"), "--out", str(tmp_path), "--json"]
    assert main.main(["reproduce", "velocity", *arguments, "--recordings", str(SHARED)]) == 0
    results = json.loads(capsys.readouterr().out)
    assert results["drives"] == 2
    assert "mvsec" in results["groups"]
    assert "| SNN-ANG |" not in (tmp_path / "velocity-quick.md").read_text()
    assert (tmp_path / "real.md").is_file()


@pytest.mark.parametrize("file", sorted(RESULTS.glob("velocity*.json")), ids=lambda file: file.name)
def test_committed_tables_match_the_committed_json(file):
    results = json.loads(file.read_text())
    assert file.with_suffix(".md").read_text() == report.markdown(results)


def test_a_street_without_texture_gives_few_events_in_the_lower_image():
    made = {scenario.group: scenario.simulation for scenario in held_out_scenarios(quick=True)}
    lower = {}
    for scene in ("driving", "bare street"):
        events = [step.events for step in made[scene].steps()]
        lower[scene] = sum(int((one.y >= 14).sum()) for one in events)
    assert lower["bare street"] < 0.25 * lower["driving"]  # parked cars still show
