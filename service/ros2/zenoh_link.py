"""ROS 2 over Zenoh, as a node of rmw_zenoh: without ROS on this machine. This module and `transport` import zenoh."""

import threading
import time
from typing import Any

import zenoh
from zenoh import ext

from neurove_protocol.errors import InvalidField
from neurove_service.guard import Guard
from neurove_service.ros2 import graph
from neurove_service.ros2.graph import Attachment, Distro, Node, Qos, Topic
from neurove_service.ros2.link import OnMessage, Received, Send
from neurove_service.transport import Transport


class ZenohLink:
    """One node on the network of rmw_zenoh. Its tokens and everything declared come back after a restart of the router.

    Args:
        transport: an open session with time stamps, towards the router of ROS; the link closes it.
        domain: ROS_DOMAIN_ID.
        namespace: of the node, such as /neurove.
        name: of the node.
        distro: distribution of the ROS nodes.
        guard: counts internal errors.
    """

    def __init__(
        self, transport: Transport, domain: int, namespace: str, name: str, distro: Distro, guard: Guard
    ) -> None:
        self._transport, self._session, self._guard = transport, transport.session, guard
        self._domain, self._distro = domain, distro
        self._node = Node(domain, str(self._session.zid()), namespace, name, distro)
        self._kept: list[Any] = []  # Zenoh undeclares what is garbage collected
        transport.token(self._node.token)

    def subscribe(self, topic: Topic, qos: Qos, on_message: OnMessage) -> None:
        """See `Link`. A latched message is received from publishers before and after this subscription."""

        def receive(sample: zenoh.Sample) -> None:
            now_ns, unix_ns = time.monotonic_ns(), time.time_ns()
            try:
                type_ = graph.type_of(str(sample.key_expr))
                on_message(Received(type_, sample.payload.to_bytes(), now_ns, unix_ns, _publisher(sample.attachment)))
            except Exception as error:  # noqa: BLE001  # one message must not end the subscription
                self._guard.caught("ros message", error)

        # without this token a publisher of Lyrical does not send on the key of the topic
        self._transport.token(self._node.entity("MS", topic, qos))
        key, handler = graph.any_key(self._domain, topic.name), zenoh.handlers.Callback(receive, indirect=False)
        if not qos.latched:
            self._kept.append(self._session.declare_subscriber(key, handler))
            return
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth)
        self._kept.append(ext.declare_advanced_subscriber(self._session, key, handler, history=history))

    def publisher(self, topic: Topic, qos: Qos) -> Send:
        """See `Link`."""
        token = self._node.entity("MP", topic, qos)
        gid, lock, sent = graph.gid_of(token), threading.Lock(), 0
        self._transport.token(token)
        publisher = self._session.declare_publisher(
            graph.key(self._domain, topic, self._distro), congestion_control=zenoh.CongestionControl.DROP
        )
        self._kept.append(publisher)

        def send(payload: bytes) -> None:
            nonlocal sent
            with lock:
                sent += 1
                publisher.put(payload, attachment=Attachment(sent, time.time_ns(), gid).encode())

        return send

    @property
    def fault(self) -> str:
        """See `Link`."""
        connected = list(self._session.info.routers_zid()) or list(self._session.info.peers_zid())
        return "" if connected else "no connection to the router of ROS"

    def close(self) -> None:
        """See `Link`."""
        self._transport.close()


def _publisher(attachment: zenoh.ZBytes | None) -> bytes | None:
    """Identity of the publisher of a message; None without an attachment of rmw_zenoh."""
    if attachment is None:
        return None
    try:
        return Attachment.decode(attachment.to_bytes()).gid
    except InvalidField:
        return None
