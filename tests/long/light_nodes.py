"""Light nodes in a process of their own: `python -m tests.long.light_nodes ENDPOINT COUNT STREAMS`, until SIGTERM.

Each has its own session with a router and its liveliness tokens, and answers queries for its health. `close N` on
standard input ends N of them.
"""

import sys

from neurove_protocol.control import StreamStatus
from neurove_protocol.keys import Keys
from neurove_service.transport import Transport
from tests.live.conftest import client
from tests.protocol.messages import STATUS
from tests.service.metrics.test_families import reply


def streams_of(node: str, count: int) -> list[StreamStatus]:
    """Statuses as long as those of a running camera."""
    status = StreamStatus.model_validate(STATUS)
    return [status.model_copy(update={"node": node, "stream": f"cam{number}"}) for number in range(count)]


def health_of(node: str, streams: int) -> bytes:
    """The health reply of a node with so many streams."""
    number = int(node.removeprefix("robot-"))
    labels = {"site": f"hall-{number % 10}", "robot": "spot"}
    return reply(node, streams=streams_of(node, streams), labels=labels).encode()


def main(endpoint: str, count: int, streams: int) -> None:
    keys, nodes = Keys(), list[Transport]()
    for number in range(count):
        node = f"robot-{number:04}"
        transport = client(endpoint)
        payload = health_of(node, streams)
        transport.answer(keys.health(node), lambda _, payload=payload: payload)
        transport.token(keys.alive(node))
        for stream in range(streams):
            transport.token(keys.serves(node, f"cam{stream}"))
        nodes.append(transport)
    print("ready", flush=True)
    for line in sys.stdin:
        for _ in range(int(line.split()[1])):
            nodes.pop().close()
        print("done", flush=True)
    for transport in nodes:
        transport.close()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
