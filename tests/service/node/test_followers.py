"""How many streams a node follows: a few begin at once, half of them end when it cannot keep up, and they come back."""

import pytest

from neurove_protocol.duty import DutyReply
from neurove_service.node.followers import AT_ONCE, LATE_S, Followers
from neurove_service.streams.stream import Stream

STREAMS = [f"cam{number}" for number in range(12)]
TURN_S = 0.25


class Network:
    """A node `b` next to a node `a` that answers all streams, on one clock."""

    def __init__(self, slot):
        self.now_s, self.leaders = 100.0, dict.fromkeys(STREAMS, "a")
        self.roles = {}  # stream that b serves -> its state is equal
        self.streams = {one: Stream(one, slot) for one in STREAMS}
        self.followers = Followers(lambda one: one in STREAMS, self, lambda: self.now_s)

    def names(self, stream):
        return [self.leaders[stream]] if stream in self.leaders else []

    def duties(self):
        return [
            DutyReply(
                node="b",
                stream=one,
                role="follows" if one in self.leaders else "answers",
                leader=self.leaders.get(one, "b"),
                equal=equal,
            )
            for one, equal in self.roles.items()
        ]

    def retire(self, stream):
        return stream in self.roles and stream in self.leaders

    def packets(self):
        """A packet of each stream arrives; the streams that b begins to serve now."""
        begun = [one for one in STREAMS if one not in self.roles and self.followers.takes(one)]
        self.roles |= dict.fromkeys(begun, False)
        return begun

    def turn(self, seconds=TURN_S, waited_s=0.0):
        """So much later, with packets that waited so long; the streams that b ends."""
        ended = []
        for _ in range(int(seconds / TURN_S)):
            self.now_s += TURN_S
            for name in self.roles:
                activity = self.streams[name].activity
                activity.waited_ns, activity.taken_ns = int(1e9 * waited_s), activity.last_packet_ns
            ended += self.followers.turn([self.streams[one] for one in self.roles])
            for name in ended:
                self.roles.pop(name, None)
        return ended

    def settle(self):
        """Until b follows all streams with equal state."""
        for _ in range(200):
            self.roles = dict.fromkeys([*self.roles, *self.packets()], True)
            self.turn()
        assert set(self.roles) == set(STREAMS)


@pytest.fixture
def network(slot):
    return Network(slot)


def test_a_node_that_joins_takes_a_few_states_at_once(network):
    assert len(network.packets()) == AT_ONCE
    network.turn()
    assert network.packets() == []
    network.roles = dict.fromkeys(network.roles, True)
    network.turn()
    assert len(network.packets()) == AT_ONCE


def test_a_stream_that_no_other_node_serves_is_served_at_once(network):
    network.packets()
    del network.leaders["cam11"]
    assert network.packets() == ["cam11"]


def test_a_state_that_does_not_become_equal_does_not_keep_the_other_streams_waiting(network):
    first = network.packets()
    network.turn(12.0)
    assert set(network.packets()).isdisjoint(first)
    assert len(network.roles) > AT_ONCE


def test_a_node_that_cannot_keep_up_ends_followers_until_it_does_and_says_so(network):
    network.settle()
    assert network.followers.left_out == ()
    ended = network.turn(LATE_S + 2 * TURN_S, waited_s=0.5)
    assert len(ended) == len(STREAMS) / 2
    assert network.packets() == []
    assert network.followers.left_out == sorted(ended)
    network.turn(5 * LATE_S, waited_s=0.5)
    assert network.roles == {}


def test_a_short_stall_ends_no_follower(network):
    network.settle()
    assert network.turn(LATE_S / 2, waited_s=0.5) == []
    network.turn()
    assert network.turn(LATE_S / 2, waited_s=0.5) == []


def test_a_stream_that_the_node_answers_is_not_ended(network):
    network.settle()
    del network.leaders["cam3"]
    network.turn(8 * LATE_S, waited_s=0.5)
    assert set(network.roles) == {"cam3"}


def test_followers_come_back_once_the_node_keeps_up(network):
    network.settle()
    network.turn(5 * LATE_S, waited_s=0.5)
    network.settle()
    network.turn(2.0)
    assert network.followers.left_out == ()


def test_after_each_overload_a_node_waits_longer_before_it_follows_again(network):
    pauses = []
    for _ in range(3):
        network.settle()
        network.turn(LATE_S + 2 * TURN_S, waited_s=0.5)
        began_s = network.now_s
        while not network.packets():
            network.turn()
        pauses.append(network.now_s - began_s)
    assert pauses == sorted(pauses)
    assert pauses[-1] > 2 * pauses[0]
