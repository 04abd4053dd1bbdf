"""A camera driver: publish a recording or a synthetic source as event packets, paced by its sensor clock."""

import math
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

from neurove_core.io import BrokenRecording, Recording
from neurove_core.io.imu_feed import ImuFeed, Turn
from neurove_core.io.packets import Slice, slices
from neurove_protocol import CameraInfo, EventPacket, Events, ImuPacket
from neurove_protocol.camera import SCHEMA as CAMERA_SCHEMA
from neurove_protocol.events import SCHEMA as EVENTS_SCHEMA
from neurove_protocol.events import encode_packet
from neurove_protocol.imu import SCHEMA as IMU_SCHEMA
from neurove_protocol.imu import encode_imu
from neurove_protocol.keys import Keys
from neurove_service.clients.pace import Lag, OnBehind, ignore_behind
from neurove_service.transport import Transport

POLL_S = 0.02


class PlaySummary(NamedTuple):
    """The packets and events that a driver or a replay has published."""

    packets: int
    events: int
    first_us: int | None  # sensor clock; None before the first packet
    last_us: int | None  # of the newest event
    broken: BrokenRecording | None  # where and why the recording ended early; None if it did not
    samples: int = 0  # of the inertial unit
    behind_s: float = 0.0  # the latest packet was published that long after it was due


def repeated(recording: Recording, turns: list[Turn] | None = None) -> Iterator[Events]:
    """The recording in an endless loop; the times of each turn continue those of the turn before.

    Args:
        recording: it must have an end.
        turns: each turn is appended when it begins.
    """
    shift_us, end_us, first_us = 0, 0, None
    while True:
        for number, chunk in enumerate(recording.chunks()):
            first_us = int(chunk.t[0]) if first_us is None else first_us
            if number == 0 and turns is not None:
                turns.append(Turn(int(chunk.t[0]) + shift_us, shift_us))
            end_us = int(chunk.t[-1]) + shift_us
            yield chunk._replace(t=chunk.t + shift_us)
        if first_us is None:
            return
        shift_us = end_us + 1 - first_us


class Driver:
    """Publishes one stream.

    Args:
        recording: the source of events.
        stream: name of the stream.
        transport: an open session.
        keys: keys of the deployment.
        lens: of the camera; by default that of the recording.
    """

    def __init__(
        self, recording: Recording, stream: str, transport: Transport, keys: Keys, lens: CameraInfo | None = None
    ) -> None:
        self._recording, self._stream, self._lens = recording, stream, lens
        self._transport, self._keys = transport, keys
        self._publisher = transport.publisher(keys.events(stream), EVENTS_SCHEMA)
        has_imu = "imu" in recording.streams
        self._imu_publisher = transport.publisher(keys.imu(stream), IMU_SCHEMA) if has_imu else None
        self._imu_seq = 0
        self._announce_camera()

    def _announce_camera(self) -> None:
        camera = self._lens or self._recording.camera(self._stream)
        if camera is not None:
            payload = CameraInfo(**(camera.model_dump() | {"stream": self._stream})).encode()
            self._transport.answer(self._keys.camera(self._stream), lambda _: payload)
            self._transport.put(self._keys.camera(self._stream), payload, CAMERA_SCHEMA)

    @property
    def label(self) -> str:
        """Name of the stream, for messages."""
        return self._stream

    def wait_for_listener(self, timeout_s: float, stop: threading.Event) -> bool:
        """Wait until a service subscribes to the stream.

        Returns:
            whether one did before the timeout and the stop event.
        """
        deadline = time.monotonic() + timeout_s
        while not self._publisher.matching:
            if time.monotonic() >= deadline or stop.wait(POLL_S):
                return False
        return True

    def play(
        self,
        stop: threading.Event,
        *,
        speed: float = 1.0,
        loop: bool = False,
        duration_s: float = math.inf,
        on_behind: OnBehind = ignore_behind,
    ) -> PlaySummary:
        """Publish the recording until its end, the duration, or the stop event.

        Args:
            stop: ends the playback early.
            speed: sensor seconds per second; infinity publishes as fast as the recording is read.
            loop: start again at the end.
            duration_s: sensor time to play [s].
            on_behind: called once if the source or this machine cannot keep up.
        """
        lag = Lag(speed, on_behind)
        chunks, inertial = self._source(loop=loop)
        sent = PlaySummary(0, 0, None, None, None)
        began = 0.0
        try:
            for piece in slices(chunks):
                if sent.first_us is None:
                    began = time.monotonic()  # not earlier: opening and decoding take time
                first_us = piece.t0_us if sent.first_us is None else sent.first_us
                elapsed_s = (piece.end_us - first_us - piece.skipped_us) / 1e6
                if elapsed_s > duration_s or _stopped(stop, began + elapsed_s / speed):
                    break
                samples = sent.samples + self._send_samples(inertial, piece.end_us)
                self._send(sent.packets, piece)
                lag.sent(began + elapsed_s / speed, elapsed_s)
                last_us = int(piece.events.t[-1]) if piece.events.n else sent.last_us
                events = sent.events + piece.events.n
                sent = PlaySummary(sent.packets + 1, events, first_us, last_us, None, samples, lag.most_s)
        except BrokenRecording as error:
            return sent._replace(broken=error)
        return sent

    def _source(self, *, loop: bool) -> tuple[Iterator[Events], ImuFeed]:
        """The events, and the inertial samples in step with them."""
        if not loop or self._recording.endless:
            return self._recording.chunks(), ImuFeed(self._recording)
        turns: list[Turn] = []
        return repeated(self._recording, turns), ImuFeed(self._recording, turns)

    def _send_samples(self, inertial: ImuFeed, end_us: int) -> int:
        """Publish the inertial samples before this time [us]; return their number."""
        if self._imu_publisher is None:
            return 0
        samples = inertial.until(end_us)
        if samples.n:
            self._imu_publisher.put(encode_imu(ImuPacket(self._stream, self._imu_seq, samples)))
            self._imu_seq += 1
        return samples.n

    def _send(self, seq: int, piece: Slice) -> None:
        packet = EventPacket(self._stream, seq, self._recording.sensor, piece.t0_us, piece.events)
        self._publisher.put(encode_packet(packet), sent_us=time.monotonic_ns() // 1000)


def _stopped(stop: threading.Event, due: float) -> bool:
    """Wait until `due` on the monotonic clock; return whether the stop event came first."""
    return stop.wait(max(0.0, due - time.monotonic()))
