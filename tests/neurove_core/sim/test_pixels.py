"""Simulated pixels: their response to light, their noise, and the compiled loop against its reference."""

import numpy as np
import pytest
from pydantic import ValidationError

from neurove_core.sim.render.pixels import (
    QUIET,
    EventBuffer,
    PixelConfig,
    PixelState,
    events_of,
    find_crossings,
    find_crossings_reference,
    low_pass,
    make_pixels,
    settled_state,
)
from neurove_protocol import Sensor
from neurove_protocol.errors import InvalidField, TimeBackwards
from neurove_protocol.events import check_events

SENSOR = Sensor(40, 30)
N = SENSOR.width * SENSOR.height
FRAME_US = 5000


def quiet(**changes: float) -> PixelConfig:
    return PixelConfig(**(QUIET.model_dump() | changes))


def film(config: PixelConfig, frames: np.ndarray, seed: int = 0, period_us: int = FRAME_US):
    """Events of frames (T, H, W) of log intensity, in order, and the last state."""
    pixels = make_pixels(config, N, seed)
    state = settled_state(pixels, frames[0].astype(np.float32).ravel())
    parts, levels = [], [state.level]
    for k, frame in enumerate(frames[1:]):
        events, state = events_of(pixels, state, frame, k * period_us, (k + 1) * period_us, SENSOR)
        check_events(events, SENSOR, k * period_us)
        parts.append(events)
        levels.append(state.level)
    return pixels, parts, levels, state


def waves(seed: int, frames: int = 20, contrast: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, 0.15 * contrast, (frames, SENSOR.height, SENSOR.width))
    return np.cumsum(steps, axis=0) - 1


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("cutoff_hz", [0, 300])
def test_the_compiled_pixels_equal_the_reference_bit_for_bit(seed, cutoff_hz):
    config = PixelConfig(cutoff_hz=cutoff_hz, leak_hz=5)
    rng = np.random.default_rng(seed)
    pixels = make_pixels(config, N, seed)
    light = rng.normal(-1, 1, N).astype(np.float32)
    state = plain = settled_state(pixels, light)
    state = PixelState(*(column.copy() for column in state))
    for _ in range(5):
        light = (light + rng.normal(0, 0.5, N)).astype(np.float32)
        weights = low_pass(config.cutoff_hz, 700.0)
        found = EventBuffer.empty(100 * N)
        done, n = find_crossings(pixels.mismatch, state, light, 0, 0, weights, 300.0, 1000.0, found)
        rows, plain = find_crossings_reference(pixels.mismatch, plain, light, weights, 300.0, 1000.0)
        assert done == N
        assert n == len(rows) > 100
        np.testing.assert_array_equal(np.stack([found.t[:n], found.pixel[:n], found.p[:n]], 1), rows)
        np.testing.assert_array_equal(state.level, plain.level)
        np.testing.assert_array_equal(state.seen, plain.seen)


def test_pixels_continue_after_a_full_buffer():
    pixels = make_pixels(QUIET, N, 0)
    light = np.zeros(N, np.float32)
    jump = np.linspace(-3, 3, N).astype(np.float32)
    whole, state = EventBuffer.empty(100 * N), settled_state(pixels, light)
    _, n = find_crossings(pixels.mismatch, state, jump, 0, 0, (0.0, 0.0, 1.0), 0.0, 900.0, whole)
    state, done, rows = settled_state(pixels, light), 0, []
    while done < N:
        little = EventBuffer.empty(100)
        done, some = find_crossings(pixels.mismatch, state, jump, 0, done, (0.0, 0.0, 1.0), 0.0, 900.0, little)
        rows += list(zip(little.t[:some], little.pixel[:some], strict=True))
    assert rows == list(zip(whole.t[:n], whole.pixel[:n], strict=True))


@pytest.mark.parametrize("seed", range(3))
def test_events_times_threshold_add_up_to_the_change_of_log_intensity(seed):
    frames = waves(seed)
    pixels, parts, levels, _ = film(quiet(threshold_sigma=0.03, threshold_off=0.3), frames, seed)
    total = np.zeros(N)
    for events in parts:
        where = events.y.astype(int) * SENSOR.width + events.x
        np.add.at(total, where, np.where(events.p > 0, pixels.mismatch.on[where], -pixels.mismatch.off[where]))
    changed = (frames[-1] - frames[0]).ravel()
    np.testing.assert_allclose(levels[-1] - levels[0], total, atol=1e-6)
    assert (np.abs(total - changed) <= pixels.mismatch.on + pixels.mismatch.off + 1e-5).all()


@pytest.mark.parametrize("contrast", [1.0, 2.0, 4.0])
def test_a_ramp_makes_contrast_over_threshold_events_evenly_in_time(contrast):
    frames = np.linspace(0, contrast, 11)[:, None, None] * np.ones((11, SENSOR.height, SENSOR.width))
    _, parts, _, _ = film(quiet(threshold_on=0.1), frames)
    n = sum(events.n for events in parts)
    assert n == pytest.approx(N * (contrast / 0.1 - 0.5), rel=0.02)  # half an event is pending at the end on average
    assert all(events.p.all() for events in parts)
    per_frame = [events.n for events in parts]
    assert max(per_frame) - min(per_frame) <= 0.1 * n
    pixel = np.concatenate([events.t[(events.x == 3) & (events.y == 4)] for events in parts])
    np.testing.assert_allclose(np.diff(pixel), 10 * FRAME_US * 0.1 / contrast, atol=1.01)


def test_the_number_of_events_scales_as_contrast_over_threshold():
    def count(contrast: float, threshold: float) -> int:
        config = quiet(threshold_on=threshold, threshold_off=threshold)
        return sum(events.n for events in film(config, waves(0, contrast=contrast))[1])

    assert count(2.0, 0.04) == pytest.approx(count(1.0, 0.02), rel=0.02)
    assert count(1.0, 0.02) == pytest.approx(2 * count(1.0, 0.04), rel=0.2)


def test_constant_light_makes_only_noise_at_the_configured_rate():
    seconds, config = 4.0, PixelConfig(leak_hz=0, shot_noise_hz=2.0, hot_fraction=0)
    frames = np.zeros((int(seconds * 1e6 / 50_000) + 1, SENSOR.height, SENSOR.width))
    n = sum(events.n for events in film(config, frames, period_us=50_000)[1])
    expected = 2.0 * N * seconds
    assert abs(n - expected) < 5 * np.sqrt(expected) + 0.002 * expected  # 5 sigma, and the loss in the refractory time
    assert not sum(events.n for events in film(quiet(), frames, period_us=50_000)[1])


def test_a_leak_makes_on_events_at_its_rate():
    frames = np.zeros((41, SENSOR.height, SENSOR.width))
    _, parts, _, _ = film(quiet(leak_hz=3.0), frames, period_us=50_000)
    assert sum(events.n for events in parts) == pytest.approx(N * (3.0 * 2.0 - 0.5), rel=0.03)  # as above
    assert all(events.p.all() for events in parts)


def test_only_hot_pixels_fire_and_at_their_rate():
    frames = np.zeros((41, SENSOR.height, SENSOR.width))
    pixels, parts, _, _ = film(quiet(hot_fraction=0.05, hot_hz=80), frames, period_us=50_000)
    where = np.concatenate([events.y.astype(int) * SENSOR.width + events.x for events in parts])
    assert set(where.tolist()) == set(pixels.hot.tolist())
    expected = 80 * 2.0 * pixels.hot.size
    assert abs(where.size - expected) < 5 * np.sqrt(expected)


def test_no_pixel_makes_an_event_within_its_refractory_time():
    _, parts, _, _ = film(PixelConfig(refractory_us=1500, shot_noise_hz=100), waves(1, contrast=5))
    t = np.concatenate([events.t for events in parts])
    where = np.concatenate([events.y.astype(int) * SENSOR.width + events.x for events in parts])
    order = np.lexsort((t, where))
    same = np.diff(where[order]) == 0
    assert np.diff(t[order])[same].min() >= 1500


@pytest.mark.parametrize("span_us", [10.0, 500.0, 20_000.0])
def test_the_response_of_the_low_pass_to_a_ramp_is_exact(span_us):
    kept, old, new = low_pass(300.0, span_us)
    tau = 1e6 / (2 * np.pi * 300)
    seen, light, slope = 0.3, 1.0, 2e-4
    # y' = (x - y) / tau with x = light + slope t
    exact = light + slope * (span_us - tau) + (seen - light + slope * tau) * np.exp(-span_us / tau)
    assert kept * seen + old * light + new * (light + slope * span_us) == pytest.approx(exact, abs=1e-9)


def test_a_cutoff_delays_events_and_loses_none():
    frames = np.zeros((12, SENSOR.height, SENSOR.width))
    frames[1:] = 1.0
    fast, slow = (film(quiet(cutoff_hz=hz), frames)[1] for hz in (0, 100))
    assert sum(events.n for events in slow) == sum(events.n for events in fast)
    assert np.mean(np.concatenate([e.t for e in slow])) > np.mean(np.concatenate([e.t for e in fast])) + 500


def test_a_seed_determines_the_events():
    frames = waves(3)
    first, again, other = (film(PixelConfig(), frames, seed)[1] for seed in (1, 1, 2))
    for a, b in zip(first, again, strict=True):
        for left, right in zip(a, b, strict=True):
            np.testing.assert_array_equal(left, right)
    assert any(a.n != b.n or (a.t != b.t).any() for a, b in zip(first, other, strict=True))


def test_a_step_does_not_change_the_state_that_it_gets():
    pixels = make_pixels(QUIET, N, 0)
    state = settled_state(pixels, np.zeros(N, np.float32))
    kept = [column.copy() for column in state]
    events_of(pixels, state, np.ones((SENSOR.height, SENSOR.width)), 0, 1000, SENSOR)
    for before, after in zip(kept, state, strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("field", ["threshold_on", "threshold_off"])
@pytest.mark.parametrize("value", [0, -0.2, float("nan")])
def test_a_threshold_not_above_zero_is_refused_with_its_name_value_and_bound(field, value):
    with pytest.raises(ValidationError) as caught:
        PixelConfig(**{field: value})
    (error,) = caught.value.errors()
    assert error["loc"] == (field,)
    if value == value:
        assert error["input"] == value
        assert "greater than 0" in error["msg"]


@pytest.mark.parametrize(
    ("frame", "stop_us", "error", "field"),
    [
        (np.zeros((30, 41)), 1000, InvalidField, "shape"),
        (np.full((30, 40), np.nan), 1000, InvalidField, "light"),
        (np.zeros((30, 40)), 20_000_000, InvalidField, "t"),
        (np.zeros((30, 40)), 0, TimeBackwards, None),
    ],
)
def test_a_frame_that_does_not_fit_is_refused(frame, stop_us, error, field):
    pixels = make_pixels(QUIET, N, 0)
    with pytest.raises(error) as caught:
        events_of(pixels, settled_state(pixels, np.zeros(N, np.float32)), frame, 0, stop_us, SENSOR)
    assert field is None or caught.value.details["field"] == field
