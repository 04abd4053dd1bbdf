"""The channels of the network's input: parts of a cell, and the history of earlier windows."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from neurove_core import self_test
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.engine.encoding import to_codes, to_count_input
from neurove_core.engine.engine import Engine
from neurove_core.engine.fallback import vectors_work
from neurove_core.estimator import Estimator, Push
from neurove_core.geometry.camera import OUTSIDE, lookup_table
from neurove_core.ingest import windows
from neurove_core.ingest.channels import (
    add_saturating,
    add_saturating_reference,
    network_input,
    remembered,
    to_cells,
    to_parts,
    with_history,
)
from neurove_core.ingest.windows import Window, WindowsState
from neurove_core.ingest.wire import read_packet
from neurove_core.models import bundle
from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.neurove import NeuroVE
from neurove_core.sim.render.camera import named_camera
from neurove_core.spiking.plain import plain
from neurove_protocol import Events, Sensor
from neurove_protocol.events import EventPacket, encode_packet
from tests.builders import make_events

WINDOW = WindowConfig(duration_us=10_000, bins=2)
CELLS = CanonicalConfig(width=12, height=8)
PARTS = CELLS.model_copy(update={"subcells": 2})
SENSOR = Sensor(24, 16)


def model(history: tuple[int, ...] = (), grid: CanonicalConfig = PARTS, precision: str = "float32") -> ModelConfig:
    network = NetworkConfig.model_validate(
        {"channels": (16, 16), "features": 16, "hidden": 8, "history": history, "precision": precision}
    )
    return ModelConfig(window=WINDOW, canonical=grid, network=network)


def counted(events: Events, grid: CanonicalConfig, sensor: Sensor = SENSOR) -> list[Window]:
    lut = lookup_table(grid, sensor, None)
    return windows.push(events, 100_000, WindowsState(0), lut, WINDOW, grid).windows


def busy(n: int = 20_000, seed: int = 0) -> Events:
    return make_events(n=n, seed=seed, duration_us=99_000, sensor=SENSOR)


def drawn(count: int, config: ModelConfig, seed: int = 0, mean: float = 0.4) -> np.ndarray:
    return np.random.default_rng(seed).poisson(mean, (count, *config.window_shape)).astype(np.uint8)


@pytest.mark.parametrize("camera", ["davis240c", "davis346-half", "pinhole:100x80:60"])
def test_the_parts_of_a_cell_are_the_cells_of_a_grid_twice_as_fine(camera):
    info, grid = named_camera(camera).info, CanonicalConfig(subcells=2)
    coarse, fine, parts = (lookup_table(one, info.sensor, info) for one in (CanonicalConfig(), grid.fine, grid))
    seen = fine != OUTSIDE
    assert np.array_equal(seen, parts != OUTSIDE)
    assert np.array_equal(seen, coarse != OUTSIDE)
    row, column = np.divmod(fine[seen], grid.fine.width)
    assert np.array_equal(coarse[seen], row // 2 * grid.width + column // 2)
    part = row % 2 * 2 + column % 2
    assert np.array_equal(parts[seen], part * grid.width * grid.height + coarse[seen])


@pytest.mark.parametrize("wire", [False, True], ids=["columns", "wire"])
def test_counted_parts_are_those_of_the_fine_grid_and_sum_to_the_cells(wire):
    events = busy()
    given = read_packet(encode_packet(EventPacket("cam0", 0, SENSOR, 0, events))).events if wire else events
    found, fine, cells = (counted(given, grid) for grid in (PARTS, PARTS.fine, CELLS))
    assert len(found) == len(cells) == 10
    for part, small, cell in zip(found, fine, cells, strict=True):
        assert part.counts.shape == (16, 8, 12)
        assert np.array_equal(part.counts, to_parts(small.counts, 2))
        assert np.array_equal(part.counts.reshape(4, 4, 8, 12).sum(1), cell.counts)
        assert np.array_equal(to_cells(small.counts, 2), cell.counts)


def test_an_event_is_counted_in_the_channel_of_its_bin_polarity_and_quarter():
    x, y = 9, 4  # column 4, right half; row 2, upper half
    events = Events.from_columns(np.array([6_000]), np.array([x]), np.array([y]), np.array([1]))
    window = counted(events, PARTS)[0]
    (channel,), (row,), (column,) = np.nonzero(window.counts)
    assert (channel, row, column) == ((2 * 1 + 1) * 4 + 1, 2, 4)


def test_a_history_has_the_counts_of_earlier_windows_without_overlap():
    config = model((1, 2), CELLS)
    given = drawn(5, config)
    found = network_input(given, config)
    per_window = given.reshape(5, 2, 2, 8, 12).sum(1)
    assert found.shape == (5, *config.input_shape) == (5, 4 + 4, 8, 12)
    assert np.array_equal(found[:, :4], given)
    assert np.array_equal(found[4, 4:6], per_window[3])
    assert np.array_equal(found[4, 6:8], per_window[2] + per_window[1])
    assert not found[0, 4:].any()
    assert np.array_equal(found[1, 4:6], per_window[0])
    assert not found[1, 6:].any()


def test_a_history_saturates():
    config = model((1, 2), CELLS)
    found = network_input(np.full((4, *config.window_shape), 100, np.uint8), config)
    assert (found[3, 4:6] == 200).all()
    assert (found[3, 6:] == 255).all()


def test_window_by_window_gives_the_history_of_the_whole_sequence():
    config, recent = model((2, 3)), ()
    given = drawn(9, config)
    whole = network_input(np.stack([fine_of(one, config) for one in given]), config)
    for window, expected in zip(given, whole, strict=True):
        assert np.array_equal(with_history(window, recent, config), expected)
        recent = remembered(window, recent, config)


def fine_of(counts: np.ndarray, config: ModelConfig) -> np.ndarray:
    """The fine grid (2n, 2H, 2W) of a window in parts: the inverse of to_parts."""
    _, rows, columns = config.window_shape
    n = config.canonical.subcells
    parts = counts.reshape(-1, n, n, rows, columns).transpose(0, 3, 1, 4, 2)
    return np.ascontiguousarray(parts.reshape(-1, n * rows, n * columns))


def test_the_compiled_sum_equals_its_reference():
    rng = np.random.default_rng(1)
    into, values = (rng.integers(0, 256, 5_001).astype(np.uint8) for _ in range(2))
    expected = into.copy()
    add_saturating(into, values)
    add_saturating_reference(expected, values)
    assert np.array_equal(into, expected)
    assert (into == 255).any()


@pytest.mark.parametrize("precision", ["float32", "int8"])
@pytest.mark.parametrize("config", [model(), model((1, 2, 4)), model((3,), CELLS)], ids=["parts", "both", "history"])
def test_the_engine_spikes_as_its_reference_bit_for_bit(config, precision):
    net = config.network.model_copy(update={"precision": precision})
    network = bundle.untrained(3, config.model_copy(update={"network": net})).network
    assert isinstance(network, NeuroVE)
    engine, state = Engine(network), network.initial_state(1)
    stored = np.stack([fine_of(one, config) for one in drawn(10, config, mean=0.1)])
    counts = torch.from_numpy(network_input(stored, config))[:, None]
    given = to_codes(counts, "log1p") if precision == "int8" else to_count_input(counts, "log1p")
    assert engine.reads_counts == (vectors_work() and precision == "float32")
    fired, membranes = engine.features(given, state)
    with plain():
        expected, after = engine.features(to_spikes(counts, "log1p"), state)
    assert torch.equal(fired, expected)
    assert fired.sum() > 20
    for one, other in zip(membranes, after, strict=True):
        assert torch.equal(one.v, other.v)


def test_a_stream_in_packets_equals_the_windows_of_training():
    config = model((1, 2, 4))
    made = bundle.untrained(3, config)
    estimator, events = Estimator(made), busy()
    state, found = estimator.initial_state(SENSOR), []
    for first in range(0, events.n, 333):
        piece = events.span(first, min(first + 333, events.n))
        answer = estimator.push(piece, state, piece.first_us)
        state, found = answer.state, found + answer.estimates
    stored = np.stack([window.counts for window in counted(events, PARTS.fine)])
    spikes = torch.from_numpy(network_input(stored, config)).float().log1p()[:, None]
    with torch.inference_mode():
        expected, _ = made.network(spikes, made.network.initial_state(1))
    twists = np.stack([one.twists for one in found])
    np.testing.assert_allclose(twists, expected[: len(twists), 0].numpy(), rtol=1e-3, atol=1e-4)


def test_a_gap_empties_the_history_and_priming_fills_it_again():
    config = model((1, 2, 4))
    estimator = Estimator(bundle.untrained(3, config))
    counts = drawn(20, config)
    stream = [Window(10_000 * i, one, 1000, 0) for i, one in enumerate(counts)]
    _, steady = estimator.follow(stream, estimator.initial_state(SENSOR))
    _, primed = estimator.follow(stream[-12:], estimator.initial_state(SENSOR))
    assert len(steady.recent) == 7
    assert all(np.array_equal(a, b) for a, b in zip(steady.recent, primed.recent, strict=True))
    _, after = estimator.follow([Window(1_000_000, counts[0], 1000, 0)], steady)
    assert len(after.recent) == 1


def test_streams_in_one_batch_keep_their_own_history():
    config = model((1, 2))
    estimator = Estimator(bundle.untrained(3, config))
    pushes = [Push(busy(seed=seed), estimator.initial_state(SENSOR), 0) for seed in (1, 2)]
    alone = [estimator.push(*push._replace(state=estimator.initial_state(SENSOR))) for push in pushes]
    for one, other in zip(alone, estimator.push_many(pushes), strict=True):
        assert len(one.estimates) == 9
        for mine, theirs in zip(one.estimates, other.estimates, strict=True):
            assert np.array_equal(mine.twists, theirs.twists)


@pytest.mark.parametrize("config", [model(), model((1, 2, 4)), model((2,), CELLS)], ids=["parts", "both", "history"])
def test_a_bundle_keeps_its_channels_and_its_golden_test(config):
    made = bundle.untrained(3, config)
    estimator = Estimator(made)
    golden = self_test.record(estimator, drawn(6, config))
    stored = bundle.from_bytes(replace(made, golden=golden).to_bytes(), "x")
    assert stored.config == config
    assert stored.golden is not None
    assert np.array_equal(stored.golden.counts, golden.counts)
    self_test.check(Estimator(stored))
    assert golden.twists.std() > 0


def test_a_model_without_the_new_settings_is_stored_as_before():
    text = ModelConfig().model_dump_json()
    assert "subcells" not in text
    assert "history" not in text
    assert hashlib.sha256(text.encode()).hexdigest()[:12] == "c0b751a84809"
    assert ModelConfig.model_validate_json(model((1,)).model_dump_json()) == model((1,))
