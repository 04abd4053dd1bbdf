import pytest

from neurove_protocol.errors import NoMemory, TooSlow
from neurove_service.models import admission

MEMINFO = "MemTotal:       16000000 kB\nMemFree:         1000000 kB\nMemAvailable:    4000000 kB\n"


@pytest.fixture
def machine(tmp_path):
    (tmp_path / "meminfo").write_text(MEMINFO)
    return tmp_path


def free(machine):
    return admission.free_bytes(machine / "meminfo", machine)


def test_free_memory_is_the_smaller_of_machine_and_control_group(machine):
    assert free(machine) == 4_000_000 << 10
    (machine / "memory.current").write_text("300\n")
    for bound, expected in (("max\n", 4_000_000 << 10), ("1000\n", 700), ("200\n", 0)):
        (machine / "memory.max").write_text(bound)
        assert free(machine) == expected


def test_a_system_that_does_not_report_its_memory_refuses_nothing(tmp_path):
    assert free(tmp_path) is None
    admission.check_memory("one", 1 << 60, None)


def test_a_model_needs_twice_its_size():
    admission.check_memory("one", 500, 1000)
    with pytest.raises(NoMemory, match="model one: free_bytes=1000: a model change needs 1002 bytes"):
        admission.check_memory("one", 501, 1000)


def test_this_machine_reports_its_memory():
    assert admission.free_bytes() > 0


def test_the_time_for_a_window_is_measured(slot):
    estimator = slot.active.estimator
    times_ms = admission.window_times_ms(estimator, 10)
    assert len(times_ms) == 10
    assert all(one >= 0 for one in times_ms)
    assert admission.check_speed(estimator, share=1e6) >= 0
    assert admission.weight_bytes(estimator.bundle) >= 4 * estimator.bundle.info.parameters


def test_the_measurement_of_a_model_that_is_too_slow_ends_early(slot):
    estimator = slot.active.estimator
    assert len(admission.window_times_ms(estimator, 50, bound_ms=-1.0, max_slow=4)) == 5
    with pytest.raises(TooSlow, match="p99_ms="):
        admission.check_speed(estimator, share=1e-9)
