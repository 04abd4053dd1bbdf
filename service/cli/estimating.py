"""The command estimate: the estimates of a recording as a file, as the service gives them. It needs no service."""

import argparse
import contextlib
import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurove_protocol import CameraInfo, EventPacket, Imu, ImuPacket, TwistEstimate
from neurove_protocol.errors import EXIT_FAILURE, InvalidField, NeuroVEError
from neurove_protocol.imu import decode_imu, encode_imu
from neurove_service import logs
from neurove_service.cli.arguments import (
    add_axes_flag,
    add_force,
    add_lens_flags,
    add_recording_flags,
    add_refine_flag,
    command,
    duration,
    refuse_existing,
    tell_faults,
)
from neurove_service.cli.bars import event_count
from neurove_service.cli.extras import one_thread

if TYPE_CHECKING:
    from neurove_core.estimator import Estimator
    from neurove_core.io import Recording
    from neurove_service.streams.roles import Roles

_STREAM = "cam0"  # unless the recording is a packet log, which names its streams


class OneModel:
    """One model for all streams, for ever; see `model_source.ModelSource`."""

    def __init__(self, estimator: "Estimator") -> None:
        from neurove_service.streams.roles import Roles, Serving

        self._roles = Roles(Serving(estimator, 0))

    def roles(self, _: str, /) -> "Roles":
        """This model."""
        return self._roles

    def fault(self, _: Any, why: str, /) -> None:
        """Nothing: only a model on probation has faults that a stream survives."""

    def join(self, _: Any, /) -> None:
        """Nothing: the model does not change."""


class Offline:
    """The estimates of one recording by the stream of a service, at the pace of the sensor clock: no packet is late.

    Args:
        estimator: the model.
        camera: lens of the recording, or None.
        stream: name of the stream in the estimates.
    """

    def __init__(self, estimator: "Estimator", camera: CameraInfo | None, stream: str) -> None:
        from neurove_service.streams.stream import Stream

        self._now_ns = 0
        self._newest_us: int | None = None
        self.stream = Stream(stream, OneModel(estimator), lambda: self._now_ns)
        if camera is not None:
            self.stream.set_camera(camera)

    def accept(self, packet: EventPacket) -> list[TwistEstimate]:
        """The estimates of the windows that a packet completes. They have no time of the host."""
        from neurove_service.streams.intake import Arrival

        newest_us = packet.events.last_us if packet.events.n else packet.t0_us
        if self._newest_us is not None:
            self._now_ns += max(0, newest_us - self._newest_us) * 1000
        self._newest_us = newest_us
        found = self.stream.accept(packet, Arrival(self._now_ns, self._now_ns))
        return [one.model_copy(update={"host": None}) for one in found]

    def accept_samples(self, packet: ImuPacket) -> None:
        """Add the samples of the inertial unit."""
        self.stream.inertial.accept(encode_imu(packet), self._now_ns)

    def refuse(self, why: str) -> None:
        """Count a packet that cannot be decoded."""
        self.stream.refused(self._now_ns, why)


def estimates_of(
    recording: "Recording", offline: Offline, *, as_published: bool = True, inertial: bool = True
) -> Iterator[tuple[int, list[TwistEstimate]]]:
    """The estimates of a recording, packet by packet as `neurove drive` sends it.

    Args:
        recording: the source of events.
        offline: the stream; it counts what it refuses.
        as_published: send the packets of a packet log as they were published, else encode its events again.
        inertial: send the inertial samples too.

    Yields:
        for each packet the sensor time since the first one [us], and the estimates that it completes.
    """
    first_us: int | None = None
    for packet in _packets(recording, offline.stream.name, as_published=as_published, inertial=inertial):
        if isinstance(packet, NeuroVEError):
            offline.refuse(packet.message)
            continue
        if isinstance(packet, ImuPacket):
            offline.accept_samples(packet)
            continue
        first_us = packet.t0_us if first_us is None else first_us
        yield packet.t0_us - first_us, offline.accept(packet)


def _packets(
    recording: "Recording", stream: str, *, as_published: bool, inertial: bool
) -> Iterator[EventPacket | ImuPacket | NeuroVEError]:
    from neurove_core.io.formats.packet_log.reader import LIMITS, McapRecording
    from neurove_core.io.imu_feed import ImuFeed
    from neurove_core.io.packets import slices
    from neurove_protocol.events import decode_packet

    if isinstance(recording, McapRecording) and as_published:
        for recorded in recording.driven(recording.stream):
            if recorded.kind == "imu":
                if inertial:
                    with contextlib.suppress(NeuroVEError):
                        yield replace(decode_imu(recorded.payload), stream=stream)
                continue
            try:
                yield replace(decode_packet(recorded.payload, LIMITS), stream=stream)
            except NeuroVEError as error:
                yield error
        return
    feed = ImuFeed(recording)
    for seq, piece in enumerate(slices(recording.chunks())):
        samples = feed.until(piece.end_us) if inertial else Imu.empty()
        if samples.n:
            yield ImuPacket(stream, seq, samples)
        yield EventPacket(stream, seq, recording.sensor, piece.t0_us, piece.events)


def estimate(args: argparse.Namespace) -> int:
    """Write the estimates of a recording to a file, as the service would give them."""
    from neurove_core import models
    from neurove_core.estimator import Estimator
    from neurove_core.io.axes import with_axes
    from neurove_core.io.calibration import lens_of
    from neurove_core.io.formats.estimate_files import WRITERS, estimate_file
    from neurove_core.sources import open_source

    logs.configure("error")  # the summary counts what is lost
    path: Path = args.out
    if path.suffix not in WRITERS:
        raise InvalidField("estimate", "--out", str(path), f"its name must end in {', '.join(WRITERS)}")
    recording = with_axes(open_source(args.source, args.sensor, args.topic, args.time_unit), args.imu_axes)
    if recording.endless and args.seconds in (None, math.inf):
        raise InvalidField("estimate", "RECORDING", args.source, "it never ends: give --seconds S")
    refuse_existing("estimate", "--out", path, args.source, force=args.force)
    camera = lens_of(recording, args.calibration, args.height)
    one_thread()
    estimator = Estimator(models.find(args.model), refine=args.refine == "auto")
    offline = Offline(estimator, camera, getattr(recording, "stream", _STREAM))
    told = _Told(estimator, recording)
    with event_count(recording.name) as show, estimate_file(path) as add:
        found = estimates_of(recording, offline, as_published=args.sensor is None, inertial=not args.no_imu)
        broken = _write(found, told, add, args.seconds, lambda: show(offline.stream.counters.events_received))
    broken = broken or next(map(str, recording.faults.unread), None)
    summary = told.summary(path, offline) | {"broken": broken}
    print(json.dumps(summary) if args.json else "\n".join(_lines(summary)))
    if broken and not recording.faults.unread:
        print(f"neurove: {broken}", file=sys.stderr)
    tell_faults(recording)
    return EXIT_FAILURE if broken or not told.estimates else 0


def _write(
    found: Iterator[tuple[int, list[TwistEstimate]]],
    told: "_Told",
    add: Callable[[TwistEstimate], None],
    seconds: float | None,
    show: Callable[[], None],
) -> str | None:
    """Write estimates up to the end of the recording; returns where and why it is broken, if it is."""
    from neurove_core.io import BrokenRecording

    try:
        for elapsed_us, estimates in found:
            if seconds is not None and elapsed_us > seconds * 1e6:
                break
            for one in estimates:
                add(one)
                told.add(one)
            show()
    except BrokenRecording as error:
        return error.message
    return None


class _Told:
    """What was written, for the summary."""

    def __init__(self, estimator: "Estimator", recording: "Recording") -> None:
        self._bundle, self._recording = estimator.bundle, recording
        self.estimates = 0
        self._begin_us = self._end_us = 0
        self._flags, self._sources = Counter[str](), Counter[str]()

    def add(self, one: TwistEstimate) -> None:
        self._begin_us = one.start_us if not self.estimates else self._begin_us
        self._end_us = one.end_us
        self.estimates += 1
        self._flags.update(one.flags)
        self._sources[one.source] += 1

    def summary(self, path: Path, offline: Offline) -> dict[str, Any]:
        return {
            "file": str(path),
            "bytes": path.stat().st_size,
            "recording": self._recording.name,
            "estimates": self.estimates,
            "begin_us": self._begin_us,
            "end_us": self._end_us,
            "events": offline.stream.counters.events_received,
            "model": self._bundle.name,
            "digest": self._bundle.digest,
            "flags": dict(self._flags),
            "sources": dict(self._sources),
            "lost": offline.stream.counters.losses().nonzero(),
            "faults": [fault.as_json() for fault in self._recording.faults.found],
        }


def _lines(summary: dict[str, Any]) -> Iterator[str]:
    estimates = summary["estimates"]
    if not estimates:
        yield f"{summary['file']}: no estimates, because {summary['recording']} completes no window"
        return
    span_s = (summary["end_us"] - summary["begin_us"]) / 1e6
    model = f"{summary['model']} ({summary['digest'][:12]})"
    yield f"{summary['file']}: {estimates:,} estimates of {summary['recording']} by {model}, {span_s:,.3f} s"
    flags = [f"{name} {count / estimates:.0%}" for name, count in sorted(summary["flags"].items())]
    yield f"flags: {', '.join(flags) or 'none'}"
    sources = [f"{name} {count / estimates:.0%}" for name, count in sorted(summary["sources"].items())]
    yield f"angular part: {', '.join(sources)}"
    if summary["lost"]:
        yield "not used: " + ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in summary["lost"].items())
    if "unscaled" in summary["flags"]:
        yield "the height of the camera is not known: the linear part is that of a camera 1 m above the ground"


def add_estimate(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove estimate`."""
    command(parser, estimate)
    parser.add_argument("source", metavar="RECORDING", help="recording of any format, or sim://; no truth is needed")
    about = "file to write: .csv (one row per bin), .tum (poses integrated from the twists) or .mcap (the messages)"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=about)
    about = "name of a built-in model, or file of a bundle; default `default`"
    parser.add_argument("--model", default="default", metavar="BUNDLE", help=about)
    add_lens_flags(parser)
    add_recording_flags(parser)
    add_refine_flag(parser)
    add_axes_flag(parser)
    parser.add_argument("--no-imu", action="store_true", help="use the events alone, not the inertial samples")
    parser.add_argument("--seconds", type=duration, metavar="S", help="seconds of the recording to read; default: all")
    add_force(parser, "FILE")
