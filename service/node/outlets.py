"""Outlets: what the worker of a stream needs from the network, and the routes of messages to the workers."""

import functools
from collections.abc import Callable

from neurove_protocol import CameraInfo
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.keys import Keys
from neurove_protocol.velocity import SCHEMA as VELOCITY_SCHEMA
from neurove_service import logs
from neurove_service.streams.registry import StreamRegistry
from neurove_service.streams.worker import Outlet
from neurove_service.transport import OnTimedSample, Transport

log = logs.get(__name__)

_ASK_CAMERA_S = 1.0
_KNOWN_KEYS = 2048


def open_outlet(transport: Transport, keys: Keys, node: str, stream: str) -> Outlet:
    """Declare the publisher and the token of a stream that a node serves."""
    publisher = transport.publisher(keys.velocity(stream), VELOCITY_SCHEMA, urgent=True)
    undeclare_token = transport.token(keys.serves(node, stream))
    log.info("stream started", stream=stream)

    def ask_camera() -> CameraInfo | None:
        answers = transport.ask(keys.camera(stream), b"", _ASK_CAMERA_S)
        return CameraInfo.decode(answers[0].payload) if answers else None

    def close() -> None:
        undeclare_token()
        publisher.close()

    return Outlet(ask_camera, publisher.put, close)


def route(keys: Keys, registry: StreamRegistry, put: Callable[[str, bytes, int, int | None], None]) -> OnTimedSample:
    """A subscriber's callback: queue each message in the worker of its stream."""
    stream_of = functools.lru_cache(_KNOWN_KEYS)(keys.stream_of)

    def on_sample(key: str, payload: bytes, received_ns: int, sent_us: int | None) -> None:
        try:
            name = stream_of(key)
        except NeuroVEError:  # not a valid name
            registry.refuse(key)
            return
        put(name, payload, received_ns, sent_us)

    return on_sample
