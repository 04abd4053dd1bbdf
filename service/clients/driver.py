"""A camera driver: publish a recording or a synthetic source as event packets, paced by its sensor clock."""

import math
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

from neurove_core.io import BrokenRecording, Recording
from neurove_core.io.imu_feed import ImuFeed, Turn
from neurove_core.io.packets import slices
from neurove_protocol import CameraInfo, Events
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.keys import Keys
from neurove_service.clients.pace import Lag, OnBehind, ignore_behind
from neurove_service.clients.stream_output import StreamOutput
from neurove_service.transport import Transport


class PlaySummary(NamedTuple):
    """The packets and events that a driver or a replay has published."""

    packets: int
    events: int
    first_us: int | None  # sensor clock; None before the first packet
    last_us: int | None  # of the newest event
    broken: NeuroVEError | None  # where and why the source ended early; None if it did not
    samples: int = 0  # of the inertial unit
    behind_s: float = 0.0  # the latest packet was published that long after it was due
    gaps: int = 0  # places where a live source lost events; each leaves one number out


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
        self._recording = recording
        has_imu = "imu" in recording.streams
        lens = lens or recording.camera(stream)
        self._output = StreamOutput(stream, recording.sensor, transport, keys, lens, has_imu=has_imu)

    @property
    def label(self) -> str:
        """Name of the stream, for messages."""
        return self._output.stream

    def wait_for_listener(self, timeout_s: float, stop: threading.Event) -> bool:
        """Wait until a service subscribes to the stream.

        Returns:
            whether one did before the timeout and the stop event.
        """
        return self._output.wait_for_listener(timeout_s, stop)

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
                samples = sent.samples
                if self._output.has_imu:
                    samples += self._output.send_samples(inertial.until(piece.end_us))
                self._output.send(sent.packets, piece.t0_us, piece.events)
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


def _stopped(stop: threading.Event, due: float) -> bool:
    """Wait until `due` on the monotonic clock; return whether the stop event came first."""
    return stop.wait(max(0.0, due - time.monotonic()))
