"""Time scales: a slow stream in longer windows is estimated as a fast one, divided by the scale."""

from dataclasses import replace
from typing import cast

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.estimator import Estimator
from neurove_core.geometry.camera import lookup_table
from neurove_core.ingest import windows
from neurove_core.ingest.windows import Window, WindowsState
from neurove_core.models import bundle
from neurove_core.models.bundle import PER_HEIGHT
from neurove_core.stream_state import WindowEstimate
from neurove_core.timescales import STEPS, Answer, Longer, chosen, merged, watched
from neurove_core.training.calibration import collect_errors
from neurove_core.training.data import Sequences
from neurove_protocol import Events, Sensor
from tests.builders import make_events

SENSOR = Sensor(24, 16)
GRID = CanonicalConfig(width=12, height=8)
PLAIN = ModelConfig(
    window=WindowConfig(duration_us=10_000, bins=5),
    canonical=GRID,
    network=NetworkConfig(channels=(4, 8), features=16, hidden=16),
)
ALL = (1e9, 1e9)


def scaled(scales: tuple[int, ...], bounds: tuple[float, float] = ALL, floor: float = 0.0) -> ModelConfig:
    return ModelConfig.model_validate(
        PLAIN.model_dump() | {"scales": scales, "scale_bounds": bounds, "scale_floor": floor}
    )


def events_of(seconds: float) -> Events:
    return make_events(n=40_000, seed=1, duration_us=round(seconds * 1e6), sensor=SENSOR)


def estimates(config: ModelConfig, events: Events) -> list[WindowEstimate]:
    estimator = Estimator(bundle.untrained(3, config))
    return estimator.push(events, estimator.initial_state(SENSOR), 0).estimates


def windows_of(events: Events, config: ModelConfig) -> list[Window]:
    lut = lookup_table(GRID, SENSOR, None)
    return windows.push(events, 0, WindowsState(0), lut, config.window, GRID).windows


@pytest.mark.parametrize("scale", [2, 3, 4])
def test_merged_windows_have_the_counts_of_one_long_window(scale):
    events = events_of(0.5)
    long = PLAIN.model_copy(update={"window": WindowConfig(duration_us=10_000 * scale, bins=5)})
    short = windows_of(events, PLAIN)
    for number, window in enumerate(windows_of(events, long)):
        newest = [one.counts for one in short[number * scale : (number + 1) * scale]][::-1]
        assert np.array_equal(merged(newest, PLAIN), window.counts)


@pytest.mark.parametrize("scale", [2, 4])
def test_a_stream_slowed_down_is_estimated_at_that_part_of_its_velocity(scale):
    fast = events_of(0.3)
    slow = fast._replace(t=fast.t * scale)
    at_once, slowly = estimates(PLAIN, fast), estimates(scaled((scale,)), slow)
    ends = {one.end_us: one for one in slowly}
    compared = 0
    for one in at_once[STEPS:-1]:
        share = one.twists[5 - max(1, 5 // scale) :].mean(0) / scale
        np.testing.assert_allclose(ends[one.end_us * scale].twists, np.tile(share, (5, 1)), rtol=1e-5, atol=1e-7)
        compared += 1
    assert compared > 20
    assert np.stack([one.twists for one in at_once]).std() > 0


def test_a_motion_beyond_the_bounds_is_estimated_from_one_window():
    events = events_of(0.3)
    plain, bounded = estimates(PLAIN, events), estimates(scaled((2, 4), (1e-9, 1e-9)), events)
    assert all(np.array_equal(a.twists, b.twists) for a, b in zip(plain, bounded, strict=True))


def test_a_stationary_camera_is_estimated_from_one_window():
    events = events_of(0.3)
    plain = estimates(PLAIN, events)
    slowest = min(float(np.linalg.norm(one.twists.mean(axis=0)[:3])) for one in plain)
    floored = estimates(scaled((2, 4), floor=1e9), events)
    assert all(np.array_equal(a.twists, b.twists) for a, b in zip(plain, floored, strict=True))
    moving = estimates(scaled((2, 4), floor=0.9 * slowest), events)
    longer = estimates(scaled((2, 4)), events)
    assert all(np.array_equal(a.twists, b.twists) for a, b in zip(longer, moving, strict=True))


def test_a_long_window_answers_only_if_each_of_its_windows_shows_a_speed():
    config = scaled((2,), floor=0.2)
    still, moving = (np.tile([0.0, 0.0, speed, 0.0, 0.5, 0.0], (5, 1)) for speed in (0.1, 0.3))
    state = bundle.untrained(3, config).network.initial_state()
    short, long = Answer(moving, state), Answer(moving / 2, state, 2)
    longer, chosen_scales = Longer(windows=100), []
    for twists in (moving, moving, still, moving, moving):
        longer = watched(longer, twists, config)
        chosen_scales.append(chosen([short, long], longer, config.scale_bounds).scale)
    assert chosen_scales == [1, 2, 1, 1, 2]


def test_the_longest_scale_answers_from_the_third_long_window_on():
    events = events_of(0.4)
    plain, two, both = (estimates(config, events) for config in (PLAIN, scaled((2,)), scaled((2, 4))))
    assert [np.array_equal(a.twists, b.twists) for a, b in zip(plain, two, strict=True)][:6] == [True] * 5 + [False]
    assert [np.array_equal(a.twists, b.twists) for a, b in zip(two, both, strict=True)][:12] == [True] * 11 + [False]


def test_windows_in_packets_and_in_one_piece_give_the_same_estimates():
    estimator, events = Estimator(bundle.untrained(3, scaled((2, 4)))), events_of(0.3)
    state, found = estimator.initial_state(SENSOR), []
    for first in range(0, events.n, 777):
        piece = events.span(first, min(first + 777, events.n))
        answer = estimator.push(piece, state, piece.first_us)
        state, found = answer.state, found + answer.estimates
    whole = estimates(scaled((2, 4)), events)
    assert len(found) == len(whole)
    assert all(np.array_equal(a.twists, b.twists) for a, b in zip(found, whole, strict=True))


def test_a_gap_begins_the_longer_windows_anew():
    estimator = Estimator(bundle.untrained(3, scaled((2,))))
    stream = windows_of(events_of(0.3), PLAIN)
    _, state = estimator.follow(stream, estimator.initial_state(SENSOR))
    assert state.longer.windows == len(stream)
    moved = [one._replace(start_us=one.start_us + 1_000_000) for one in stream]
    after, state = estimator.follow(moved, state)
    fresh, _ = estimator.follow(stream, estimator.initial_state(SENSOR))
    assert all(np.array_equal(a.twists, b.twists) for a, b in zip(after, fresh, strict=True))


def test_a_model_without_scales_is_stored_as_before_and_one_with_them_keeps_them():
    assert "scale" not in PLAIN.model_dump_json()
    made = bundle.untrained(3, scaled((2, 4), (3.0, 0.4), 0.1))
    assert bundle.from_bytes(made.to_bytes(), "x").config == made.config


def test_scales_and_a_history_exclude_each_other():
    network = PLAIN.network.model_copy(update={"history": (1,)})
    with pytest.raises(ValidationError, match=r"scales=\(2,\): a model with network.history=\(1,\) has none"):
        ModelConfig.model_validate(PLAIN.model_dump() | {"network": network, "scales": (2,)})


def test_a_calibration_fits_the_answers_that_the_service_gives():
    model = scaled((2, 3), (30.0, 30.0))
    plain = bundle.untrained(3, model)
    made = replace(plain, scale=plain.scale * 20, linear_unit=PER_HEIGHT)  # so that the bounds divide the windows
    stored = np.stack([window.counts for window in windows_of(events_of(0.2), PLAIN)])
    truth = np.random.default_rng(0).normal(size=(len(stored), 5, 6)).astype(np.float32)

    class Drawn:
        twists = (truth,)

        def __len__(self) -> int:
            return 1

        def counts(self, _: int, first: int, stop: int) -> np.ndarray:
            return stored[first:stop]

    errors = next(collect_errors(made, [(cast("Sequences", Drawn()), False)]))
    in_torch = next(collect_errors(made, [(cast("Sequences", Drawn()), False)], torch.device("cpu")))
    np.testing.assert_allclose(in_torch.error, errors.error, atol=1e-4)
    estimator = Estimator(made)
    served, _ = estimator.follow(windows_of(events_of(0.2), PLAIN), estimator.initial_state(SENSOR))
    off = np.stack([one.twists for one in served]) - truth
    scale = np.round(errors.error * 20 / off).mean((1, 2))
    assert set(scale) == {1.0, 2.0, 3.0}
    np.testing.assert_allclose(errors.error * 20, off * scale[:, None, None], rtol=1e-3, atol=1e-3)
