"""Writer of NeuroVE recordings: packets as published, or any recording split into packets."""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np

from neurove_core.extras import MissingExtra
from neurove_core.io.checked import truth
from neurove_core.io.formats.packet_log import layout
from neurove_core.io.packets import slices
from neurove_core.io.recording import Recording
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField, NeuroVEError
from neurove_protocol.events import EventPacket, encode_packet
from neurove_protocol.imu import MAX_SAMPLES, Imu, ImuPacket, encode_imu
from neurove_protocol.keys import check_name

CHUNK_BYTES: Final = 1 << 20
"""Size of one compressed chunk [bytes]; at most this much is lost if the machine fails."""

PART: Final = ".part"
"""Suffix of the file name until the file is complete."""

Progress = Callable[[int, int], None]
"""Called with the number of events written so far and the sensor time reached [us]."""


class PacketWriter:
    """Writes one recording atomically: the file gets its name when it is closed, complete.

    Use it in a `with` block: an error in the block removes the partial file. Memory holds one chunk, and about 100
    bytes of index for each chunk written.

    Args:
        path: the file, with suffix .mcap; an existing file of this name is replaced.

    Raises:
        InvalidField: the file cannot be written; also raised while writing. MissingExtra: mcap is not installed.
    """

    def __init__(self, path: Path) -> None:
        try:
            from mcap.writer import CompressionType, Writer
        except ModuleNotFoundError:
            raise MissingExtra("mcap", "recordings") from None
        if path.suffix != ".mcap":
            raise InvalidField("recording", "FILE", str(path), "its name must end in .mcap")
        self.path, self._part = path, path.with_name(path.name + PART)
        with self._os_errors_as_invalid():
            try:
                self._file = self._part.open("xb")
            except FileExistsError:
                why = "an incomplete recording, or one that is being written, has this name: rename or remove it"
                raise InvalidField("recording", "FILE", str(self._part), why) from None
        self._writer: Any = Writer(self._file, CHUNK_BYTES, CompressionType.ZSTD)
        self._writer.start(layout.PROFILE, "neurove")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._count: dict[int, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()

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
        with self._os_errors_as_invalid():
            topic = f"{check_name('stream', stream)}/{kind}"
            if topic not in self._channels:
                self._channels[topic] = self._registered(topic, kind)
            channel = self._channels[topic]
            number = self._count[channel] = self._count.get(channel, 0) + 1
            log_ns = max(0, log_ns)
            self._writer.add_message(channel, log_ns, payload, log_ns, number & 0xFFFFFFFF)

    def _registered(self, topic: str, kind: str) -> int:
        name, encoding = layout.schema_of(kind)
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "", b"")
        return int(self._writer.register_channel(topic, encoding, self._schemas[name]))

    def about(self, **entries: object) -> None:
        """Add a metadata record that describes the recording; values are stored as text."""
        with self._os_errors_as_invalid():
            self._writer.add_metadata(layout.PROFILE, {name: str(value) for name, value in entries.items()})

    @property
    def bytes_written(self) -> int:
        """Current size of the file [bytes]."""
        return self._file.tell()

    def close(self) -> None:
        """Complete the file and rename it to its final name."""
        try:
            with self._os_errors_as_invalid():
                self._writer.finish()
                self._file.flush()
                os.fsync(self._file.fileno())
                self._file.close()
                self._part.replace(self.path)
        except BaseException:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Close and remove the incomplete file."""
        with contextlib.suppress(OSError):
            self._file.close()
        self._part.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _os_errors_as_invalid(self) -> Iterator[None]:
        """Raise InvalidField instead of OSError in the block."""
        try:
            yield
        except OSError as error:
            raise InvalidField("recording", "FILE", str(self.path), error.strerror or str(error)) from None


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
