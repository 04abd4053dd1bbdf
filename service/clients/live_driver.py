"""A driver of a live source: publish what a camera or a network stream sends, as it comes."""

import math
import threading
import time
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.packets import PACKET_EVENTS, PACKET_US
from neurove_core.live.source import Batch, LiveEnded, LiveSource
from neurove_protocol import CameraInfo, Events
from neurove_protocol.imu import MAX_SAMPLES, Imu
from neurove_protocol.keys import Keys
from neurove_service import logs
from neurove_service.clients.driver import PlaySummary
from neurove_service.clients.stream_output import StreamOutput
from neurove_service.transport import Transport

log = logs.get(__name__)

_HOLD_S: Final = PACKET_US / 1e6
"""Events of a camera that sends small pieces wait at most this long for a packet [s]."""


class LiveDriver:
    """Publishes a live source as one stream: not paced, with a clock tick while no event comes.

    Where the source lost events, one sequence number is left out. Where its clock begins again, so do the numbers.

    Args:
        source: the camera or network stream.
        stream: name of the stream.
        transport: an open session.
        keys: keys of the deployment.
        lens: of the camera; None if it is unknown.
        rotation: (3, 3) from the axes of the source's inertial samples to the optical frame; None for the identity.
    """

    def __init__(
        self,
        source: LiveSource,
        stream: str,
        transport: Transport,
        keys: Keys,
        lens: CameraInfo | None = None,
        rotation: NDArray[np.float64] | None = None,
    ) -> None:
        self._batches, self._rotation = source.batches(), rotation
        has_imu = "imu" in source.streams
        self._output = StreamOutput(stream, source.sensor, transport, keys, lens, has_imu=has_imu)
        self._seq = self._newest_us = 0
        self._sent = PlaySummary(0, 0, None, None, None)
        self._waiting: list[Events] = []
        self._waiting_since = 0.0

    @property
    def label(self) -> str:
        """Name of the stream, for messages."""
        return self._output.stream

    def wait_for_listener(self, timeout_s: float, stop: threading.Event) -> bool:
        """Wait until a service subscribes to the stream. What arrives until then is discarded: it would be late.

        Returns:
            whether one did before the timeout and the stop event.

        Raises:
            LiveEnded: the source ended.
        """
        deadline = time.monotonic() + timeout_s
        while not self._output.is_heard:
            if stop.is_set() or time.monotonic() >= deadline:
                return False
            next(self._batches)
        return True

    def play(self, stop: threading.Event, *, duration_s: float = math.inf) -> PlaySummary:
        """Publish until the source ends, the duration, or the stop event.

        Args:
            stop: ends the publication.
            duration_s: by the clock of this machine [s].
        """
        until = time.monotonic() + duration_s
        try:
            for batch in self._batches:
                if stop.is_set() or time.monotonic() >= until:
                    break
                self._publish(batch)
        except LiveEnded as error:
            self._sent = self._sent._replace(broken=error)
        self._flush()
        if self._sent.last_us is not None and self._newest_us <= self._sent.last_us:
            self._send(self._sent.last_us + 1, Events.empty())  # completes the window that ends with the last event
        return self._sent

    def _publish(self, batch: Batch) -> None:
        if batch.lost or batch.restarted:
            self._flush()
        if batch.lost:
            self._seq += 1
            self._sent = self._sent._replace(gaps=self._sent.gaps + 1)
            log.warning("events lost before they arrived", stream=self.label, gaps=self._sent.gaps)
        if batch.restarted:
            self._seq = 0
            log.warning("the clock of the camera began again", stream=self.label)
        self._publish_samples(batch.samples)
        if batch.events.n:
            self._waiting_since = self._waiting_since if self._waiting else time.monotonic()
            self._waiting.append(batch.events)
            span_us = int(batch.events.t[-1]) - int(self._waiting[0].t[0])
            if span_us >= PACKET_US or time.monotonic() - self._waiting_since >= _HOLD_S:
                self._flush()
            return
        self._flush()
        if batch.now_us is not None:
            self._send(batch.now_us, batch.events)

    def _publish_samples(self, samples: Imu) -> None:
        if self._rotation is not None:
            samples = samples._replace(
                accel_m_s2=samples.accel_m_s2 @ self._rotation.T, gyro_rad_s=samples.gyro_rad_s @ self._rotation.T
            )
        for first in range(0, samples.n, MAX_SAMPLES):
            n = self._output.send_samples(samples.span(first, min(first + MAX_SAMPLES, samples.n)))
            self._sent = self._sent._replace(samples=self._sent.samples + n)

    def _flush(self) -> None:
        """Publish the events that wait for a packet."""
        events, self._waiting = Events.join(self._waiting), []
        for piece in packets_of(events):
            self._send(int(piece.t[0]), piece)

    def _send(self, t0_us: int, events: Events) -> None:
        self._output.send(self._seq, t0_us, events)
        self._seq += 1
        self._newest_us = t0_us
        sent = self._sent
        self._sent = sent._replace(
            packets=sent.packets + 1,
            events=sent.events + events.n,
            first_us=t0_us if sent.first_us is None else sent.first_us,
            last_us=int(events.t[-1]) if events.n else sent.last_us,
        )


def packets_of(events: Events) -> Iterator[Events]:
    """Spans of at most PACKET_US and PACKET_EVENTS that begin with their first event; none without events."""
    first = 0
    while first < events.n:
        before = int(events.t[first:].searchsorted(int(events.t[first]) + PACKET_US))
        stop = first + min(before, PACKET_EVENTS)
        yield events.span(first, stop)
        first = stop
