import threading

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_service.models import precompile

SMALL = ModelConfig(canonical=CanonicalConfig(width=24, height=16), network=NetworkConfig(channels=(4,), hidden=4))


def test_only_a_network_of_a_new_shape_needs_a_child():
    shapes = precompile.Shapes()
    assert shapes.need_child(SMALL, None)
    shapes.add(SMALL)
    same = SMALL.model_copy(update={"window": WindowConfig(duration_us=20_000), "settle_windows": 3})
    wider = SMALL.model_copy(update={"canonical": CanonicalConfig(width=30, height=16)})
    other = SMALL.model_copy(update={"network": SMALL.network.model_copy(update={"decay": 0.7, "surrogate": "arctan"})})
    assert not any(shapes.need_child(one, None) for one in (SMALL, same, wider, other))
    for changed in (
        {"network": NetworkConfig(channels=(4,), hidden=4, precision="int8")},
        {"window": WindowConfig(bins=2)},
        {"canonical": CanonicalConfig(width=300, height=200)},
    ):
        assert shapes.need_child(SMALL.model_copy(update=changed), None)


def test_a_child_is_not_started_with_little_memory_or_for_a_network_without_compiled_code():
    shapes = precompile.Shapes()
    assert not shapes.need_child(SMALL, precompile.CHILD_BYTES)
    assert not shapes.need_child(SMALL.model_copy(update={"kind": "ann"}), None)


def test_a_child_that_cannot_start_or_that_is_stopped_leaves_the_work_to_the_node(monkeypatch, capsys):
    stop = threading.Event()
    stop.set()
    assert not precompile.in_child(SMALL, stop)
    monkeypatch.setattr("sys.executable", "/no/such/program")
    assert not precompile.in_child(SMALL, threading.Event())
    assert "code is compiled by the node itself" in capsys.readouterr().out
