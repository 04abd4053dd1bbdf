"""The commands of recordings: info, record, convert, simulate."""

import argparse
import contextlib
import json
import math
import sys
import time
import urllib.parse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from neurove_protocol.errors import EXIT_FAILURE, InvalidField, NeuroVEError
from neurove_protocol.keys import check_name
from neurove_service.cli.arguments import BAD_NEWS, add_client_flags, client_config, command, seconds, sensor_size
from neurove_service.lifecycle import stop_on_signals

Progress = Callable[[int], None]
"""Events so far."""


class NothingRecorded(NeuroVEError):
    """No packet came while we listened."""

    code = "nothing_recorded"
    exit_code = EXIT_FAILURE


def record(args: argparse.Namespace) -> int:
    """Write what drivers publish into a file, until Ctrl-C."""
    from neurove_core.io import PacketWriter
    from neurove_service.clients import ask
    from neurove_service.clients.recorder import Recorder, as_json

    stop = stop_on_signals(with_parent=args.with_parent)
    config = client_config(args)
    streams = None if args.stream == "all" else tuple(check_name("stream", one) for one in args.stream.split(","))
    path: Path = args.out
    if path.exists():
        raise InvalidField("record", "--out", str(path), "there is such a file: a recording is not written over")
    began = time.time()
    with ask.connect(config, stop=stop) as transport, PacketWriter(path) as writer:
        recorder = Recorder(writer, transport, config.keys, streams)
        with _shown(path) as show:
            accounts = recorder.run(stop, args.duration, show)
        if not any(account.packets for account in accounts.values()):
            raise NothingRecorded(f"nobody published {args.stream} streams under {config.prefix}: nothing was recorded")
        told = as_json(accounts)
        writer.about(streams=json.dumps(told), began_unix_s=f"{began:.3f}", prefix=config.prefix)
    if args.json:
        print(json.dumps({"file": str(path), "bytes": path.stat().st_size, "streams": told}))
    else:
        print("\n".join(f"{name}: {_line(account)}" for name, account in told.items()))
        print(f"wrote {path}, {path.stat().st_size:,} bytes", file=sys.stderr)
    return BAD_NEWS if any(one["missing"] or one["dropped"] or one["refused"] for one in told.values()) else 0


def _line(account: dict[str, Any]) -> str:
    lost = [f"{account[name]:,} {name}" for name in ("missing", "dropped", "refused", "restarts") if account[name]]
    return ", ".join([f"{account['packets']:,} packets, {account['events']:,} events", *(lost or ["nothing lost"])])


@contextlib.contextmanager
def _shown(path: Path) -> Iterator[Callable[[Any], None] | None]:
    """A line that tells how the recording goes, on a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console

    from neurove_service.clients.recorder import as_json

    with Console(stderr=True).status(f"recording {path}: waiting for packets") as status:

        def show(accounts: Any) -> None:
            lines = [f"{name}: {_line(account)}" for name, account in as_json(accounts).items()]
            status.update(f"recording {path}" + "".join(f"\n  {line}" for line in lines))

        yield show


def _write_mcap(recording: Any, path: Path, progress: Progress) -> None:
    from neurove_core.io import write_mcap

    write_mcap(recording, path, progress=lambda events, _: progress(events))


def _write_dsec(recording: Any, path: Path, progress: Progress) -> None:
    from neurove_core.io import write_dsec

    try:
        write_dsec(recording, path, progress)
    except OSError as error:
        raise InvalidField("recording", "FILE", str(path), error.strerror or str(error)) from None


WRITERS: Final[dict[str, Callable[[Any, Path, Progress], None]]] = {".mcap": _write_mcap, ".h5": _write_dsec}
"""What writes a file of each suffix: (recording, path, progress)."""

_ENDLESS_S: Final = 5.0  # how much is surveyed of a source without end


def convert(args: argparse.Namespace) -> int:
    """Write a recording of any kind as ours (.mcap) or as HDF5 in DSEC's layout (.h5)."""
    from neurove_core.io import open_source

    path: Path = args.out
    if path.suffix not in WRITERS:
        raise InvalidField("convert", "OUT", str(path), f"its name must end in {' or '.join(WRITERS)}")
    recording = open_source(args.source, args.sensor, args.topic)
    if path.exists() and Path(args.source).exists() and path.samefile(args.source):
        raise InvalidField("convert", "OUT", str(path), "it is the recording that is read")
    return _written(recording, path, as_json=args.json)


def _written(recording: Any, path: Path, *, as_json: bool) -> int:
    counted = {"events": 0}
    with _bar(recording.name) as show:

        def progress(events: int) -> None:
            counted["events"] = events
            show(events)

        WRITERS[path.suffix](recording, path, progress)
    told = {"file": str(path), "bytes": path.stat().st_size, "events": counted["events"], "streams": recording.streams}
    if as_json:
        print(json.dumps(told))
    else:
        print(f"{path}: {told['events']:,} events of {recording.name}, {told['bytes']:,} bytes")
    return 0


def info(args: argparse.Namespace) -> int:
    """What a recording holds: sensor, counts, rates, inertial unit, truth; and how it looks."""
    from rich.console import Console

    from neurove_core.io import open_source, summary
    from neurove_service.cli.views import survey_table

    recording = open_source(args.source, args.sensor, args.topic)
    seconds = args.seconds if args.seconds is not None else (_ENDLESS_S if recording.endless else None)
    surveyed = summary.survey(recording, seconds)
    if args.plot:
        from neurove_core.io import summary_plot

        summary_plot.draw(surveyed, args.plot)
    told = surveyed.summary
    if args.json:
        print(json.dumps(told.as_json()))
    else:
        Console().print(survey_table(told))
    if args.plot:
        print(f"wrote {args.plot}", file=sys.stderr)
    if told.broken:
        print(f"neurove: {told.broken}", file=sys.stderr)
    return BAD_NEWS if told.broken else 0


def simulate(args: argparse.Namespace) -> int:
    """Write what a simulated event camera sees, with the exact truth of how it moves."""
    from neurove_core.io import open_source

    if args.scene == "carla":
        return _simulate_carla(args)
    path: Path = args.out
    if path.suffix not in WRITERS:
        raise InvalidField("simulate", "--out", str(path), f"its name must end in {' or '.join(WRITERS)}")
    query = {name: getattr(args, name) for name in ("trajectory", "camera", "height", "pitch", "seed", "seconds")}
    given = {name: value for name, value in query.items() if value is not None}
    recording = open_source(f"sim://{args.scene}?{urllib.parse.urlencode(given)}")
    return _written(recording, path, as_json=args.json)


def _simulate_carla(args: argparse.Namespace) -> int:
    """Record an event camera on a car of a running CARLA server, with its poses."""
    from neurove_core.io.formats.carla_server import record as record_carla

    host, _, port = args.server.rpartition(":")
    if not (host and port.isdecimal()):
        raise InvalidField("simulate carla", "--server", args.server, "HOST:PORT is expected, such as 127.0.0.1:2000")
    events = record_carla(args.out, args.seconds, host=host, port=int(port), seed=args.seed)
    told = {"file": str(args.out), "events": events}
    print(json.dumps(told) if args.json else f"{args.out}: {events:,} events")
    return 0


@contextlib.contextmanager
def _bar(name: str) -> Iterator[Progress]:
    """How far a conversion is, on a terminal; how long a recording is nobody knows before its end."""
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Bar(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task(name, total=None)

        def show(events: int) -> None:
            bar.update(task, description=f"{name}: {events:,} events")

        yield show


def add(commands: Any) -> None:
    """Add these commands to the parser."""
    parser = command(commands, "record", record)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="recording to write, ending in .mcap")
    parser.add_argument("--stream", default="all", metavar="S,...", help="names of streams; default all")
    parser.add_argument("--duration", type=seconds, default=math.inf, metavar="S", help="end after so many seconds")
    parser.add_argument("--with-parent", action="store_true", help="end when the process that started this one ends")
    add_client_flags(parser)
    parser = command(commands, "convert", convert)
    parser.add_argument("source", metavar="IN", help="a recording of any kind")
    parser.add_argument("out", type=Path, metavar="OUT", help="file to write, ending in .mcap (ours) or .h5 (DSEC)")
    parser.add_argument("--sensor", type=sensor_size, metavar="WxH", help="sensor size, where the recording lacks it")
    parser.add_argument("--topic", metavar="T", help="which of several event streams, where the recording has names")
    parser = command(commands, "info", info)
    parser.add_argument("source", metavar="SOURCE", help="a recording of any kind, or sim://")
    parser.add_argument("--sensor", type=sensor_size, metavar="WxH", help="sensor size, where the recording lacks it")
    parser.add_argument("--topic", metavar="T", help="which of several event streams, where the recording has names")
    parser.add_argument("--seconds", type=seconds, metavar="S", help="so much of it; default all, 5 of an endless one")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw events, rate and truth (.png or .svg)")
    _add_simulate(commands)


def _add_simulate(commands: Any) -> None:
    parser = command(commands, "simulate", simulate)
    parser.add_argument(
        "scene",
        metavar="SCENE",
        help="street, bare-street, corridor, room, plain-room, wall; or carla: of a CARLA server",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help=".mcap (ours), .h5 (DSEC); .npz of carla"
    )
    parser.add_argument("--seconds", type=seconds, default=10.0, metavar="S", help="default 10")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of scene, path and pixels; default 0")
    parser.add_argument(
        "--trajectory", metavar="T", help="driving, handheld, still, rotation?wy=1, a file of poses, ..."
    )
    parser.add_argument("--camera", metavar="C", help="davis346-half (default), davis346, davis240c, prophesee, ...")
    parser.add_argument("--height", metavar="M", help="of the camera above the ground [m]; default 1.5")
    parser.add_argument("--pitch", metavar="DEG", help="how far it looks down; default 5")
    parser.add_argument("--server", default="127.0.0.1:2000", metavar="HOST:PORT", help="CARLA's; this is the default")
