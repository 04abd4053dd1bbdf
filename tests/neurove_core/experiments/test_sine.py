"""The sine experiment: its data, its figures, and that a seed determines the run."""

import json
from pathlib import Path

import numpy as np
import pytest

from neurove_core.experiments.sine import data, report
from neurove_core.experiments.sine.data import LENGTH, Network, Recipe, evaluate, waves
from neurove_core.experiments.sine.training import train
from neurove_protocol.errors import InvalidField

pytest.importorskip("scipy", reason="scipy is not installed: pip install 'neurove[experiments]'")

QUICK = Path(data.__file__).parents[1] / "results" / "sine-quick.json"
TINY = Recipe(model="aslstm", hidden=8, updates=12, fine_updates=6)


def test_waves_continue_as_the_same_sine():
    rows = waves()
    assert rows.shape == (100, LENGTH)
    truth = data.continued(rows)
    np.testing.assert_allclose(truth[:LENGTH].T, rows, atol=1e-6)
    np.testing.assert_allclose(truth[2:] + truth[:-2], 2 * np.cos(0.05) * truth[1:-1], atol=1e-6)  # to its end


@pytest.mark.parametrize("model", list(data.KINDS))
def test_training_lowers_the_error_and_keeps_frozen_weights(model):
    recipe = Recipe(model=model, hidden=16, v_th=0.2, updates=80, fine_updates=0)
    before = Network(recipe, np.random.default_rng(0))
    trained = train(recipe, seed=0)
    worst = [max(evaluate(network)[0].regression_rmse_x1000_from_100) for network in (before, trained.network)]
    assert worst[1] < 0.6 * worst[0]
    frozen = ~trained.network.learned
    assert np.array_equal(trained.network.theta[frozen], before.theta[frozen])
    diffuses = any(layer.d_space.any() for layer in trained.network.weights[:1])
    assert diffuses == (model == "aslstm")


def test_the_seed_determines_the_run():
    first, again, other = (train(TINY, seed).network.theta for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


def test_learned_thresholds_change_and_stay_above_their_bound():
    recipe = Recipe(model="aslstm", hidden=8, v_th=0.05, learn_v_th=True, updates=30, fine_updates=0, lr=0.05)
    thresholds = np.concatenate([layer.v_th for layer in train(recipe, 0).network.weights[:2]])
    assert len(np.unique(thresholds)) > 4
    assert (thresholds >= 0.02 - 1e-6).all()


def test_a_diverging_network_has_finite_errors():
    network = Network(TINY, np.random.default_rng(0))
    network.weights.first.d_time[:] = 50.0
    result, _ = evaluate(network)
    assert all(np.isfinite(result.forecast_rmse))
    assert min(result.forecast_rmse) > 1


def test_a_target_rate_in_the_loss_makes_layers_fire_more():
    free, held = (Recipe(model="aslstm", v_th=0.5, hidden=16, rate=r, updates=150, fine_updates=0) for r in (0, 0.3))
    fewer, more = (evaluate(train(recipe, 0).network)[0].spike_rate for recipe in (free, held))
    assert all(b > a + 0.05 for a, b in zip(fewer, more, strict=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hiden": "5"}, r"hiden='5': known are model, hidden, .*rate"),
        ({"hidden": "many"}, r"hidden='many': .*integer"),
        ({"v_th": "0"}, r"v_th='0': .*greater than 0"),
        ({"rate": "1"}, r"rate='1': .*less than 1"),
    ],
)
def test_errors_name_a_wrong_change(changes, message):
    with pytest.raises(InvalidField, match=message):
        next(report.reproduce(["aslstm"], [0], changes=changes))


def test_an_unknown_model_is_named():
    with pytest.raises(InvalidField, match="models='gru': known are aslstm"):
        next(report.reproduce(["gru"], [0]))


def test_quick_reproduces_the_committed_figures(tmp_path):
    committed = json.loads(QUICK.read_text())
    runs = []
    for run in report.reproduce([run["model"] for run in committed], [0], quick=True):
        runs.append(run)
        report.save_run(runs, tmp_path, command="a test", commit="none")
    for run, wanted in zip(runs, committed, strict=True):
        figures = run.figures
        rtol = 0.1 if run.model == "aslstm" else 0.5  # spikes amplify rounding differences between machines
        for key in ("regression_rmse_x1000_from_100", "regression_rmse_x1000"):
            np.testing.assert_allclose(figures[key], wanted[key], rtol=rtol, err_msg=run.model)
        assert (figures["updates"], figures["parameters"]) == (wanted["updates"], wanted["parameters"])
    report.save(runs, tmp_path)
    written = {file.name for file in tmp_path.iterdir()}
    assert written >= {"table1.md", "table2.json", "regression.png", "spikes.svg", "aslstm-0.safetensors"}
    table = (tmp_path / "table1.md").read_text()
    assert "| ltc |" in table
    assert "3.16 / 3.67 / 3.92" in table  # the figures of the paper
    again = json.loads((tmp_path / "sine.json").read_text())
    assert [run["model"] for run in again] == list(report.RECIPES)
    assert all({"v_th", "spike_rate", "cpu_s", "command", "commit"} <= run.keys() for run in again)


def test_the_tables_of_the_page_match_the_committed_results():
    figures = json.loads((QUICK.parent / "sine.json").read_text())
    page = (QUICK.parents[1] / "README.md").read_text()
    for number, rows in report.tables(figures).items():
        assert report.markdown(rows, number) in page
