import threading

import pytest

from neurove_protocol.control import HealthRequest, PeerError
from neurove_protocol.keys import Keys
from neurove_service.clients import ask
from neurove_service.node.namesakes import Namesakes, NodeNameTaken
from neurove_service.transport import open_transport
from tests.live.conftest import client, free_endpoint, service, wait_until

KEYS = Keys()


@pytest.fixture
def sessions():
    endpoint = free_endpoint()
    with open_transport("peer", listen=(endpoint,)) as first, client(endpoint) as second:
        yield first, second


def test_a_second_node_of_a_name_is_refused_unless_it_is_told_otherwise(sessions):
    first, second = (Namesakes(session, KEYS, "edge") for session in sessions)
    stop = threading.Event()
    first.join(stop, allowed=False, leave_s=0)
    with pytest.raises(NodeNameTaken, match="node=edge"):
        second.join(stop, allowed=False, leave_s=0)
    assert first.count == 0
    Namesakes(sessions[1], KEYS, "edge2").join(stop, allowed=False, leave_s=0)
    second.join(stop, allowed=True)
    wait_until(lambda: first.count == second.count == 1)


def test_a_node_that_leaves_gives_its_name_free(sessions):
    stop = threading.Event()
    held = sessions[0].token(KEYS.instance("edge", "a"))
    second = Namesakes(sessions[1], KEYS, "edge")
    threading.Timer(1.0, held).start()
    second.join(stop, allowed=False, leave_s=60)
    assert second.count == 0


def test_two_nodes_of_one_name_tell_it_in_their_health():
    endpoint = free_endpoint()
    with service(endpoint) as (_, transport, config):
        (reply,) = ask.health(transport, config)
        assert reply.ok
        transport.token(KEYS.instance("n1", "another"))
        wait_until(lambda: ask.health(transport, config)[0].namesakes == 1)
        (reply,) = ask.health(transport, config)
        assert not reply.ok
        assert "of this name on the network" in reply.why


def test_every_query_of_a_flood_is_answered_or_refused_as_busy():
    request, answered, busy = HealthRequest().encode(), [], []
    endpoint = free_endpoint()
    with service(endpoint) as (_, transport, config):

        def flood():
            for _ in range(60):
                try:
                    answered.extend(transport.ask(config.keys.health("n1"), request, 20.0))
                except PeerError as error:
                    busy.append(error.code)

        threads = [threading.Thread(target=flood) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(answered) + len(busy) == 8 * 60
        assert set(busy) <= {"busy"}
        assert len(ask.health(transport, config)) == 1
