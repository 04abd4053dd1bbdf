"""A small client of Foxglove's protocol: websocket handshake and frames by hand, messages by their own schemas."""

import base64
import json
import os
import socket
import struct

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

SUBPROTOCOL = "foxglove.sdk.v1"
TEXT, BINARY, CLOSE, PING = 1, 2, 8, 9
MESSAGE_DATA = 1


class FoxgloveClient:
    """Connects, and keeps the channels that the server advertises."""

    def __init__(self, host, port):
        self._socket = socket.create_connection((host, port), timeout=120)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = (
            "GET / HTTP/1.1",
            f"Host: {host}:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Protocol: {SUBPROTOCOL}",
        )
        self._socket.sendall("\r\n".join((*lines, "", "")).encode())
        self._stream = self._socket.makefile("rb")
        head = []
        while line := self._stream.readline().strip():
            head.append(line.decode())
        assert head[0].startswith("HTTP/1.1 101"), head
        self.subprotocol = next(one.partition(": ")[2] for one in head if one.lower().startswith("sec-websocket-proto"))
        self.channels = {}  # topic -> channel
        self._topics = {}  # subscription -> topic

    def close(self):
        self._stream.close()
        self._socket.close()

    def channel(self, topic):
        """The channel of a topic, as soon as it is advertised."""
        while topic not in self.channels:
            self._next()
        return self.channels[topic]

    def subscribe(self, topic):
        channel, number = self.channel(topic), len(self._topics) + 1
        self._topics[number] = topic
        wanted = {"op": "subscribe", "subscriptions": [{"id": number, "channelId": channel["id"]}]}
        self._send(json.dumps(wanted).encode())

    def message(self, topic):
        """The next message of a topic, decoded with the schema that the server advertised."""
        while True:
            found = self._next()
            if found is not None and found[0] == topic:
                channel = self.channels[topic]
                schema = base64.b64decode(channel["schema"])
                return decoded(channel["schemaName"], schema, found[1])

    def _send(self, payload):
        """One masked text frame, as a client must send it."""
        mask = os.urandom(4)
        size = struct.pack(">B", 0x80 | len(payload)) if len(payload) < 126 else struct.pack(">BH", 0xFE, len(payload))
        body = bytes(byte ^ mask[place % 4] for place, byte in enumerate(payload))
        self._socket.sendall(bytes([0x80 | TEXT]) + size + mask + body)

    def _next(self):
        """Read one frame; topic and payload if it is a message."""
        kind, payload = self._frame()
        if kind == TEXT:
            said = json.loads(payload)
            if said["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in said["channels"]}
        elif kind == BINARY and payload[0] == MESSAGE_DATA:
            number, _log_time_ns = struct.unpack_from("<IQ", payload, 1)
            return self._topics.get(number), payload[13:]
        elif kind == CLOSE:
            raise ConnectionError(payload)
        return None

    def _frame(self):
        first, size = self._stream.read(2)
        if size == 126:
            (size,) = struct.unpack(">H", self._stream.read(2))
        elif size == 127:
            (size,) = struct.unpack(">Q", self._stream.read(8))
        return first & 0x0F, self._stream.read(size)


def decoded(name, schema, payload):
    """A protobuf message, by the FileDescriptorSet that describes it."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString(payload)
