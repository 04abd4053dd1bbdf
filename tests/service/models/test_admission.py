import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle
from neurove_core.networks.neurove import NeuroVE
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


def of_shape(width, height, channels, duration_us=50_000):
    """A model without weights in memory."""
    config = ModelConfig(
        window=WindowConfig(duration_us=duration_us),
        canonical=CanonicalConfig(width=width, height=height),
        network=NetworkConfig(channels=channels, features=1, hidden=1),
    )
    with torch.device("meta"):
        network = NeuroVE(config)
    return Bundle("huge", True, "a test", config, network, torch.zeros(6), torch.ones(6))


def test_the_cost_of_a_window_follows_from_the_shapes():
    neurons = 10 * 64 * 32 + 3 * 32 * 16 + 2 * 16 * 8
    assert admission.cost(of_shape(64, 32, (3, 2))) == (
        0.25 * 10 * 9 * 3 * 32 * 16 + 4 * neurons,
        4 * 6 * neurons,
    )


@pytest.mark.parametrize("kind", ["neurove", "ann", "snn-ang"])
def test_a_model_of_usual_size_passes_by_its_configuration(kind):
    config = ModelConfig(kind=kind)
    admission.check_cost(bundle.untrained(config=config), free=1 << 30)


def test_a_huge_network_is_refused_by_its_configuration_before_anything_runs():
    with pytest.raises(TooSlow, match="a window may take at most 50.0 ms here"):
        admission.check_cost(of_shape(1024, 1024, (256, 256)), free=None)
    with pytest.raises(NoMemory, match="free_bytes=134217728: a model change needs"):
        admission.check_cost(of_shape(1024, 1024, (16, 16)), free=128 << 20)


def test_a_model_far_above_the_bound_is_refused_after_two_windows(slot):
    estimator = slot.active.estimator
    admission.check_first_windows(estimator, share=1e6)
    with pytest.raises(TooSlow, match="p99_ms="):
        admission.check_first_windows(estimator, share=1e-9)


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
