from neurove_protocol import Flag, TwistEstimate
from neurove_service.clients.transit import Transit
from tests.protocol.messages import EXAMPLES

MS = 1_000_000
EXAMPLE = TwistEstimate.model_validate(EXAMPLES["TwistEstimate"] | {"flags": (), "node": "n1"})
WINDOW_NS = (EXAMPLE.end_us - EXAMPLE.start_us) * 1000


def arrivals(transit, times, **changes):
    """The estimates that were published and received at these times [ns]."""
    trace = EXAMPLE.trace
    return [
        transit.arrived(
            EXAMPLE.model_copy(update={"trace": trace.model_copy(update={"published_ns": sent_ns})} | changes), at_ns
        )
        for sent_ns, at_ns in times
    ]


def late(estimates):
    return [Flag.LATE in one.flags for one in estimates]


def added_ms(estimates):
    return [(one.host.age_ns - EXAMPLE.host.age_ns) / MS for one in estimates]


def test_estimates_that_wait_behind_each_other_are_late_and_their_age_counts_until_they_arrive():
    ahead_ns = 7_000 * MS  # the clock of the node
    way_ns = [3 * MS, 3 * MS, 3 * MS + 2 * WINDOW_NS, 4 * MS + 2 * WINDOW_NS, 5_000 * MS, 3 * MS]
    times = [(ahead_ns + t * WINDOW_NS, t * WINDOW_NS + way) for t, way in enumerate(way_ns)]
    found = arrivals(Transit(), times)
    assert late(found) == [False, False, False, True, True, False]
    assert added_ms(found)[:2] == [0, 0]
    assert abs(added_ms(found)[4] - 4_997) < 2  # the offset may drift
    assert found[4].host.end_ns == EXAMPLE.host.end_ns


def test_the_clock_of_each_node_is_learned_and_a_node_may_start_again():
    transit = Transit()
    assert late(arrivals(transit, [(0, 10**9), (MS, 10**9 + MS)])) == [False, False]
    assert late(arrivals(transit, [(0, 10**12)], node="n2")) == [False]
    assert late(arrivals(transit, [(10**11, 2 * 10**11)])) == [True]  # 99 s
    assert late(arrivals(transit, [(MS, 4 * 10**11), (2 * MS, 4 * 10**11 + MS)])) == [False, False]


def test_an_estimate_without_host_time_or_with_the_flag_keeps_it():
    transit = Transit()
    found = arrivals(transit, [(0, 0), (MS, 900 * MS)], host=None, flags=(Flag.LATE, "gap"))
    assert [(one.host, one.flags) for one in found] == [(None, (Flag.LATE, "gap"))] * 2
