"""Training: sequences with the windows of the service, augmentations with correct truth, and exact resumption."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from neurove_core import self_test
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.estimator import Estimator
from neurove_core.geometry.camera import lookup_table
from neurove_core.io.errors import BrokenRecording
from neurove_core.models import bundle
from neurove_core.sim.motion.trajectory import Mounted, rotation
from neurove_core.sim.render.camera import named_camera
from neurove_core.sim.render.pixels import PixelConfig
from neurove_core.sim.simulate import Simulation
from neurove_core.sim.world.scene import named_scene
from neurove_core.training import config as configs
from neurove_core.training import data
from neurove_core.training.batches import (
    backwards,
    doubled,
    draw,
    lopsided,
    mirrored,
    polarity_flipped,
    stationary,
    thinned,
    with_gain,
    with_gaps,
    with_hot_pixels,
    with_noise,
)
from neurove_core.training.config import DataConfig, RecipeConfig, TrainingConfig
from neurove_core.training.loop import CHECKPOINT, RUN_JSON, golden_windows, learning_rate, train, train_segment
from neurove_core.training.run import TrainingRun
from neurove_protocol import Events
from neurove_protocol.errors import BadModel, InvalidField

MODEL = ModelConfig(
    canonical=CanonicalConfig(width=22, height=16, hfov_deg=80),
    network=NetworkConfig(channels=(4, 8), features=16, hidden=16),
)
TINY = TrainingConfig(
    name="tiny",
    model=MODEL,
    data=DataConfig(sequences=3, seconds=0.5, cameras={"pinhole:24x18": 1.0}),
    recipe=RecipeConfig(steps=12, batch=4, segment_windows=4, chunk_windows=2, warm_up_steps=2, checkpoint_s=0),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sequences")
    assert len(list(data.Cache(folder, TINY).fill())) == 3
    return folder


@pytest.fixture(scope="module")
def sequences(folder):
    return data.Cache(folder, TINY).open()


def longer(steps):
    return TINY.model_copy(update={"recipe": TINY.recipe.model_copy(update={"steps": steps})})


def test_a_sequence_has_the_counts_of_the_service_and_the_truth_of_each_bin():
    simulation = data.draw_simulation(TINY.data, 0)
    sequence = data.sequence_of(simulation, MODEL)
    assert sequence.counts.shape == (10, 10, 16, 22)
    assert sequence.twists.shape == (10, 5, 6)
    estimator = Estimator(bundle.untrained(config=MODEL))
    lut = lookup_table(MODEL.canonical, simulation.sensor, simulation.lens.info)
    state = estimator.initial_state(simulation.sensor, simulation.lens.info)
    assert (state.lut == lut).all()
    windows = []
    none = Events.from_columns([], [], [], [])
    for events, horizon_us in [*((chunk, 0) for chunk in simulation.chunks()), (none, 500_000)]:
        pushed = estimator.to_windows(events, state, horizon_us)
        state = state._replace(windows=pushed.state)
        windows += pushed.windows
    np.testing.assert_array_equal(np.stack([window.counts for window in windows]), sequence.counts)
    middle_s = np.array([3 * 0.05 + 2.5 * 0.01])
    twist = simulation.trajectory.twist(middle_s)[0]
    twist[:3] /= simulation.lens.height_m
    np.testing.assert_allclose(sequence.twists[3, 2], twist, rtol=1e-3, atol=1e-4)


def test_a_sequence_depends_only_on_its_seed_and_number():
    first, again, other = (data.draw_simulation(TINY.data, index) for index in (1, 1, 2))
    assert (first.name, first.pixels, first.lens) == (again.name, again.pixels, again.lens)
    assert first.pixels != other.pixels
    heights = [data.draw_simulation(DataConfig(seconds=0.5), index).lens.height_m for index in range(20)]
    assert 0.3 <= min(heights) < 0.8 < 1.5 < max(heights) <= 2.5


def test_cached_sequences_are_not_simulated_again_and_other_data_settings_have_their_own(folder):
    assert not list(data.Cache(folder, TINY).fill())
    assert len(data.Cache(folder, longer(50)).missing()) == 0
    other = TINY.model_copy(update={"data": TINY.data.model_copy(update={"seed": 5})})
    assert len(data.Cache(folder, other).missing()) == 3


def test_the_error_about_a_broken_sequence_names_its_file(folder, tmp_path):
    cache = data.Cache(tmp_path, TINY)
    cache.folder.mkdir(parents=True)
    whole = data.Cache(folder, TINY).path(0).read_bytes()
    for index, content in enumerate((whole, whole[:100], whole)):
        cache.path(index).write_bytes(content)
    with pytest.raises(BrokenRecording, match="000001"):
        cache.open()


def test_a_mirror_inverts_the_right_axes_and_two_mirrors_cancel():
    counts = np.random.default_rng(0).integers(0, 9, (3, 4, 5, 6)).astype(np.uint8)
    twists = np.arange(1, 37, dtype=np.float32).reshape(3, 2, 6)
    seen, truth = mirrored(counts, twists)
    assert (seen[..., 0] == counts[..., -1]).all()
    assert (np.sign(truth[0, 0]) == [-1, 1, 1, 1, -1, -1]).all()
    back, twist = mirrored(seen, truth)
    assert (back == counts).all()
    assert (twist == twists).all()


def test_a_mirrored_flow_is_the_flow_of_the_mirrored_twist():
    def flow(x, y, depth, twist):
        (vx, vy, vz), (wx, wy, wz) = twist[:3], twist[3:]
        return (
            (x * vz - vx) / depth + x * y * wx - (1 + x * x) * wy + y * wz,
            (y * vz - vy) / depth + (1 + y * y) * wx - x * y * wy - x * wz,
        )

    twist = np.array([0.3, -0.2, 4.0, 0.1, -0.5, 0.2], np.float32)
    _, other = mirrored(np.zeros((1, 2, 3, 4), np.uint8), twist)
    u, v = flow(0.4, -0.3, 5.0, twist)
    assert flow(-0.4, -0.3, 5.0, other) == pytest.approx((-u, v))


def test_a_flip_swaps_the_polarities_of_each_bin():
    counts = np.arange(6, dtype=np.uint8)[None, :, None, None]
    assert polarity_flipped(counts).ravel().tolist() == [1, 0, 3, 2, 5, 4]


def test_doubled_speed_looks_like_a_camera_that_turns_twice_as_fast():
    def turning(rate, seconds):
        calm = PixelConfig(leak_hz=0, shot_noise_hz=0, threshold_sigma=0, refractory_us=0)
        camera = named_camera("pinhole:44x32:80")
        trajectory = Mounted(rotation(0, rate, 0, seconds), camera.height_m, camera.pitch_deg)
        return data.sequence_of(Simulation("room", named_scene("room"), trajectory, camera, calm, 7, seconds), MODEL)

    slow, fast = turning(1.0, 0.4), turning(2.0, 0.2)
    counts, twists = doubled(slow.counts, slow.twists)
    assert twists == pytest.approx(fast.twists, abs=1e-5)
    assert counts.shape == fast.counts.shape
    assert int(counts.sum()) == pytest.approx(int(fast.counts.sum()), rel=0.05)
    assert np.corrcoef(counts.ravel(), fast.counts.ravel())[0, 1] > 0.9


def test_reversed_time_inverts_every_velocity_and_twice_is_the_original():
    counts = np.random.default_rng(0).integers(0, 9, (3, 4, 5, 6)).astype(np.uint8)
    twists = np.arange(1, 37, dtype=np.float32).reshape(3, 2, 6)
    seen, truth = backwards(counts, twists)
    assert (truth[0, 0] == -twists[-1, -1]).all()
    assert (seen[0, 0] == counts[-1, -1]).all()  # the first OFF events are the last ON events
    assert (backwards(seen, truth)[0] == counts).all()
    assert (backwards(seen, truth)[1] == twists).all()


def test_doubled_counts_saturate():
    counts = np.full((2, 2, 1, 1), 200, np.uint8)
    assert (doubled(counts, np.zeros((2, 1, 6), np.float32))[0] == 255).all()


@pytest.mark.parametrize("motion", ["waved", "turned", "slid", "spun"])
def test_each_hand_held_motion_moves_and_turns_as_its_name_says(motion):
    config = DataConfig(seconds=2.0, scenes={"room": 1.0}, hands={motion: 1.0})
    for index in range(3):
        twist = data.draw_simulation(config, index).trajectory.twist(np.linspace(0, 2, 50))
        speed, rate = np.linalg.norm(twist[:, :3], axis=1).max(), np.linalg.norm(twist[:, 3:], axis=1).max()
        assert (speed > 1e-3) == (motion in ("waved", "slid"))
        assert (rate > 1e-3) == (motion != "slid")


def test_gain_and_noise_change_the_mean_as_requested_and_saturate():
    rng = np.random.default_rng(0)
    counts = rng.poisson(0.5, (20, 4, 30, 30)).astype(np.uint8)
    for gain in (0.5, 3.0):
        assert with_gain(rng, counts, gain).mean() == pytest.approx(gain * counts.mean(), rel=0.02)
    assert with_noise(rng, counts, 0.1).mean() == pytest.approx(counts.mean() + 0.1, rel=0.02)
    full = np.full((1, 2, 10, 10), 255, np.uint8)
    assert (with_gain(rng, full, 4.0) == 255).all()
    assert (with_noise(rng, full, 5.0) == 255).all()


def test_a_stationary_camera_sees_noise_that_differs_between_pixels_and_no_motion(sequences):
    rng = np.random.default_rng(3)
    noise = stationary(rng, (40, 10, 16, 22), 0.3)
    assert noise.dtype == np.uint8
    assert noise.mean() == pytest.approx(0.3, rel=0.1)
    rates = noise.reshape(200, 2, 16, 22).mean(axis=0)
    assert rates.std() == pytest.approx(0.3, rel=0.2)  # of an exponential distribution; equal pixels would give 0.04
    recipe = TINY.recipe.model_copy(update={"still": 1.0, "still_noise": (0.2, 0.2)})
    segment = draw(np.random.default_rng(1), sequences, recipe)
    assert not segment.twists.any()
    assert float(segment.counts.float().mean()) == pytest.approx(0.2, rel=0.2)


def test_gaps_come_after_complete_windows_and_the_camera_moves_during_them(sequences):
    recipe = RecipeConfig(segment_windows=48, holes=1.0)
    counts = np.random.default_rng(1).integers(1, 9, (48, 4, 5, 6), np.uint8)
    rng, lengths = np.random.default_rng(0), []
    for _ in range(50):
        seen = with_gaps(rng, counts, recipe)
        empty = ~seen.any(axis=(1, 2, 3))
        assert (seen[~empty] == counts[~empty]).all()
        assert empty.any()
        assert not empty[:4].any()
        edges = np.flatnonzero(np.diff(np.r_[False, empty, False]))
        lengths += (edges[1::2] - edges[::2]).tolist()
    assert min(lengths) == 1
    assert 15 <= max(lengths) <= 20
    whole = TINY.recipe.model_copy(update={"holes": 1.0, "segment_windows": 10, "doubled": 0.0})
    segment = draw(np.random.default_rng(1), sequences, whole)
    empty = ~segment.counts.flatten(2).any(2).T  # (B, S)
    assert empty.any()
    assert all(segment.twists[gap, stream].any() for stream, row in enumerate(empty) for gap in row.nonzero())


def test_events_are_removed_only_from_a_random_window_on():
    recipe = RecipeConfig(thinned=1.0, thinned_to=(0.1, 0.1))
    counts = np.full((32, 4, 20, 20), 3, np.uint8)
    for seed in range(10):
        means = thinned(np.random.default_rng(seed), counts, recipe).reshape(32, -1).mean(axis=1)
        first = int((means < 3).argmax())
        assert 4 <= first < 16
        assert (means[:first] == 3).all()
        assert means[first:] == pytest.approx(0.3, rel=0.15)


def test_the_ratio_of_polarities_changes_by_the_factor_and_the_geometric_mean_stays():
    counts = np.random.default_rng(0).poisson(2.0, (20, 4, 30, 30)).astype(np.uint8)
    seen = lopsided(np.random.default_rng(1), counts, 4.0)
    assert seen[:, 1::2].mean() == pytest.approx(4.0, rel=0.02)
    assert seen[:, ::2].mean() == pytest.approx(1.0, rel=0.02)


def test_hot_pixels_are_few_and_fire_in_every_window():
    counts = np.zeros((40, 10, 16, 22), np.uint8)
    recipe = RecipeConfig(hot=1.0, hot_rate=(10.0, 10.0))
    seen = with_hot_pixels(np.random.default_rng(2), counts, recipe)
    per_window = seen.sum(axis=1)
    hot = per_window.any(axis=0)
    assert 1 <= hot.sum() <= 10
    assert (per_window[:, hot] > 0).all()
    assert per_window[:, hot].mean() >= 0.9 * 10 * 5
    full = np.full_like(counts, 255)
    assert (with_hot_pixels(np.random.default_rng(2), full, recipe) == 255).all()


@pytest.mark.parametrize(
    ("section", "field", "value"),
    [("data", "spun_axis", [0, 0, 0]), ("data", "spun_rad_s", [0, 1]), ("recipe", "hole_windows", [0, 3])],
)
def test_a_log_uniform_span_from_zero_and_an_axis_of_length_zero_are_refused(section, field, value):
    with pytest.raises(ValidationError, match=field):
        TrainingConfig.model_validate({section: {field: value}})


def test_a_resumed_run_ends_with_the_weights_of_an_uninterrupted_run(folder, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    at_once = train(TINY, whole, folder)

    class Stopped(Exception):
        pass

    def stop(progress):
        if progress.step == 8:
            raise Stopped

    with pytest.raises(Stopped):
        train(TINY, parts, folder, on_progress=stop)
    resumed = train(TINY, parts, folder, resume=True)
    one, two = bundle.load(at_once), bundle.load(resumed)
    weights = two.network.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in one.network.state_dict().items())
    assert torch.equal(one.offset, two.offset)
    curves = [json.loads((out / RUN_JSON).read_text())["curve"] for out in (whole, parts)]
    assert [point["linear_error_m_s"] for point in curves[0]] == [point["linear_error_m_s"] for point in curves[1]]


def test_a_finished_run_continues_for_another_cycle_as_if_planned_from_the_start(folder, tmp_path):
    recipe = TINY.recipe.model_copy(update={"cycles": 2})
    planned = TINY.model_copy(update={"recipe": recipe})
    at_once = bundle.load(train(planned, tmp_path / "planned", folder))
    train(TINY, tmp_path / "longer", folder)
    longer_run = bundle.load(train(planned, tmp_path / "longer", folder, resume=True))
    assert longer_run.metadata.made_by.updates == 2 * TINY.recipe.steps
    weights = longer_run.network.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in at_once.network.state_dict().items())
    with pytest.raises(BadModel, match="recipe.cycles=2, the configuration has 1"):
        train(TINY, tmp_path / "longer", folder, resume=True)


def test_a_run_begins_from_the_weights_of_a_given_model(folder, sequences, tmp_path):
    first = bundle.load(train(TINY, tmp_path / "first", folder))
    network = MODEL.network.model_copy(update={"precision": "int8", "surrogate": "arctan"})
    config = TINY.model_copy(update={"model": MODEL.model_copy(update={"network": network, "settle_windows": 3})})
    run = TrainingRun.begin(config, sequences, start=first)
    weights = run.network.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in first.network.state_dict().items())
    assert torch.equal(run.scale, first.scale)
    assert torch.equal(run.offset, first.offset)
    made = bundle.load(train(config, tmp_path / "second", folder, start=first))
    assert f"begun from {first.digest[:12]}" in made.provenance
    assert made.metadata.made_by.program == f"neurove train tiny, begun from {first.digest[:12]}"
    assert json.loads((tmp_path / "second" / RUN_JSON).read_text())["start"] == first.digest
    resumed = bundle.load(train(config, tmp_path / "second", folder, resume=True))
    assert resumed.digest == made.digest


def test_the_uncertainty_of_a_start_model_is_not_copied(folder, sequences, tmp_path):
    first = bundle.load(train(TINY, tmp_path, folder))
    first.network.add_spread()
    assert TrainingRun.begin(TINY, sequences, start=first).network.spread is None


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"network": MODEL.network.model_copy(update={"hidden": 8})}, "network.hidden=16, the configuration has 8"),
        ({"canonical": CanonicalConfig(width=20, height=16)}, "canonical.width=22, the configuration has 20"),
        ({"kind": "ann"}, "kind=neurove, the configuration has ann"),
    ],
)
def test_a_run_does_not_begin_from_a_model_of_another_shape(sequences, change, why):
    start = replace(bundle.untrained(config=MODEL), linear_unit=bundle.PER_HEIGHT)
    with pytest.raises(BadModel, match=why):
        TrainingRun.begin(TINY.model_copy(update={"model": MODEL.model_copy(update=change)}), sequences, start=start)


def test_a_run_does_not_begin_from_a_model_with_another_linear_unit(sequences):
    with pytest.raises(BadModel, match="linear_unit='m/s'"):
        TrainingRun.begin(TINY, sequences, start=bundle.untrained(config=MODEL))


def test_a_checkpoint_of_another_recipe_is_refused_and_the_error_names_the_field(folder, tmp_path):
    train(TINY, tmp_path, folder)
    with pytest.raises(BadModel, match="recipe.steps=12, the configuration has 16"):
        train(longer(16), tmp_path, folder, resume=True)
    (tmp_path / CHECKPOINT).write_bytes(b"no checkpoint")
    with pytest.raises(BadModel, match="not a usable checkpoint"):
        train(TINY, tmp_path, folder, resume=True)


def test_the_loss_falls_within_a_few_hundred_updates(sequences):
    recipe = TINY.recipe.model_copy(update={"steps": 400, "learning_rate": 0.01})
    run = TrainingRun.begin(TINY.model_copy(update={"recipe": recipe}), sequences)
    losses = [train_segment(run, draw(run.rng, sequences, recipe)) for _ in range(100)]
    first, last = (np.mean([loss.linear for one in part for loss in one]) for part in (losses[:5], losses[-5:]))
    assert last < 0.8 * first


def test_the_trained_bundle_has_its_provenance_and_unit(folder, tmp_path):
    made = bundle.load(train(TINY, tmp_path, folder))
    assert made.trained
    assert made.linear_unit == "1/s per m of height"
    assert "12 updates" in made.provenance
    assert json.loads((tmp_path / RUN_JSON).read_text())["config"] == TINY.model_dump(mode="json")


def test_the_trained_bundle_records_its_recipe_and_has_a_golden_test_of_training_windows(folder, sequences, tmp_path):
    made = bundle.load(train(TINY, tmp_path, folder))
    made_by = made.metadata.made_by
    assert (made_by.program, made_by.seed, made_by.updates) == ("neurove train tiny", 0, 12)
    assert TrainingConfig(name="tiny", model=made.config, data=made_by.data, recipe=made_by.recipe) == TINY
    curve = json.loads((tmp_path / RUN_JSON).read_text())["curve"]
    assert made.metadata.figures == {
        f"training_{name}": curve[-1][name] for name in ("linear_error_m_s", "angular_error_rad_s")
    }
    seen = [sequences.counts(index, 0, 10) for index in range(3)]
    busiest = max(seen, key=np.count_nonzero)
    np.testing.assert_array_equal(made.golden.counts, busiest)
    self_test.check(Estimator(made))


class Busy:
    """Sequences with events in every cell of every window."""

    def __init__(self, windows, cells):
        self._seen = np.ones((windows, 10, cells, 10), np.uint8)
        self.twists = [np.zeros((windows, 5, 6), np.float32)] * 9

    def __len__(self):
        return len(self.twists)

    def counts(self, index, start, stop):
        assert index < 8
        return self._seen[start:stop]


@pytest.mark.parametrize(("cells", "windows"), [(100, 12), (300, 3), (1_000, 1), (5_000, 1)])
def test_large_grids_have_fewer_golden_windows(cells, windows):
    assert golden_windows(Busy(20, cells)).shape == (windows, 10, cells, 10)
    assert golden_windows(Busy(4, 10)).shape == (4, 10, 10, 10)


def test_the_learning_rate_rises_falls_and_ends_at_zero():
    recipe = RecipeConfig(steps=100, warm_up_steps=10, learning_rate=0.01)
    rates = [learning_rate(step, recipe) for step in range(101)]
    assert max(rates) == rates[9] == rates[10] == 0.01
    assert rates[100] == pytest.approx(0)
    assert np.all(np.diff(rates[:10]) > 0)
    assert np.all(np.diff(rates[10:]) < 0)


def test_the_configurations_of_the_default_model_share_one_network():
    first, then, last = (configs.load(name) for name in ("default", "longer", "rest"))
    assert {one.name for one in (first, then, last)} == {"default"}
    assert first.model == then.model == last.model
    seeds = [set(range(one.data.seed, one.data.seed + one.data.sequences)) for one in (first, then)]
    assert not seeds[0] & seeds[1]  # no sequence is used in both
    assert configs.load("int8").data == last.data == then.data


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("name = 'a b'", "name='a b': String should match"),
        ("[recipe]\nsteps = 0", "recipe.steps=0: Input should be greater than or equal to 1"),
        ("[recipe]\nsegment_windows = 30", "chunks of 8"),
        ("[data]\nseconds = 0.5", "data.seconds=0.5 has 10 windows"),
        ("[data]\nheight_m = [2.0, 1.0]", "lower value must come first"),
        ("unknown = 1", "unknown"),
        ("= 1", "not TOML"),
    ],
)
def test_an_invalid_configuration_is_refused_and_the_error_names_the_fault(tmp_path, text, why):
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(InvalidField, match=why):
        configs.load(str(path))


def test_the_error_about_a_missing_configuration_lists_the_built_in_ones():
    with pytest.raises(InvalidField, match="default"):
        configs.load("nowhere.toml")
