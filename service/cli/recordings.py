"""The commands for recordings: info, record, convert, simulate."""

import argparse
import contextlib
import json
import math
import sys
import time
import urllib.parse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from neurove_protocol.errors import EXIT_FAILURE, InvalidField, NeuroVEError
from neurove_protocol.keys import check_name
from neurove_service.cli import bars
from neurove_service.cli.arguments import (
    add_client_flags,
    add_force,
    add_lens_flags,
    add_recording_flags,
    check_folder,
    client_config,
    command,
    count,
    duration,
    refuse_existing,
    seconds,
    tell_faults,
)
from neurove_service.cli.bars import event_count
from neurove_service.cli.pools import add_pool_flags, pool_of
from neurove_service.cli.waiting import Wait, add_wait
from neurove_service.lifecycle import stop_on_signals

if TYPE_CHECKING:
    from neurove_core.io.formats.ros.types import TwistMessage

Progress = Callable[[int], None]
"""Receives the number of events so far."""


class NothingRecorded(NeuroVEError):
    """No packet arrived during the recording."""

    code = "nothing_recorded"
    exit_code = EXIT_FAILURE


def record(args: argparse.Namespace) -> int:
    """Record the packets that drivers publish, until Ctrl-C."""
    from neurove_core.io.formats.packet_log.writer import PacketWriter
    from neurove_service.clients.recorder import Recorder, as_json

    stop = stop_on_signals(with_parent=args.with_parent)
    config = client_config(args)
    streams = None if args.stream == "all" else tuple(check_name("stream", one) for one in args.stream.split(","))
    path: Path = args.out
    if path.exists():
        raise InvalidField("record", "--out", str(path), "the file exists, and a recording is never overwritten")
    began = time.time()
    with PacketWriter(path) as writer, Wait(config, args.wait, stop).connect(config) as transport:
        recorder = Recorder(writer, transport, config.keys, streams)
        with _status_line(path) as show:
            duration_s = math.inf if args.seconds is None else args.seconds
            recorded = recorder.run(stop, duration_s, show)
        if not any(one.packets for one in recorded.values()):
            raise NothingRecorded(f"no packet of {_named(streams)} under {config.prefix}: nothing was recorded")
        summary = as_json(recorded)
        writer.about(streams=json.dumps(summary), began_unix_s=f"{began:.3f}", prefix=config.prefix)
    if args.json:
        print(json.dumps({"file": str(path), "bytes": path.stat().st_size, "streams": summary}))
    else:
        print("\n".join(f"{name}: {_line(one)}" for name, one in summary.items()))
        print(f"wrote {path}, {path.stat().st_size:,} bytes", file=sys.stderr)
    return EXIT_FAILURE if any(one["missing"] or one["dropped"] or one["refused"] for one in summary.values()) else 0


def _named(streams: tuple[str, ...] | None) -> str:
    return "any stream" if streams is None else f"stream {', '.join(streams)}"


def _line(stream: dict[str, Any]) -> str:
    lost = [f"{stream[name]:,} {name}" for name in ("missing", "dropped", "refused", "restarts") if stream[name]]
    held = [f"{stream['packets']:,} packets, {stream['events']:,} events"]
    held += [f"{stream['samples']:,} IMU samples"] if stream["imu_packets"] else []
    return ", ".join([*held, *(lost or ["nothing lost"])])


@contextlib.contextmanager
def _status_line(path: Path) -> Iterator[Callable[[Any], None] | None]:
    """Show the progress of the recording on a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from neurove_service.cli.console import console
    from neurove_service.clients.recorder import as_json

    with console(stderr=True).status(f"recording {path}: waiting for packets") as status:

        def show(recorded: Any) -> None:
            lines = [f"{name}: {_line(one)}" for name, one in as_json(recorded).items()]
            status.update(f"recording {path}" + "".join(f"\n  {line}" for line in lines))

        yield show


def _write_mcap(recording: Any, path: Path, progress: Progress) -> tuple[str, ...]:
    from neurove_core.io.formats.packet_log.writer import write_mcap

    write_mcap(recording, path, progress=lambda events, _: progress(events))
    return ()


def _write_dsec(recording: Any, path: Path, progress: Progress) -> tuple[str, ...]:
    from neurove_core.io.formats.hdf5.dsec_write import write_dsec

    return write_dsec(recording, path, progress).left_out


Writer = Callable[[Any, Path, Progress], tuple[str, ...]]
"""Writes (recording, path, progress), and returns the streams that the format cannot hold."""

WRITERS: Final[dict[str, Writer]] = {".mcap": _write_mcap, ".h5": _write_dsec}
"""The writer for each suffix."""

_STREAM: Final = "cam0"  # in a bag

_ENDLESS_S: Final = 5.0  # that `info` reads of a source without end


def convert(args: argparse.Namespace) -> int:
    """Convert a recording to a packet log or a ROS 2 bag (.mcap), or to DSEC's layout (.h5)."""
    from neurove_core.sources import open_source

    path: Path = args.out
    if path.suffix not in WRITERS:
        raise InvalidField("convert", "OUT", str(path), f"its name must end in {' or '.join(WRITERS)}")
    if args.estimates is not None and args.layout != "ros2":
        raise InvalidField("convert", "--estimates", str(args.estimates), "it needs --for ros2")
    recording = open_source(args.source, args.sensor, args.topic, args.time_unit)
    refuse_existing("convert", "OUT", path, args.source, force=args.force)
    return _write(recording, path, as_json=args.json, write=_bag_writer(args) if args.layout == "ros2" else None)


def _bag_writer(args: argparse.Namespace) -> Writer:
    """The writer of a ROS 2 bag, with the estimates of a file if the user gives one."""
    from neurove_core.io.formats.ros.bag_writer import write_bag

    if args.out.suffix != ".mcap":
        raise InvalidField("convert", "OUT", str(args.out), "its name must end in .mcap, for --for ros2")

    def write(recording: Any, path: Path, progress: Progress) -> tuple[str, ...]:
        velocities = () if args.estimates is None else _velocities(args.estimates)
        return write_bag(recording, path, velocities=velocities, progress=progress)

    return write


def _velocities(path: Path) -> "Iterator[TwistMessage]":
    """The estimates of a file of `neurove estimate`, as messages of ROS."""
    from neurove_core.io.formats.estimate_files import read_estimates
    from neurove_core.io.formats.ros.bag_writer import optical_frame
    from neurove_service.ros2.velocity import Velocity

    velocity = Velocity(_STREAM)
    for estimate in read_estimates(path):
        message = velocity.message(estimate, estimate.end_us * 1000, optical_frame(_STREAM))
        if message is not None:
            yield message


def _write(recording: Any, path: Path, *, as_json: bool, write: "Writer | None" = None) -> int:
    counted = {"events": 0}
    with event_count(recording.name) as show:

        def progress(events: int) -> None:
            counted["events"] = events
            show(events)

        left_out = (write or WRITERS[path.suffix])(recording, path, progress)
    if left_out:
        holds_not = "a ROS 2 bag cannot hold them" if write else f"{path.suffix} cannot hold them, .mcap can"
        print(
            f"neurove: {path} lacks {', '.join(left_out)}: {holds_not}",
            file=sys.stderr,
        )
    tell_faults(recording)
    size = path.stat().st_size
    summary = {"file": str(path), "bytes": size, "events": counted["events"], "streams": recording.streams}
    summary |= {"left_out": left_out, "faults": [fault.as_json() for fault in recording.faults.found]}
    if as_json:
        print(json.dumps(summary))
    else:
        print(f"{path}: {counted['events']:,} events of {recording.name}, {size:,} bytes")
    return EXIT_FAILURE if recording.faults.unread else 0


def info(args: argparse.Namespace) -> int:
    """Show what a recording holds: sensor, counts, rates, IMU and truth."""
    from neurove_core.io import summary
    from neurove_core.io.calibration import with_lens
    from neurove_core.sources import open_source
    from neurove_service.cli.console import console
    from neurove_service.cli.views import survey_table

    opened = open_source(args.source, args.sensor, args.topic, args.time_unit)
    recording = with_lens(opened, args.calibration, args.height)
    if args.plot:
        refuse_existing("info", "--plot", args.plot, args.source, force=args.force)
    duration_s = args.seconds if args.seconds is not None else (_ENDLESS_S if recording.endless else None)
    surveyed = summary.survey(recording, duration_s)
    if args.plot:
        from neurove_core.io import summary_plot

        summary_plot.draw(surveyed, args.plot)
    found = surveyed.summary
    if args.json:
        print(json.dumps(found.as_json()))
    else:
        console().print(survey_table(found))
    if args.plot:
        print(f"wrote {args.plot}", file=sys.stderr)
    if found.broken and not recording.faults.unread:
        print(f"neurove: {found.broken}", file=sys.stderr)
    tell_faults(recording)
    return EXIT_FAILURE if found.broken or found.faults else 0


def simulate(args: argparse.Namespace) -> int:
    """Record a simulated event camera with its exact motion."""
    from neurove_core.sources import open_source

    path: Path = args.out
    if args.scene == "carla":
        refuse_existing("simulate", "--out", path, None, force=args.force)
        return _simulate_carla(args)
    if args.count is not None:
        return _simulate_series(args)
    if path.suffix not in WRITERS:
        raise InvalidField("simulate", "--out", str(path), f"its name must end in {' or '.join(WRITERS)}")
    refuse_existing("simulate", "--out", path, None, force=args.force)
    recording = open_source(f"sim://{args.scene}?{urllib.parse.urlencode(_query(args) | {'seed': args.seed})}")
    return _write(recording, path, as_json=args.json)


def _query(args: argparse.Namespace) -> dict[str, Any]:
    """What the user gives of a simulation, without its seed."""
    query = {name: getattr(args, name) for name in ("trajectory", "camera", "height", "pitch", "seconds")}
    return {name: value for name, value in query.items() if value is not None}


def _simulate_series(args: argparse.Namespace) -> int:
    """Record one simulation for each of several seeds into a folder."""
    from neurove_core import series

    check_folder("simulate", "--out", args.out)
    files, new = [], 0
    with pool_of(args) as pool, bars.progress() as show:
        seeds = range(args.seed, args.seed + args.count)
        for path, simulated in series.simulate(args.scene, seeds, _query(args), args.out, pool):
            files.append(str(path))
            new += simulated
            show("simulated", len(files), args.count, path.name)
    summary = {"files": sorted(files), "simulated": new}
    print(json.dumps(summary) if args.json else f"{args.out}: {len(files)} recordings, {new} of them new")
    return 0


def _simulate_carla(args: argparse.Namespace) -> int:
    """Record an event camera on a car of a running CARLA server, with its poses."""
    from neurove_core.io.formats.carla_server import record as record_carla

    host, _, port = args.server.rpartition(":")
    if not (host and port.isdecimal()):
        raise InvalidField("simulate carla", "--server", args.server, "give HOST:PORT, such as 127.0.0.1:2000")
    events = record_carla(args.out, args.seconds, host=host, port=int(port), seed=args.seed)
    summary = {"file": str(args.out), "events": events}
    print(json.dumps(summary) if args.json else f"{args.out}: {events:,} events")
    return 0


def add_record(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove record`."""
    command(parser, record)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="packet log to write, ending in .mcap")
    parser.add_argument("--stream", default="all", metavar="NAME,...", help="names of streams; default all")
    parser.add_argument("--seconds", type=duration, metavar="S", help="length of the recording; default: until Ctrl-C")
    parser.add_argument("--with-parent", action="store_true", help="end when the parent process ends")
    add_client_flags(parser)
    add_wait(parser)


def add_convert(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove convert`."""
    command(parser, convert)
    parser.add_argument("source", metavar="IN", help="recording of any format")
    parser.add_argument(
        "out", type=Path, metavar="OUT", help="file to write, ending in .mcap (packet log) or .h5 (DSEC)"
    )
    about = "ros2: a bag for ROS 2, PlotJuggler and Foxglove (.mcap), with events, camera_info, imu, truth and velocity"
    parser.add_argument("--for", dest="layout", choices=("ros2",), help=about)
    about = "with --for ros2: file of `neurove estimate` (.mcap), whose estimates become the velocity"
    parser.add_argument("--estimates", type=Path, metavar="FILE", help=about)
    add_recording_flags(parser)
    add_force(parser, "OUT")


def add_info(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove info`."""
    command(parser, info)
    parser.add_argument("source", metavar="SOURCE", help="recording of any format, pattern:// or sim://")
    add_recording_flags(parser)
    add_lens_flags(parser)
    most = f"default: all, of an endless source {_ENDLESS_S:.0f} s"
    parser.add_argument("--seconds", type=duration, metavar="S", help=f"seconds of the source to read; {most}")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw events, rate and truth (.png or .svg)")
    add_force(parser, "FILE")


def add_simulate(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove simulate`."""
    command(parser, simulate)
    scenes = "street, bare-street, corridor, room, plain-room or wall; carla: record from a CARLA server"
    parser.add_argument("scene", metavar="SCENE", help=scenes)
    about = "file to write: .mcap (packet log) or .h5 (DSEC); .npz for carla; with --count a folder"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=about)
    add_force(parser, "FILE")
    parser.add_argument("--seconds", type=seconds, default=10.0, metavar="S", help="seconds to simulate; default 10 s")
    about = "seed of scene, trajectory and pixels; default 0"
    parser.add_argument("--seed", type=int, default=0, metavar="N", help=about)
    about = "driving, handheld, still, rotation?wy=1, a file of poses, ...; default: that of the scene"
    parser.add_argument("--trajectory", metavar="T", help=about)
    about = "simulate N recordings with the seeds from --seed on, as packet logs; those in the folder are kept"
    parser.add_argument("--count", type=count, metavar="N", help=about)
    add_pool_flags(parser, "simulate one recording of --count each")
    about = "davis346-half, davis346, davis240c, prophesee, ...; default davis346-half"
    parser.add_argument("--camera", metavar="C", help=about)
    parser.add_argument("--height", metavar="M", help="height of the camera above the ground [m]; default 1.5")
    parser.add_argument("--pitch", metavar="DEG", help="angle of the camera below the horizon [deg]; default 5")
    about = "the CARLA server; default 127.0.0.1:2000"
    parser.add_argument("--server", default="127.0.0.1:2000", metavar="HOST:PORT", help=about)
