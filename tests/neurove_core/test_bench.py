"""The benchmarks compare like with like; how fast is not a test's business."""

from neurove_core.bench import interleaved, sine


def test_the_fused_recurrence_and_plain_steps_give_the_same_answers():
    rows = sine.compare(rounds=1)
    assert [row.name for row in rows] == ["sine forward", "sine forward and backward"]
    assert all(row.equal and row.ratio == row.peer_ms / row.ours_ms for row in rows)


def test_every_round_runs_all_in_turn():
    calls = []
    times = interleaved({name: lambda name=name: calls.append(name) for name in "ab"}, rounds=2, warm_up=1)
    assert calls == ["a", "b"] * 3
    assert set(times) == {"a", "b"}
