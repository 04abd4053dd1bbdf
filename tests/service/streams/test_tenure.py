"""Terms: which node answers a stream."""

from neurove_protocol.duty import Newest
from neurove_service.streams.tenure import Tenure


class NoPeers:
    """A node that knows no other node yet."""

    def names(self, _stream):
        return ()

    def heard_ns(self, _node):
        return 0

    def roles(self, _stream, _timeout_s):
        return []

    def state(self, _stream, _node, _digest, _after_us):
        return None


def test_of_two_nodes_that_take_over_in_one_millisecond_a_consumer_hears_one():
    nodes = [Tenure(name, "cam0", NoPeers()) for name in ("a", "b")]
    for node in nodes:
        node.take_over("a test", unix_ms=lambda: 1_764_000_000_000)
    consumer = Newest()
    starts = (0, 20_000, 40_000)
    taken = [start for node in nodes for start in starts if consumer.takes(node.term, start, 0)]
    assert taken == list(starts)


def test_a_term_rises_though_the_clock_goes_back():
    node = Tenure("a", "cam0", NoPeers())
    node.take_over("a test", unix_ms=lambda: 1_764_000_000_000)
    before = node.term
    node.take_over("a test", unix_ms=lambda: 1_763_000_000_000)
    assert node.term == before + 1


def test_a_node_that_took_over_in_haste_waits_longer_from_then_on_and_not_for_ever():
    node, window_ns = Tenure("a", "cam0", NoPeers()), 20_000_000
    usual_ns = node.patience_ns(window_ns, equal=True)
    node.hear("b", 7, 0)
    node.take_over("b is late", 10 * window_ns)
    for late in (1, 2):
        assert not node.hear("b", 7, (10 + late) * window_ns)
    assert node.patience_ns(window_ns, equal=True) == 2 * usual_ns
    node.hear("b", node.term + 1, 61_000_000_000)
    assert node.patience_ns(window_ns, equal=True) == usual_ns


def test_a_node_that_is_heard_long_after_it_was_replaced_does_not_make_the_other_one_slow():
    node, window_ns = Tenure("a", "cam0", NoPeers()), 20_000_000
    usual_ns = node.patience_ns(window_ns, equal=True)
    node.hear("b", 7, 0)
    node.take_over("b is late", 10 * window_ns)
    assert not node.hear("b", 7, 80 * window_ns)
    assert node.patience_ns(window_ns, equal=True) == usual_ns
