"""Writer of NeuroVE recordings: packets as published, or any recording split into packets."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from neurove_core.io.checked import truth
from neurove_core.io.formats.containers.mcap_writer import ChannelKind, McapWriter
from neurove_core.io.formats.packet_log import layout
from neurove_core.io.packets import slices
from neurove_core.io.recording import Recording
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField, NeuroVEError
from neurove_protocol.events import EventPacket, encode_packet
from neurove_protocol.imu import MAX_SAMPLES, Imu, ImuPacket, encode_imu
from neurove_protocol.keys import check_name

Progress = Callable[[int, int], None]
"""Called with the number of events written so far and the sensor time reached [us]."""


class PacketWriter(McapWriter):
    """Writes one recording atomically; see `McapWriter` for its life, memory and errors.

    Args:
        path: the file, with suffix .mcap; an existing file of this name is replaced.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, layout.PROFILE)

    def write(self, stream: str, payload: bytes, received_ns: int) -> None:
        """Add an event packet, as published.

        Args:
            stream: name of the stream.
            payload: bytes of the packet; they are not checked.
            received_ns: receive time [unix ns].
        """
        self.add(stream, "events", payload, received_ns)

    def camera(self, payload: bytes, received_ns: int = 0) -> None:
        """Add a CameraInfo, as published. Its stream is the one in the payload.

        Args:
            payload: bytes of the CameraInfo.
            received_ns: receive time [unix ns].

        Raises:
            NeuroVEError: the payload is not a valid CameraInfo.
        """
        self.add(CameraInfo.decode(payload).stream, "camera", payload, received_ns)

    def add(self, stream: str, kind: str, payload: bytes, log_ns: int) -> None:
        """Add a message of any kind in `layout`.

        Args:
            stream: name of the stream.
            kind: one of the kinds in the table of `layout`.
            payload: bytes of the message; they are not checked.
            log_ns: log time [ns]; a negative time is stored as 0.
        """
        topic = f"{check_name('stream', stream)}/{kind}"
        self.message(topic, ChannelKind(*layout.schema_of(kind)), payload, log_ns)

    def about(self, **entries: object) -> None:
        """Add a metadata record that describes the recording; values are stored as text."""
        self.metadata(layout.PROFILE, entries)


def write_mcap(recording: Recording, path: Path, stream: str = "cam0", progress: Progress | None = None) -> int:
    """Write a recording as a NeuroVE recording: packets as a driver sends them, and all other data of the recording.

    Args:
        recording: the recording to write; it must have an end.
        path: the file, with suffix .mcap.
        stream: name of the stream in the file.
        progress: called after each packet.

    Returns:
        Number of events written.

    Raises:
        InvalidField: the recording is endless, or the file cannot be written.
        BrokenRecording: the recording raises it; no new file is left at the path.
    """
    if recording.endless:
        raise InvalidField("recording", "source", recording.name, "it has no end")
    events = 0
    with PacketWriter(path) as writer:
        camera = recording.camera(stream)
        if camera is not None:
            writer.camera(camera.encode())
        inertial = _Inertial(recording, stream, writer)
        for seq, piece in enumerate(slices(recording.chunks())):
            inertial.write_until(piece.end_us)
            packet = EventPacket(stream, seq, recording.sensor, piece.t0_us, piece.events)
            writer.write(stream, encode_packet(packet), piece.end_us * 1000)
            events += piece.events.n
            if progress:
                progress(events, piece.end_us)
        inertial.write_until(1 << 62)
        _write_other_data(recording, stream, writer)
        writer.about(source=recording.name, stream=stream, events=events)
    return events


class _Inertial:
    """Writes the inertial samples of a recording in step with its events, so that a replay sends them in time."""

    def __init__(self, recording: Recording, stream: str, writer: PacketWriter) -> None:
        self._batches, self._stream, self._writer = recording.imu(), stream, writer
        self._rest, self._seq = Imu.empty(), 0

    def write_until(self, t_us: int) -> None:
        """Write all samples before this time [us]."""
        while True:
            before = int(self._rest.t.searchsorted(t_us))
            for first in range(0, before, MAX_SAMPLES):
                self._write(self._rest.span(first, min(first + MAX_SAMPLES, before)))
            self._rest = self._rest.span(before, self._rest.n)
            batch = None if self._rest.n else next(self._batches, None)
            if batch is None:
                return
            self._rest = batch

    def _write(self, samples: Imu) -> None:
        try:
            payload = encode_imu(ImuPacket(self._stream, self._seq, samples))
            self._seq += 1
        except NeuroVEError:  # a number beyond the bounds of the protocol: keep it, as a table that no replay sends
            payload = layout.pack_columns("imu", samples)
        self._writer.add(self._stream, "imu", payload, int(samples.t[0]) * 1000)


def _write_other_data(recording: Recording, stream: str, writer: PacketWriter) -> None:
    for triggers in recording.triggers():
        _write_rows(writer, stream, "triggers", triggers)
    poses, twists = truth(recording)
    if poses is not None:
        _write_rows(writer, stream, "poses", poses)
    if twists is not None:
        _write_rows(writer, stream, "twists", twists)
    for frame in recording.frames():
        writer.add(stream, "frames", layout.pack_frame(frame), frame.t_us * 1000)


def _write_rows(writer: PacketWriter, stream: str, kind: str, table: Any) -> None:
    for first in range(0, table.t.size, layout.ROWS):
        rows = type(table)(*(np.asarray(column)[first : first + layout.ROWS] for column in table))
        writer.add(stream, kind, layout.pack_columns(kind, rows), int(rows.t[0]) * 1000)
