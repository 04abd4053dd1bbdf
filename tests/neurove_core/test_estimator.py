"""Estimator.push: answers independent of packet sizes, independent streams, and correct flags."""

import contextlib
import doctest
import importlib
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

import neurove_core
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.estimator import Estimator, Push, PushResult
from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle
from neurove_core.stream_state import StreamState, WindowEstimate
from neurove_protocol import CameraInfo, Events, Sensor
from neurove_protocol.errors import BadModel, InvalidField
from tests.builders import SENSOR, make_events

README = Path(neurove_core.__file__).with_name("README.md")
DURATION_US, SETTLE, LOW = 10_000, 4, 50
CONFIG = ModelConfig(
    window=WindowConfig(duration_us=DURATION_US, bins=2, max_hole_windows=3),
    canonical=CanonicalConfig(width=16, height=12),
    network=NetworkConfig(channels=(4, 6), features=8, hidden=8),
    settle_windows=SETTLE,
    low_activity_events=LOW,
)
LENS = CameraInfo(
    stream="cam0",
    width=SENSOR.width,
    height=SENSOR.height,
    lens="pinhole",
    fx=30.0,
    fy=30.0,
    cx=33.0,
    cy=22.0,
    distortion=(-0.3, 0.1, 0.0, 0.0),
)


def make_bundle(seed: int = 0, **config) -> Bundle:
    return bundle.untrained(seed, CONFIG.model_copy(update=config))


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return Estimator(make_bundle())


def feed(estimator: Estimator, packets: list[Events], state: StreamState | None = None) -> PushResult:
    """The combined result of packets, each pushed with the time of its first event."""
    state = state or estimator.initial_state(SENSOR)
    estimates, late, outside, skipped = [], 0, 0, 0
    for events in packets:
        answer = estimator.push(events, state, int(events.t[0]))
        state = answer.state
        estimates += answer.estimates
        late, outside = late + answer.late_events, outside + answer.outside_events
        skipped += answer.skipped_windows
    return PushResult(estimates, state, late, outside, skipped)


def split_randomly(events: Events, seed: int, cuts: int = 25) -> list[Events]:
    edges = [0, *np.unique(np.random.default_rng(seed).integers(1, events.n, cuts)).tolist(), events.n]
    return [events.span(a, b) for a, b in pairwise(edges)]


def windows_of_events(count: int, *, first: int = 0, seed: int = 0, each: int = 150) -> list[Events]:
    """`count` packets, one for each window from number `first` on."""
    return [
        make_events(each, seed=seed + k, start_us=k * DURATION_US, duration_us=DURATION_US)
        for k in range(first, first + count)
    ]


def tick(window: int) -> Events:
    """One event at the start of a window: it completes the one before."""
    return Events.from_columns([window * DURATION_US], [0], [0], [0])


def assert_same_estimates(got: list[WindowEstimate], want: list[WindowEstimate]) -> None:
    assert [(*one[:2], *one[3:]) for one in got] == [(*one[:2], *one[3:]) for one in want]  # all but the twists
    for one, other in zip(got, want, strict=True):
        np.testing.assert_array_equal(one.twists, other.twists)


def assert_same_state(got: StreamState, want: StreamState) -> None:
    assert got.age == want.age
    np.testing.assert_array_equal(got.lut, want.lut)
    for one, other in zip(parts(got), parts(want), strict=True):
        np.testing.assert_array_equal(one, other)


def parts(state: StreamState) -> tuple[np.ndarray, ...]:
    return (*state.network.membranes, state.network.cells, state.network.readout)


def differ(one: WindowEstimate, other: WindowEstimate) -> bool:
    return bool(np.abs(one.twists - other.twists).max() > 1e-5)


@pytest.mark.parametrize("camera", [None, LENS], ids=["scaled", "lens"])
@pytest.mark.parametrize("seed", range(8))
def test_answers_do_not_depend_on_packet_sizes(estimator, seed, camera):
    events = make_events(3_000, seed=seed, start_us=-42_000, duration_us=120_000)
    one = feed(estimator, [events], estimator.initial_state(SENSOR, camera))
    split = feed(estimator, split_randomly(events, seed), estimator.initial_state(SENSOR, camera))
    assert len(one.estimates) == 12
    assert_same_estimates(split.estimates, one.estimates)
    assert_same_state(split.state, one.state)
    assert split[2:] == one[2:]


def test_every_window_is_answered_once_in_order_with_one_twist_for_each_bin(estimator):
    estimates = feed(estimator, windows_of_events(6, first=-3, seed=3)).estimates
    assert [(one.start_us, one.end_us) for one in estimates] == [(k * 10_000, (k + 1) * 10_000) for k in range(-3, 2)]
    assert all(one.twists.shape == (2, 6) and one.events == 150 for one in estimates)


def test_earlier_windows_change_the_answer_to_the_same_window(estimator):
    one, other = windows_of_events(1), windows_of_events(1, seed=50)
    same = [*windows_of_events(1, first=1), tick(2)]
    assert differ(feed(estimator, one + same).estimates[1], feed(estimator, other + same).estimates[1])


def test_two_streams_pushed_in_turn_are_answered_as_each_alone(estimator):
    streams = [windows_of_events(8, seed=seed) for seed in (0, 100)]
    alone = [feed(estimator, packets) for packets in streams]
    states = [estimator.initial_state(SENSOR) for _ in streams]
    estimates: list[list[WindowEstimate]] = [[], []]
    for packets in zip(*streams, strict=True):
        for i, events in enumerate(packets):
            answer = estimator.push(events, states[i], int(events.t[0]))
            states[i] = answer.state
            estimates[i] += answer.estimates
    for i in (0, 1):
        assert_same_estimates(estimates[i], alone[i].estimates)
        assert_same_state(states[i], alone[i].state)
    assert differ(alone[0].estimates[3], alone[1].estimates[3])


def test_streams_in_several_threads_share_an_estimator_and_are_answered_as_each_alone(estimator):
    streams = [windows_of_events(10, seed=100 * i) for i in range(4)]
    alone = [feed(estimator, packets).estimates for packets in streams]
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(lambda packets: feed(estimator, packets).estimates, streams))
    for one, other in zip(together, alone, strict=True):
        assert_same_estimates(one, other)


@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_streams_pushed_at_once_are_answered_as_each_alone(precision):
    """Streams of different ages, one with a gap and one without a window; in int8 equal bit for bit."""
    estimator = Estimator(make_bundle(network=CONFIG.network.model_copy(update={"precision": precision})))
    gap = [*windows_of_events(3), *windows_of_events(3, first=20)]
    packets = [windows_of_events(6, seed=50), gap, [make_events(9, seed=1)] * 6, [Events.join(gap), *[tick(30)] * 5]]
    alone = [feed(estimator, one) for one in packets]
    states = [estimator.initial_state(SENSOR) for _ in packets]
    together: list[list[PushResult]] = []
    for turn in zip(*packets, strict=True):
        pushes = [Push(events, state, int(events.t[0])) for events, state in zip(turn, states, strict=True)]
        answers = estimator.push_many(pushes)
        states = [answer.state for answer in answers]
        together.append(answers)
    for stream, want in enumerate(alone):
        got = [answers[stream] for answers in together]
        estimates = list(chain.from_iterable(one.estimates for one in got))
        assert [one[:2] for one in estimates] == [one[:2] for one in want.estimates]
        assert [sum(one[2:][k] for one in got) for k in range(3)] == list(want[2:])
        if precision == "int8":
            assert_same_estimates(estimates, want.estimates)
            assert_same_state(states[stream], want.state)
        for one, other in zip(estimates, want.estimates, strict=True):
            np.testing.assert_allclose(one.twists, other.twists, rtol=1e-3, atol=1e-4)
    assert estimator.push_many([]) == []


@pytest.mark.parametrize("as_one_packet", [True, False])
def test_after_a_skipped_gap_a_stream_answers_as_a_new_one(estimator, as_one_packet):
    before, after = windows_of_events(5), [*windows_of_events(3, first=9), tick(12)]
    packets = [Events.join(before + after)] if as_one_packet else before + after
    result, fresh = feed(estimator, packets), feed(estimator, after)
    assert result.skipped_windows == 4
    assert_same_estimates(result.estimates[5:], fresh.estimates)
    assert_same_state(result.state, fresh.state)
    assert [one.first for one in result.estimates] == [k in (0, 5) for k in range(8)]


def test_a_short_gap_is_answered_and_keeps_the_state(estimator):
    after = [*windows_of_events(1, first=8), tick(9)]
    result, fresh = feed(estimator, windows_of_events(5) + after), feed(estimator, after)
    assert [one.events for one in result.estimates] == [150] * 5 + [0] * 3 + [150]
    assert [one.first for one in result.estimates] == [True] + [False] * 8
    assert differ(result.estimates[-1], fresh.estimates[0])


def test_settled_is_true_after_settle_windows_and_first_only_in_the_first_window(estimator):
    estimates = feed(estimator, windows_of_events(SETTLE + 4)).estimates
    assert [one.settled for one in estimates] == [False] * SETTLE + [True] * 3
    assert [one.first for one in estimates] == [True] + [False] * (SETTLE + 2)


def test_low_activity_counts_only_events_inside_the_grid():
    estimator = Estimator(make_bundle(low_activity_events=LOW, low_activity_per_pixel=0))
    state = estimator.initial_state(SENSOR, LENS)
    seen, unseen = ((int(x), int(y)) for y, x in (np.argwhere(state.lut >= 0)[0], np.argwhere(state.lut < 0)[0]))

    def window(inside: int, outside: int) -> WindowEstimate:
        x, y = np.array([seen] * inside + [unseen] * outside).T
        events = Events.from_columns(np.arange(x.size), x, y, np.ones_like(x))
        (estimate,) = feed(estimator, [events, tick(1)], estimator.initial_state(SENSOR, LENS)).estimates
        return estimate

    assert [window(n, 10).low_activity for n in (LOW - 1, LOW)] == [True, False]
    assert window(LOW, 10).events == LOW + 10


def test_a_large_sensor_needs_more_events_because_its_noise_is_no_motion():
    estimator = Estimator(make_bundle(low_activity_events=LOW, low_activity_per_pixel=2.0))
    state = estimator.initial_state(SENSOR, LENS)
    rows, columns = np.nonzero(state.lut >= 0)

    def window(per_pixel: int) -> WindowEstimate:
        x, y = np.repeat(columns, per_pixel), np.repeat(rows, per_pixel)
        events = Events.from_columns(np.zeros_like(x), x, y, np.ones_like(x))
        (estimate,) = feed(estimator, [events, tick(1)], estimator.initial_state(SENSOR, LENS)).estimates
        return estimate

    assert [window(n).low_activity for n in (1, 2)] == [True, False]


@pytest.mark.parametrize(("n", "saturated"), [(254, False), (255, True), (600, True)])
def test_a_window_with_a_full_cell_is_flagged_saturated(estimator, n, saturated):
    burst = Events.from_columns(np.arange(n), [30] * n, [20] * n, [1] * n)
    (estimate,) = feed(estimator, [burst, tick(1)]).estimates
    assert estimate.saturated is saturated


def test_late_outside_and_skipped_are_reported(estimator):
    state = estimator.initial_state(SENSOR, LENS)
    blind = int((state.lut < 0).sum())
    assert blind > 0
    every_pixel = np.indices((SENSOR.height, SENSOR.width)).reshape(2, -1)
    n = every_pixel.shape[1]
    events = Events.from_columns(np.full(n, 5), every_pixel[1], every_pixel[0], np.ones(n))
    answer = feed(estimator, [events, tick(20), tick(3)], state)
    assert (answer.late_events, answer.outside_events, answer.skipped_windows) == (1, blind, 19)


def test_twists_are_the_networks_answers_times_scale_plus_offset():
    plain = make_bundle()
    scale, offset = torch.tensor([2.0, 3.0, 0.5, 1.0, -1.0, 10.0]), torch.tensor([0.0, 1.0, -2.0, 0.1, 0.2, 0.3])
    packets = windows_of_events(4)
    raw = feed(Estimator(plain), packets).estimates
    scaled = feed(Estimator(replace(plain, scale=scale, offset=offset)), packets).estimates
    for one, other in zip(scaled, raw, strict=True):
        np.testing.assert_allclose(one.twists, other.twists * scale.numpy() + offset.numpy(), rtol=1e-6)


def test_push_is_to_windows_and_then_follow(estimator):
    packets = windows_of_events(6)
    whole, state, estimates = feed(estimator, packets), estimator.initial_state(SENSOR), []
    for events in packets:
        pushed = estimator.to_windows(events, state, int(events.t[0]))
        answers, state = estimator.follow(pushed.windows, state._replace(windows=pushed.state))
        estimates += answers
    assert_same_estimates(estimates, whole.estimates)
    assert_same_state(state, whole.state)


def windows_of_packets(estimator, packets):
    """Every window that packets complete."""
    state, windows = estimator.initial_state(SENSOR), []
    for events in packets:
        pushed = estimator.to_windows(events, state, int(events.t[0]))
        state, windows = state._replace(windows=pushed.state), windows + pushed.windows
    return windows


def test_a_model_with_the_same_windows_can_follow_those_of_another(estimator):
    other = Estimator(make_bundle(seed=7, network=CONFIG.network.model_copy(update={"hidden": 5, "diffusion": False})))
    packets = windows_of_events(5)
    assert other.has_same_windows(estimator)
    own = feed(other, packets)
    estimates, state = other.follow(windows_of_packets(estimator, packets), other.initial_state(SENSOR))
    assert_same_estimates(estimates, own.estimates)
    assert_same_state(state, own.state)


def test_windows_after_a_gap_are_followed_from_the_zero_state(estimator):
    windows = windows_of_packets(estimator, windows_of_events(8))
    _, state = estimator.follow([*windows[:2], *windows[4:]], estimator.initial_state(SENSOR))
    _, fresh = estimator.follow(windows[4:], estimator.initial_state(SENSOR))
    assert state.age == len(windows[4:])
    assert_same_state(state, fresh)


@pytest.mark.parametrize(
    "change",
    [
        {"window": WindowConfig(duration_us=DURATION_US, bins=5, max_hole_windows=3)},
        {"window": WindowConfig(duration_us=20_000, bins=2, max_hole_windows=3)},
        {"canonical": CanonicalConfig(width=9, height=8)},
        {"canonical": CanonicalConfig(width=16, height=12, hfov_deg=40.0)},
    ],
    ids=["bins", "duration", "grid", "field_of_view"],
)
def test_models_with_other_windows_or_another_camera_are_distinguished(estimator, change):
    assert not Estimator(make_bundle(seed=3, **change)).has_same_windows(estimator)


def arrays_of(value) -> list[np.ndarray]:
    """All arrays of nested tuples, with the tensors among them as arrays."""
    if isinstance(value, torch.Tensor):
        return [value.numpy()]
    if isinstance(value, np.ndarray):
        return [value]
    return [one for part in value for one in arrays_of(part)] if isinstance(value, tuple) else []


@pytest.mark.parametrize(
    ("sensor", "grid", "most_mib"),
    [
        (Sensor(346, 260), CanonicalConfig(), 8),
        (Sensor(346, 260), CanonicalConfig(width=173, height=130), 8),
        (Sensor(1280, 720), CanonicalConfig(), 40),
        (Sensor(1280, 720), CanonicalConfig(width=320, height=180), 40),
    ],
    ids=str,
)
def test_the_state_of_a_long_stream_is_bounded(sensor, grid, most_mib):
    estimator = Estimator(bundle.untrained(0, ModelConfig(canonical=grid)))
    state, sizes = estimator.initial_state(sensor), []
    for k in range(20):  # more than the 16 windows that another model needs to settle
        events = make_events(50, seed=k, sensor=sensor, start_us=k * 50_000, duration_us=50_000)
        state = estimator.push(events, state, k * 50_000).state
        whole = {id(array.base if array.base is not None else array): array for array in arrays_of(state)}
        sizes.append(sum((array.base if array.base is not None else array).nbytes for array in whole.values()))
    assert sizes[-1] == sizes[-2]
    assert sizes[-1] < most_mib << 20


def test_warm_up_does_not_change_the_answers():
    cold, warm = Estimator(make_bundle()), Estimator(make_bundle())
    warm.warm_up()
    packets = windows_of_events(4)
    assert_same_estimates(feed(warm, packets).estimates, feed(cold, packets).estimates)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("part", ["scale", "offset"])
def test_warm_up_rejects_a_model_whose_answers_are_not_finite(part, value):
    broken, six = make_bundle(), torch.full((6,), value)
    broken = replace(broken, scale=six) if part == "scale" else replace(broken, offset=six)
    with pytest.raises(BadModel, match=r"untrained.*not finite"):
        Estimator(broken).warm_up()


def test_warm_up_rejects_a_model_whose_neurons_are_nan_even_if_its_answers_are_finite():
    broken = make_bundle()
    next(norm for name, norm in broken.network.named_modules() if name == "blocks.0.norm").running_var.fill_(-1)
    assert all(np.isfinite(one.twists).all() for one in feed(Estimator(broken), windows_of_events(4)).estimates)
    with pytest.raises(BadModel, match="not finite"):
        Estimator(broken).warm_up()


def test_camera_info_of_another_sensor_is_rejected(estimator):
    with pytest.raises(InvalidField, match="64x48"):
        estimator.initial_state(Sensor(64, 47), LENS)


def test_the_example_of_the_readme_runs_as_written():
    result = doctest.testfile(str(README), module_relative=False, optionflags=doctest.ELLIPSIS)
    assert result.attempted >= 9
    assert result.failed == 0


def resolved(parts):
    """What a dotted name below neurove_core means: modules first, then attributes or fields; None if nothing."""
    found, depth = neurove_core, 0
    for depth in range(len(parts), 0, -1):
        with contextlib.suppress(ModuleNotFoundError):
            found = importlib.import_module(".".join(["neurove_core", *parts[:depth]]))
            break
    for attribute in parts[depth:]:
        found = getattr(found, attribute, None) or getattr(found, "model_fields", {}).get(attribute)
    return found


def test_the_paper_map_of_the_readme_names_only_what_exists():
    rows = [line for line in README.read_text().splitlines() if line.startswith("|")]
    names = {name for row in rows for name in re.findall(r"`([a-z]+\.[\w.]+)`", row)}
    assert len(names) > 15
    for name in names:
        assert resolved(name.split(".")) is not None, name
