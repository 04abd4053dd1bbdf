"""The exporter of a fleet reads nodes that answer, refuse, answer nonsense, are silent, and leave."""

import pytest

from neurove_protocol.errors import Busy
from neurove_service.clients.fleet import Nodes
from neurove_service.config import ClientConfig
from neurove_service.metrics.families import exposition
from neurove_service.transport import open_transport
from tests.live.conftest import client, free_endpoint, wait_until
from tests.service.metrics.test_families import reply

pytestmark = pytest.mark.live


def refuse(_request):
    raise Busy(4)


@pytest.mark.parametrize(
    ("other", "silent", "refused"),
    [(None, ["other"], 0), (refuse, ["other"], 0), (lambda _: b"nonsense", ["other"], 1)],
    ids=["silent", "refuses", "nonsense"],
)
def test_one_bad_node_does_not_hide_the_others(other, silent, refused):
    endpoint = free_endpoint()
    config = ClientConfig(connect=(endpoint,))
    with open_transport("peer", listen=(endpoint,)) as fleet, client(endpoint) as transport:
        fleet.answer(config.keys.health("good"), lambda _: reply("good").encode())
        if other is not None:
            fleet.answer(config.keys.health("other"), other)
        leave = [fleet.token(config.keys.alive(name)) for name in ("good", "other")][1]
        nodes = Nodes(transport, config)
        wait_until(lambda: [one.node for one in nodes.read().replies] == ["good"] and nodes.read().silent == silent)
        found = nodes.read()
        assert found.refused == refused
        assert b'neurove_node_up{node="other"} 0.0' in exposition(found)
        leave()
        wait_until(lambda: nodes.read().silent == [])
