"""Two nodes of one stream in one process: who answers, and who is ready to answer, after pauses and lost packets."""

import sys

import pytest

from neurove_protocol import Trace, Twist, TwistEstimate
from neurove_protocol.velocity import HostTime
from neurove_service.streams.pair import Pair
from neurove_service.streams.stream import Stream
from neurove_service.streams.tenure import Tenure, ranked

STREAM, WINDOW_US = "cam0", 20_000
NOT_EQUAL = 9.0


def estimate(node, number, value, flags, age_us, now_ns=0, waited_us=0):
    """The window with this number; `value` stands for the state of the node."""
    start_us = number * WINDOW_US
    end_us, received_ns = start_us + WINDOW_US, now_ns - 1000 * waited_us
    return TwistEstimate(
        stream=STREAM,
        seq=number,
        start_us=start_us,
        end_us=end_us,
        bin_end_us=(end_us,),
        twists=(Twist(value, 0.0, 0.0, 0.0, 0.0, 0.0),),
        model="m",
        digest="0" * 64,
        epoch=0,
        events=5,
        flags=flags,
        trace=Trace(received_ns=received_ns, queued_ns=now_ns, computed_ns=now_ns, published_ns=now_ns),
        node=node,
        host=HostTime(end_ns=0, uncertainty_ns=0, age_ns=1000 * age_us),
    )


class Other:
    """The other node, as a node sees it."""

    def __init__(self, nodes, name):
        self._nodes, self._name = nodes, name

    def names(self, _stream):
        return (self._name,)

    def heard_ns(self, _node):
        return 0

    def roles(self, _stream, timeout_s):
        nodes = self._nodes
        nodes.asked += 1
        if nodes.hangs != self._name:
            return [nodes.pairs[self._name].reply()]
        nodes.now_ns += int(1e9 * timeout_s)
        return []

    def state(self, _stream, _node, _digest, _after_us):
        return None

    def take(self, _stream, node, term, last_us, _timeout_s):
        self._nodes.pairs[node].take("another", term, last_us)
        return True


class Nodes:
    """Two nodes on one clock that hear each other at once; a node that hangs says and hears nothing."""

    def __init__(self, stream, suspended_ns=sys.maxsize):
        self.now_ns, self.hangs, self.asked = 10**12, "", 0
        self.stream, self.published = stream, []
        self.pairs = {}
        for name, other in ("ab", "ba"):
            peers = Other(self, other)
            self.pairs[name] = Pair(
                Tenure(name, STREAM, peers),
                peers,
                lambda: None,
                lambda: self.now_ns,
                suspended_ns=lambda _: suspended_ns,
            )

    @property
    def leader(self):
        (leader,) = [name for name in self.pairs if self.role(name) == "answers"]
        return leader

    @property
    def follower(self):
        return "ab".replace(self.leader, "")

    def role(self, name):
        return self.pairs[name].reply().role

    def ready(self, name):
        reply = self.pairs[name].reply()
        return reply.role == "follows" and reply.equal

    def wait(self, windows):
        self.now_ns += int(windows * WINDOW_US * 1000)

    def turn(self, name):
        self._publish(name, self.pairs[name].turn(self.stream))

    def compute(self, name, number, value=0.0, flags=(), age_us=0, waited_us=0):
        self.turn(name)
        own = estimate(name, number, value, flags, age_us, self.now_ns, waited_us)
        self._publish(name, self.pairs[name].answer(own))

    def both(self, numbers):
        """Both nodes compute these windows in real time."""
        for number in numbers:
            self.wait(1)
            for name in self.pairs:
                self.compute(name, number)
            for name in self.pairs:
                self.turn(name)

    def _publish(self, name, estimates):
        self.published += estimates
        for one in estimates:
            for other, pair in self.pairs.items():
                if other not in {name, self.hangs}:
                    pair.heard(one)


@pytest.fixture
def nodes(slot):
    """One node has answered 60 windows, the other one follows."""
    nodes = Nodes(Stream(STREAM, slot))
    nodes.both(range(60))
    assert nodes.ready(nodes.follower)
    return nodes


def windows_until_published(nodes, hangs=""):
    """How many windows two nodes compute that begin a stream, or one while the other hangs, before one publishes."""
    nodes.hangs = hangs
    for number in range(200):
        nodes.wait(1)
        for name in sorted({*"ab"} - {hangs}):
            nodes.compute(name, number)
        if nodes.published:
            return number
    return None


def test_nodes_that_begin_a_stream_ask_each_other_and_do_not_wait_for_one_that_answers(slot):
    nodes = Nodes(Stream(STREAM, slot))
    assert windows_until_published(nodes) < 8
    assert nodes.asked


def test_a_node_that_begins_a_stream_waits_longer_for_a_node_that_does_not_reply(slot):
    nodes = Nodes(Stream(STREAM, slot))
    assert 20 < windows_until_published(nodes, hangs="b") < 100


def test_a_node_without_the_state_lets_a_ready_node_go_first_when_the_leader_leaves(slot):
    nodes = Nodes(Stream(STREAM, slot))
    for one in nodes.pairs.values():
        one.heard(estimate("c", 0, 0.0, (), 0).model_copy(update={"term": 5}))
    first, *_ = ranked(STREAM, set(nodes.pairs))
    (ready,) = set(nodes.pairs) - {first}
    nodes.compute(ready, 0)
    nodes.compute(first, 0, NOT_EQUAL)
    assert nodes.ready(ready)
    assert not nodes.ready(first)
    for one in nodes.pairs.values():
        one.gone("c")
    for number in range(1, 20):
        nodes.wait(1)
        for name in (first, ready):
            nodes.compute(name, number, NOT_EQUAL if name == first else 0.0)
    assert nodes.leader == ready


def test_a_follower_that_missed_packets_is_not_ready_until_its_estimates_are_equal_again(nodes):
    leader, follower = nodes.leader, nodes.follower
    nodes.wait(1)
    nodes.compute(follower, 60, NOT_EQUAL, ("gap",))
    assert not nodes.ready(follower)
    for number in (60, 61):
        nodes.compute(leader, number)
    nodes.compute(follower, 61, NOT_EQUAL)
    assert not nodes.ready(follower)
    nodes.both([62])
    assert nodes.ready(follower)


def test_an_equal_window_from_before_the_loss_does_not_make_a_follower_ready(nodes):
    leader, follower = nodes.leader, nodes.follower
    nodes.wait(1)
    nodes.compute(follower, 60)
    nodes.compute(follower, 61, NOT_EQUAL, ("gap",))
    nodes.compute(leader, 60)
    nodes.turn(follower)
    assert not nodes.ready(follower)


def test_a_leader_that_missed_packets_lets_a_node_answer_that_has_them(nodes):
    leader, follower = nodes.leader, nodes.follower
    nodes.wait(1)
    nodes.compute(follower, 60)
    nodes.compute(leader, 60, NOT_EQUAL, ("gap",))
    nodes.turn(follower)
    nodes.compute(leader, 61, NOT_EQUAL)
    nodes.compute(follower, 61)
    assert (nodes.leader, nodes.role(leader)) == (follower, "follows")
    assert [(one.start_us // WINDOW_US, one.twists[0].vx) for one in nodes.published[-2:]] == [(60, 0.0), (61, 0.0)]


def test_a_leader_answers_if_the_other_node_missed_the_same_packets(nodes):
    leader, follower = nodes.leader, nodes.follower
    nodes.wait(1)
    nodes.compute(follower, 60, NOT_EQUAL, ("gap",))
    nodes.compute(leader, 60, NOT_EQUAL, ("gap",))
    nodes.both([61])
    assert nodes.leader == leader
    assert nodes.ready(follower)


def test_a_node_that_works_off_what_arrived_while_it_hung_is_not_ready(nodes):
    leader, follower = nodes.leader, nodes.follower
    for number in range(60, 110):
        nodes.wait(1)
        nodes.compute(leader, number)
    for number in range(60, 100):
        nodes.compute(follower, number, age_us=(110 - number) * WINDOW_US)
    assert not nodes.ready(follower)
    for number in range(100, 110):
        nodes.compute(follower, number)
    nodes.both(range(110, 120))
    assert nodes.ready(follower)


def test_a_follower_that_wakes_does_not_take_over_before_it_has_heard_the_leader(nodes):
    leader, follower = nodes.leader, nodes.follower
    nodes.compute(follower, 60)
    nodes.wait(75)
    nodes.turn(follower)
    assert nodes.role(follower) == "follows"
    nodes.wait(2)
    nodes.turn(follower)
    assert nodes.leader == leader


def test_a_node_that_hangs_does_not_keep_the_leader_waiting_again_and_again(nodes):
    leader, asked = nodes.leader, nodes.asked
    nodes.hangs = nodes.follower
    for number in range(60, 70):
        nodes.wait(1.4)
        nodes.compute(leader, number)
    assert nodes.asked == asked + 1
    assert [one.start_us // WINDOW_US for one in nodes.published[-10:]] == list(range(60, 70))
    assert len({one.term for one in nodes.published[-11:]}) == 1


def test_after_a_long_pause_without_a_reply_the_leader_listens_first(nodes):
    leader = nodes.leader
    nodes.hangs = nodes.follower
    before = len(nodes.published)
    nodes.wait(75)
    nodes.compute(leader, 60)
    nodes.wait(20)
    nodes.turn(leader)
    assert (nodes.role(leader), len(nodes.published)) == ("listens", before)
    for _ in range(60):
        nodes.wait(1)
        nodes.turn(leader)
    assert nodes.role(leader) == "answers"
    assert [one.start_us // WINDOW_US for one in nodes.published[before:]] == [60]


def test_a_node_that_is_late_itself_does_not_take_over_from_a_node_that_replies(nodes):
    leader, follower, before = nodes.leader, nodes.follower, len(nodes.published)
    for number in range(60, 80):
        nodes.wait(2)
        nodes.compute(follower, number, waited_us=5 * WINDOW_US)
        nodes.turn(follower)
    assert (nodes.leader, nodes.role(follower), len(nodes.published)) == (leader, "follows", before)
    for number in range(60, 80):  # the leader was late, not silent
        nodes.compute(leader, number)
    nodes.turn(follower)
    assert nodes.ready(follower)


def test_a_node_that_is_late_itself_takes_over_from_a_node_that_hangs(nodes):
    follower, before = nodes.follower, len(nodes.published)
    nodes.hangs = nodes.leader
    for number in range(60, 64):
        nodes.wait(1)
        nodes.compute(follower, number, waited_us=5 * WINDOW_US)
    for _ in range(10):
        nodes.wait(1)
        nodes.turn(follower)
    assert nodes.role(follower) == "answers"
    assert [one.start_us // WINDOW_US for one in nodes.published[before:]] == list(range(60, 64))


def test_a_node_whose_state_differs_does_not_take_over_from_a_node_that_replies(nodes):
    leader, follower = nodes.leader, nodes.follower
    nodes.both([60])
    nodes.wait(1)
    nodes.compute(follower, 61, NOT_EQUAL)
    nodes.compute(leader, 61)
    for number in range(62, 162):
        nodes.wait(1)
        nodes.compute(follower, number, NOT_EQUAL)
    assert (nodes.leader, nodes.role(follower)) == (leader, "follows")


def test_a_late_node_does_not_wait_for_ever_for_a_node_that_replies_and_publishes_nothing(nodes):
    follower = nodes.follower
    for number in range(60, 360):
        nodes.wait(1)
        nodes.compute(follower, number, waited_us=5 * WINDOW_US)
    assert nodes.role(follower) == "answers"


def test_a_leader_that_is_late_all_the_time_asks_no_more_while_its_process_runs(slot):
    nodes = Nodes(Stream(STREAM, slot), suspended_ns=0)
    nodes.both(range(60))
    leader, asked = nodes.leader, [nodes.asked]
    for number in range(60, 90):
        nodes.wait(5)
        nodes.compute(leader, number, waited_us=5 * WINDOW_US)
        asked.append(nodes.asked)
    assert asked[0] < asked[10] == asked[-1]
    assert nodes.role(leader) == "answers"
