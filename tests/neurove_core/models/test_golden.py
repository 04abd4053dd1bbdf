"""The golden test: stored compactly, it passes on a machine that computes alike and fails on one that does not."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from neurove_core import self_test
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.estimator import Estimator
from neurove_core.models import bundle, golden
from neurove_core.models.golden import Golden
from neurove_core.spiking import plain
from neurove_protocol import Sensor
from neurove_protocol.errors import BadModel
from tests.builders import make_events
from tests.bundles import CONFIG, ORIGINAL, make_bundle, refusal, with_fields, with_tensors


def make_counts(windows: int = 5, *, mean: float = 0.4, seed: int = 0, config: ModelConfig = CONFIG):
    grid = (windows, 2 * config.window.bins, config.canonical.height, config.canonical.width)
    return np.random.default_rng(seed).poisson(mean, grid).astype(np.uint8)


def with_test(counts=None, model=ORIGINAL, **how):
    """The model with a golden test."""
    test = self_test.record(Estimator(model), make_counts() if counts is None else counts, **how)
    return replace(model, golden=test)


TESTED = with_test().to_bytes()


def test_a_golden_test_is_saved_with_its_model_and_passes():
    loaded = bundle.from_bytes(TESTED, "x")
    assert loaded.golden is not None
    np.testing.assert_array_equal(loaded.golden.counts, make_counts())
    assert loaded.golden.twists.shape == (5, 2, 6)
    assert loaded.golden.tolerance == golden.TOLERANCE
    self_test.check(Estimator(loaded))
    assert loaded.to_bytes() == TESTED


def test_a_model_without_a_golden_test_passes_the_self_test():
    assert ORIGINAL.golden is None
    self_test.check(Estimator(ORIGINAL))


def test_the_twists_are_those_for_the_events_of_a_camera():
    estimator = Estimator(ORIGINAL)
    sensor = Sensor(CONFIG.canonical.width, CONFIG.canonical.height)
    events = make_events(3_000, duration_us=50_000, sensor=sensor)
    state = estimator.initial_state(sensor)
    counts = np.stack([window.counts for window in estimator.to_windows(events, state, 50_000).windows])
    seen = estimator.push(events, estimator.initial_state(sensor), 50_000)
    want = np.stack([estimate.twists for estimate in seen.estimates])
    np.testing.assert_array_equal(self_test.answers(estimator, counts), want)


def test_windows_without_events_and_saturated_windows_are_all_processed():
    counts = make_counts(30)
    counts[[0, 1, 7]] = 0  # and below a long gap, which a camera's stream would skip
    counts[3, 0, 0, 0] = 255
    counts[8:29] = 0
    model = replace(ORIGINAL, config=CONFIG)
    test = self_test.record(Estimator(model), counts)
    assert len(test.twists) == 30
    self_test.check(Estimator(bundle.from_bytes(replace(model, golden=test).to_bytes(), "x")))


def test_the_reference_implementation_passes_the_golden_test_of_the_fast_path():
    loaded = bundle.from_bytes(TESTED, "x")
    with plain.plain():
        self_test.check(Estimator(loaded))


@pytest.mark.parametrize("axis", range(6))
def test_a_difference_is_refused_with_its_window_bin_and_axis(axis):
    model = with_test()
    wrong = model.golden.twists.copy()
    wrong[3, 1, axis] += 0.03
    with pytest.raises(BadModel, match=rf"golden test: window 3, bin 1: {('vx', 'vy', 'vz', 'wx', 'wy', 'wz')[axis]}="):
        self_test.check(Estimator(replace(model, golden=model.golden._replace(twists=wrong))))
    self_test.check(Estimator(replace(model, golden=model.golden._replace(twists=wrong, tolerance=0.05))))


@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_the_error_for_an_int8_model_says_that_int8_once_covered_less(precision):
    network = CONFIG.network.model_copy(update={"precision": precision})
    model = with_test(model=make_bundle(network=network))
    off = model.golden._replace(twists=model.golden.twists + np.float32(0.1))
    with pytest.raises(BadModel, match="golden test: window") as refused:
        self_test.check(Estimator(replace(model, golden=off)))
    assert ("before the projection was in int8" in str(refused.value)) == (precision == "int8")


def test_the_tolerance_is_relative_to_the_scale_of_the_model():
    coarse = with_test(model=replace(ORIGINAL, scale=torch.full((6,), 100.0)))
    off = coarse.golden.twists + np.float32(1.5)
    self_test.check(Estimator(replace(coarse, golden=coarse.golden._replace(twists=off))))


def test_changed_weights_are_refused():
    changed = with_test()
    network = copy.deepcopy(changed.network)
    with torch.no_grad():
        network.readout.weight[0] += 0.5
    with pytest.raises(BadModel, match="golden test"):
        self_test.check(Estimator(replace(changed, network=network)))


def test_a_twist_that_is_not_finite_is_refused():
    broken = with_test()
    network = copy.deepcopy(broken.network)
    with torch.no_grad():
        network.readout.bias[0] = float("nan")
    with pytest.raises(BadModel, match="golden test.*vx=nan"):
        self_test.check(Estimator(replace(broken, network=network)))


def test_a_golden_test_of_the_default_size_makes_a_bundle_at_most_200_kb_larger():
    config = ModelConfig(network=NetworkConfig(channels=(2,), features=2, hidden=2))
    model = bundle.untrained(config=config)
    counts = make_counts(golden.WINDOWS, mean=0.15, config=config)
    grown = len(with_test(counts, model).to_bytes()) - len(model.to_bytes())
    assert golden.stored_bytes(counts) < grown < 200_000


@pytest.mark.parametrize("windows", [1, 3])
@pytest.mark.parametrize(("width", "height"), [(9, 9), (8, 8), (11, 13)])
def test_grids_of_every_size_are_saved_and_loaded(windows, width, height):
    config = CONFIG.model_copy(update={"canonical": CanonicalConfig(width=width, height=height)})
    counts = make_counts(windows, config=config)
    loaded = bundle.from_bytes(with_test(counts, bundle.untrained(config=config)).to_bytes(), "x")
    np.testing.assert_array_equal(loaded.golden.counts, counts)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda t: t.pop("golden.seen"), ("'golden.seen' is missing", "three tensors")),
        (lambda t: t.pop("golden.counts"), ("'golden.counts' is missing",)),
        (lambda t: t.pop("golden.twists"), ("'golden.twists' is missing",)),
        (lambda t: t.update({"golden.twists": torch.zeros(5, 2, 5)}), ("'golden.twists' is float32 (5, 2, 5)",)),
        (
            lambda t: t.update({"golden.twists": torch.zeros(4, 2, 6)}),
            ("'golden.seen' is uint8 (200,)", "(160,)"),
        ),
        (lambda t: t.update({"golden.twists": torch.zeros(0, 2, 6)}), ("0 windows: 0 cells",)),
        (lambda t: t.update({"golden.twists": torch.tensor(1.0)}), ("0 windows",)),
        (lambda t: t.update({"golden.twists": torch.zeros(1 << 20, 0)}), ("cells, allowed are",)),
        (lambda t: t.update({"golden.twists": torch.zeros(5, 2, 6).double()}), ("float64", "needs float32")),
        (lambda t: t["golden.twists"].fill_(float("nan")), ("'golden.twists'", "not finite")),
        (lambda t: t.update({"golden.seen": t["golden.seen"].int()}), ("int32", "needs uint8 (200,)")),
        (lambda t: t["golden.seen"].fill_(0), ("'golden.counts'", "needs uint8 (0,)")),
        (lambda t: t.update({"golden.counts": t["golden.counts"][1:].clone()}), ("'golden.counts'", "needs")),
        (lambda t: t["golden.counts"][3:4].zero_(), ("a count is 0",)),
        (lambda t: t.update({"golden.more": torch.zeros(1)}), ("'golden.more' is not one of this architecture",)),
    ],
    ids=range(15),
)
def test_invalid_golden_tensors_are_refused(edit, words):
    message = refusal(with_tensors(edit, TESTED))
    for word in words:
        assert word in message


def test_a_bit_after_the_last_cell_is_refused():
    config = CONFIG.model_copy(update={"canonical": CanonicalConfig(width=9, height=9)})  # 324 cells: 4 bits are left
    data = with_test(make_counts(1, config=config), bundle.untrained(config=config)).to_bytes()

    def edit(tensors):
        tensors["golden.seen"][-1] |= 1
        tensors["golden.counts"] = torch.cat([tensors["golden.counts"], torch.ones(1, dtype=torch.uint8)])

    assert "after the last cell" in refusal(with_tensors(edit, data))


def test_golden_tensors_need_their_tolerance():
    assert "golden_tolerance=missing" in refusal(with_fields(lambda fields: fields.pop("golden_tolerance"), TESTED))


def test_a_golden_test_is_recorded_with_the_given_tolerance():
    assert with_test(tolerance=0.5).golden.tolerance == 0.5
    assert isinstance(with_test().golden, Golden)
