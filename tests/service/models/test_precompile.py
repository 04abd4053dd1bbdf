import threading

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.warming import compile_part, lacks_code
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


def test_a_node_with_little_memory_or_another_network_starts_no_children(monkeypatch, capsys):
    monkeypatch.setattr("sys.executable", "/no/such/program")  # a child would be a warning in the log
    monkeypatch.setattr(precompile, "lacks_code", lambda _: True)
    precompile.at_start(SMALL, lambda: precompile.CHILD_BYTES - 1)
    precompile.at_start(SMALL.model_copy(update={"kind": "ann"}), lambda: None)
    assert "by the node itself" not in capsys.readouterr().out


def test_children_of_a_first_start_that_cannot_start_leave_the_work_to_the_node(monkeypatch, capsys):
    monkeypatch.setattr("sys.executable", "/no/such/program")
    monkeypatch.setattr(precompile, "lacks_code", lambda _: True)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    precompile.at_start(SMALL, lambda: None)
    assert capsys.readouterr().out.count("code is compiled by the node itself") == 3


def test_a_process_that_has_run_compiled_code_lacks_none():
    compile_part("events", SMALL)
    assert not lacks_code(SMALL)
