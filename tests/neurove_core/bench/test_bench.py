"""The benchmarks compare equal results; no test depends on a time."""

import pytest

from neurove_core.bench import (
    Row,
    chart,
    ingest,
    interleaved,
    machine,
    peers,
    processes,
    refinement,
    rows,
    simulate,
    sine,
    window,
)
from neurove_core.config import ModelConfig

QUICK = {"quick": True, "with_peers": True}
PEERS = {"spikingjelly": "spikingjelly", "snntorch": "snnTorch", "norse": "norse", "sinabs": "sinabs"}
INSTALLED = {name for module, name in PEERS.items() if peers.load(module, []) is not None}


def test_the_fused_recurrence_and_plain_steps_have_equal_results():
    found = sine.compare(rounds=1)
    assert [row.name for row in found] == ["sine forward", "sine forward and backward"]
    assert all(row.equal and row.ratio == row.peer_ms / row.ours_ms for row in found)


def test_our_pixels_and_the_algorithm_of_v2e_give_the_same_events():
    (row,) = simulate.compare(rounds=1, frames=10)
    assert row.equal


def test_the_kernels_of_the_refinement_and_their_plain_form_have_equal_results():
    alignment, whole = refinement.refinement(1, quick=True)
    assert alignment.equal
    assert whole.name == "refinement of a window of 5,000 events"


def test_every_round_runs_all_functions_once():
    calls = []
    times = interleaved({name: lambda name=name: calls.append(name) for name in "ab"}, rounds=2, warm_up=1)
    assert [set(calls[i : i + 2]) for i in (0, 2, 4)] == [{"a", "b"}] * 3
    assert set(times) == {"a", "b"}


@pytest.mark.parametrize("compare", [window.window, window.train, ingest.end_to_end])
def test_timed_functions_have_equal_results_and_missing_peers_are_named(compare):
    missing: list[str] = []
    found = compare(1, missing, **QUICK)
    assert any("PyTorch, plain" in row.peer for row in found)
    assert all(row.equal is not False for row in found)
    comparable = [row for row in found if "int8" not in row.name or row.peer == "PyTorch, plain"]
    assert all(
        row.equal
        for row in comparable
        if not any(name in row.peer for name in (*peers.DIFFERENT_BY_DESIGN, window.AT_PEAK))
    )
    for module, name in PEERS.items():
        assert (name in INSTALLED) == any(name in row.peer for row in found)
        assert (name in INSTALLED) != any(line.startswith(module) for line in missing)


@pytest.mark.parametrize("compare", [ingest.ingest, ingest.decode])
def test_counts_and_decoded_events_equal_those_of_the_reference(compare):
    found = compare(1, [], quick=True, with_peers=False)
    assert found
    assert all(row.equal for row in found)


def test_streams_in_turn_and_in_a_batch_have_equal_results():
    found = window.streams(1, quick=True)
    assert [row.peer for row in found] == ["one stream", *["streams in turn"] * 3]
    assert all(row.equal for row in found)


def test_two_processes_have_the_results_of_one():
    found = processes.processes(1, quick=True)
    assert [row.peer for row in found] == ["1 process"] * 2
    assert all(row.equal for row in found)


def test_rows_have_the_fastest_peer_first_and_the_share_of_the_limit():
    found = rows("a", {"ours": 2.0, "slow": 8.0, "fast": 4.0, "limit": 1.0}, {"slow": True, "fast": None}, limit_ms=1.0)
    assert found == [Row("a", 2.0, "fast", 4.0, 2.0, 0.5, None), Row("a", 2.0, "slow", 8.0, 4.0, 0.5, True)]


def test_the_operations_of_a_window_are_those_of_its_layers():
    config = ModelConfig()  # 86x65, n = 5, channels 16 32 64 64, 128 features, two cells of 128
    convolutions = 9 * (10 * 16 * 33 * 43 + 16 * 32 * 17 * 22 + 32 * 64 * 9 * 11 + 64 * 64 * 5 * 6)
    dense = 64 * 5 * 6 * 128 + 2 * 9 * 128 * 128 + 128 * 30
    assert machine.flops(config) == 2 * (convolutions + dense)


def test_a_result_is_stamped_with_commit_threads_and_versions():
    stamp = machine.stamp("abc123")
    assert all(part in stamp for part in ("commit abc123", "1 thread", "torch", "numba"))


def test_a_chart_is_written_as_png_and_svg(tmp_path):
    found = rows("a", {"ours": 2.0, "slow": 8.0, "fast": 4.0}, {"slow": True, "fast": None})
    png, svg = chart.save(found, "stamp", tmp_path / "speed.png")
    assert [png.name, svg.name] == ["speed.png", "speed.svg"]
    text = svg.read_text()
    assert png.stat().st_size > 1000
    assert "<svg" in text
