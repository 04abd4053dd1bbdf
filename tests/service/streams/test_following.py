"""The state of a stream on its way to another node."""

import threading

import pytest

from neurove_core import carried
from neurove_service.streams.following import Sync
from neurove_service.streams.stream import Stream
from tests.builders import make_packets
from tests.service.conftest import arrived

DEADLINE_S = 60


def feed(stream, windows, first=0):
    """Packets that complete so many more windows."""
    window_us = stream.models.roles(stream.name).serving.estimator.config.window.duration_us
    for packet in make_packets(windows + (not first), first_seq=first, start_us=first * window_us, step_us=window_us):
        stream.accept(packet, arrived())


class Asking(threading.Thread):
    """Asks for the state on a thread, as a session does."""

    def __init__(self, sync, stream, after_us):
        super().__init__(daemon=True)
        self.reply, self._arguments = None, (sync, stream, after_us)
        self._asked = threading.Event()
        self.start()
        assert self._asked.wait(DEADLINE_S)

    def run(self):
        sync, stream, after_us = self._arguments
        digest = stream.lanes.serving_lane.estimator.bundle.digest
        self.reply = sync.ask("a", digest, after_us, DEADLINE_S, self._asked.set)


@pytest.fixture
def leader(slot):
    stream = Stream("cam0", slot)
    feed(stream, 3)
    return stream


def test_a_state_is_given_once_the_stream_has_reached_the_window_that_a_follower_ahead_needs(leader):
    sync, end_us = Sync("cam0"), leader.lanes.serving_lane.state.end_us
    window_us = end_us // 3
    asking = Asking(sync, leader, end_us + 2 * window_us)
    sync.serve(leader)
    feed(leader, 1, first=4)
    sync.serve(leader)
    assert asking.is_alive()
    feed(leader, 1, first=5)
    sync.serve(leader)
    asking.join(DEADLINE_S)
    assert asking.reply.end_us == end_us + 2 * window_us
    assert carried.decode(asking.reply.data, leader.lanes.serving_lane.state).end_us == asking.reply.end_us


def test_a_follower_behind_gets_the_newest_state_and_goes_on_with_it_in_the_middle_of_several_windows(leader, slot):
    follower, sync = Stream("cam0", slot), Sync("cam0")
    window_us = leader.lanes.serving_lane.state.end_us // 3
    first, *_, last = make_packets(4, start_us=window_us, step_us=window_us)
    follower.accept(first, arrived())
    asking = Asking(sync, leader, follower.lanes.serving_lane.next_us)
    sync.serve(leader)
    asking.join(DEADLINE_S)
    assert Sync("cam0").fetch(follower, lambda _digest, _after_us: asking.reply) == 3 * window_us
    follower.accept(last, arrived())  # it completes the windows 1, 2 and 3
    assert follower.lanes.serving_lane.adopted_us == 3 * window_us
    assert follower.lanes.serving_lane.state.age == leader.lanes.serving_lane.state.age + 1
