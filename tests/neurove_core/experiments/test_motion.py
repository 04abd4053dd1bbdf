"""Accuracy by kind of motion: true figures for known estimates, kept events, and a table of every requirement."""

import json
from dataclasses import replace

import numpy as np
import pytest

from neurove_core.evaluation.estimates import Estimates
from neurove_core.evaluation.evaluate import evaluate
from neurove_core.experiments.motion import goals, sets
from neurove_core.experiments.motion import run as motion
from neurove_core.experiments.motion.kept import kept
from neurove_protocol.errors import EXIT_WRONG_USAGE


def test_a_figure_reaches_its_goal_its_requirement_or_neither():
    goal = goals.around("forward", "vz", [1.0, 2.0], [0.15, 0.3], [0.05, 0.1])
    assert (goal.must, goal.goal) == (((0.85, 1.15), (1.7, 2.3)), ((0.95, 1.05), (1.9, 2.1)))
    for found, reached in (([1.04, 2.0], "goal"), ([1.04, 1.75], "must"), ([1.04, 2.5], "no"), ([np.nan, 2], "no")):
        assert goals.row(goal, found)["reached"] == reached
    assert goals.row(goal, None, "why")["reached"] is None
    assert goals.row(goals.at_least("drives", "r", 0.7, 0.9), [0.8])["must"] == "at least 0.7"


def test_slow_drives_have_their_mean_speed_and_constant_motion_is_constant():
    found = sets.items(["slow", "forward", "turning"])
    assert [sum(item.group == group for item in found) for group in ("slow", "forward", "turning")] == [10, 15, 4]
    for item in found:
        t_s = np.linspace(0, item.simulation.duration_s, 50)
        speed = np.linalg.norm(item.simulation.trajectory.twist(t_s)[:, :3], axis=1)
        if item.group == "turning":
            assert speed.max() < 1e-9
            assert abs(item.simulation.trajectory.twist(1.0)[4]) == pytest.approx(0.5, rel=0.01)
        else:
            assert speed.mean() == pytest.approx(float(item.name.split()[0]), rel=0.25)


def test_kept_events_are_those_of_the_simulation_and_are_read_without_it(tmp_path):
    item = sets.items(["hand-held"], quick=True)[0]
    item = item._replace(simulation=replace(item.simulation, duration_s=0.3))
    first = kept(item, tmp_path)
    direct = [np.concatenate(column) for column in zip(*item.simulation.chunks(), strict=True)]
    read = [np.concatenate(column) for column in zip(*first.chunks(), strict=True)]
    for a, b in zip(direct, read, strict=True):
        np.testing.assert_array_equal(a, b)
    (file,) = tmp_path.iterdir()
    written = file.stat().st_mtime_ns
    assert kept(item, tmp_path).file == file
    assert file.stat().st_mtime_ns == written
    other = item._replace(simulation=replace(item.simulation, seed=1))
    assert kept(other, tmp_path).file != file


def as_if_estimated(item, factor, uncertain=False):
    """An evaluation whose estimates are the truth of an item times a factor."""
    recording = item.simulation
    start_us = np.arange(0, round(recording.duration_s * 1e6) - 50_000, 50_000)
    t_us = start_us[:, None] + np.arange(5) * 10_000 + 5_000
    twists = recording.twists().at(t_us.ravel()).reshape(*t_us.shape, 6) * factor
    windows = len(start_us)
    flags, sigma = np.full(windows, uncertain), np.full((windows, 6), 0.1)
    cost_ms = np.full(windows, 3.0)
    return evaluate(
        Estimates("", start_us, 10_000, twists, np.ones(windows, int), flags, cost_ms, {}, True, sigma, flags),
        recording.twists(),
    )


@pytest.mark.parametrize(("factor", "reached"), [(1.0, "goal"), (1.12, "must"), (1.3, "no")])
def test_constant_motion_is_judged_speed_by_speed(factor, reached):
    found = {}
    for item in sets.items(["forward", "turning"]):
        found.setdefault(item.group, []).append((item.name, as_if_estimated(item, factor)))
    rows = {row["what"]: row for row in motion.simulated_rows(found, ["forward", "turning"])}
    for height in (0.4, 1.0, 1.5):
        row = rows[f"vz at {height:g} m [m/s]"]
        assert row["found"] == pytest.approx([factor * v * np.cos(np.radians(5)) for v in sets.SPEEDS_M_S], rel=1e-3)
        assert row["reached"] == reached
    assert rows["yaw rate, greatest relative error"]["found"] == pytest.approx([factor - 1], abs=1e-6)
    assert rows["phantom speed, greatest median [m/s]"]["reached"] == "goal"
    assert rows["share of uncertain estimates"]["found"] == [0.0]
    assert rows["median time of a window, this machine [ms]"]["found"] == [3.0]


def test_the_relative_error_of_a_slow_drive_counts_slow_motion():
    item = next(item for item in sets.items(["slow"]) if item.name.startswith("0.27"))
    rows = motion.simulated_rows({"slow": [(item.name, as_if_estimated(item, 1.2))]}, ["slow", "trajectories"])
    by_set = {row["group"]: row for row in rows}
    assert by_set["slow"]["found"] == pytest.approx([0.2], abs=1e-6)
    assert by_set["trajectories"]["skipped"] == "its files are missing: --recordings DIR"


def test_the_command_evaluates_every_set_and_writes_what_it_prints(run, tmp_path):
    arguments = ("reproduce", "motion", "--quick", "--data", tmp_path / "data", "--out", tmp_path / "out")
    code, out, _ = run(*arguments)
    assert code == 0
    assert (tmp_path / "out" / "motion.md").read_text() == out
    results = json.loads((tmp_path / "out" / "motion.json").read_text())
    assert {row["group"] for row in results["rows"]} == {*sets.GROUPS, sets.REAL, "cost"}
    assert set(results["coverage"]) == set(sets.GROUPS) - {"trajectories"}
    skipped = {row["group"] for row in results["rows"] if row["skipped"]}
    assert skipped == {"trajectories", sets.REAL}


def test_the_network_on_a_device_gives_the_same_figures(run, tmp_path):
    arguments = ("reproduce", "motion", "--quick", "--data", tmp_path, "--sets", "slow,turning", "--json")
    (_, engine, _), (code, device, err) = run(*arguments), run(*arguments, "--device", "cpu")
    assert code == 0, err
    found, wanted = (json.loads(text)["recordings"] for text in (device, engine))
    assert list(found) == list(wanted)
    for name, figures in wanted.items():
        known = {figure: value for figure, value in figures.items() if value is not None}
        assert {figure: found[name][figure] for figure in known} == pytest.approx(known, rel=0.02, abs=1e-3)


def test_an_unknown_set_is_refused_before_anything_is_simulated(run, tmp_path):
    code, _, err = run("reproduce", "motion", "--sets", "drives,swimming", "--data", tmp_path / "data")
    assert code == EXIT_WRONG_USAGE
    assert "--sets='swimming': known are forward" in err
    assert not list((tmp_path / "data").glob("*.npy"))


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("--sets", "slow", "forward"), "--sets slow,forward"),
        (("--sets", "slow,", "forward"), "--sets slow,forward"),
        (("forward",), "--sets forward"),
    ],
)
def test_the_name_of_a_set_is_not_taken_for_a_model(run, tmp_path, words, meant):
    code, _, err = run("reproduce", "motion", *words, "--data", tmp_path / "data")
    assert code == EXIT_WRONG_USAGE
    assert "forward is the name of a set, not a model" in err
    assert err.strip().endswith(meant)
