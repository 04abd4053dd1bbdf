"""The learning curve: TensorBoard, the figure, and the warning about a missing library."""

import sys
import threading
import time

import pytest

from neurove_core.training.curve import Scalars, draw_curve

CURVE = [
    {"step": step, "linear_error_m_s": 100 / step, "angular_error_rad_s": 10 / step, "learning_rate": 1e-3, "cpu_s": 1}
    for step in range(100, 1500, 100)
]


def scalars(folder, name):
    event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    read = event_accumulator.EventAccumulator(str(folder / "tensorboard"))
    read.Reload()
    return [(one.step, pytest.approx(one.value)) for one in read.Scalars(name)]


def await_the_next_second():
    """A resumed run starts in a later second; TensorBoard sorts files of one second by number as text, 10 before 9."""
    began = int(time.time())
    while int(time.time()) == began:
        threading.Event().wait(0.01)


def test_tensorboard_shows_the_curve_and_no_point_of_a_resumed_run_twice(tmp_path):
    with Scalars(tmp_path) as written:
        for point in CURVE[:8]:
            written.add(point)
    await_the_next_second()
    with Scalars(tmp_path, after_step=500) as written:
        for point in CURVE[5:]:
            written.add(point)
    assert scalars(tmp_path, "linear_error_m_s") == [(point["step"], point["linear_error_m_s"]) for point in CURVE]


def test_without_tensorboard_one_warning_is_logged_and_training_continues(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with Scalars(tmp_path) as written:
        for point in CURVE:
            written.add(point)
    (record,) = caplog.records
    assert "pip install 'neurove[train]'" in record.getMessage()
    assert not list(tmp_path.iterdir())


def test_the_figure_of_a_curve_is_reproducible(tmp_path):
    first = [file.read_bytes() for file in draw_curve(CURVE, tmp_path, "model: 1400 updates")]
    assert [file.name for file in sorted(tmp_path.iterdir())] == ["curve.png", "curve.svg"]
    assert first == [file.read_bytes() for file in draw_curve(CURVE, tmp_path, "model: 1400 updates")]


def test_without_matplotlib_a_warning_is_logged(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    assert draw_curve(CURVE, tmp_path, "model") == []
    assert "neurove[experiments]" in caplog.text
