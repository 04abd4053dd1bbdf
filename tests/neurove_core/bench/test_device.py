"""The benchmark of a GPU, with the CPU in its place."""

import torch

from neurove_core.bench import device


def test_the_rows_of_a_device_compare_its_answers_with_the_engine():
    rows = device.on_device(torch.device("cpu"), 1, quick=True)
    assert [row.name for row in rows] == ["4 streams in one batch on cpu", "training step tiny, T=3, batch 4 on cpu"]
    assert [row.peer for row in rows] == ["engine, one core", "one core"]
    assert all(row.equal for row in rows)
    assert all(row.ours_ms > 0 for row in rows)


def test_without_a_gpu_the_reason_is_given():
    missing: list[str] = []
    rows = device.gpu(1, missing, quick=True)
    if torch.cuda.is_available():
        assert all(row.equal for row in rows)
    else:
        assert rows == []
        assert missing[0].startswith("gpu (")
