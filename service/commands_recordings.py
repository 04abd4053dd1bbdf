"""The commands of recordings: record, convert."""

import argparse
import contextlib
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from protocol.errors import InvalidField, NeuroVEError
from protocol.keys import check_name
from service.arguments import BAD_NEWS, add_client_flags, client_config, command, seconds, sensor_size
from service.lifecycle import stop_on_signals

Progress = Callable[[int], None]
"""Events so far."""


class NothingRecorded(NeuroVEError):
    """No packet came while we listened."""

    code = "nothing_recorded"


def record(args: argparse.Namespace) -> int:
    """Write what drivers publish into a file, until Ctrl-C."""
    from neurove_core.io import PacketWriter
    from service import ask
    from service.recorder import Recorder, as_json

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

    from service.recorder import as_json

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


def convert(args: argparse.Namespace) -> int:
    """Write a recording of any kind as ours (.mcap) or as HDF5 in DSEC's layout (.h5)."""
    from neurove_core.io import open_source

    path: Path = args.out
    if path.suffix not in WRITERS:
        raise InvalidField("convert", "OUT", str(path), f"its name must end in {' or '.join(WRITERS)}")
    recording = open_source(args.source, args.sensor, args.topic)
    if path.exists() and Path(args.source).exists() and path.samefile(args.source):
        raise InvalidField("convert", "OUT", str(path), "it is the recording that is read")
    counted = {"events": 0}
    with _bar(recording.name) as show:

        def progress(events: int) -> None:
            counted["events"] = events
            show(events)

        WRITERS[path.suffix](recording, path, progress)
    told = {"file": str(path), "bytes": path.stat().st_size, "events": counted["events"], "streams": recording.streams}
    if args.json:
        print(json.dumps(told))
    else:
        print(f"{path}: {told['events']:,} events of {recording.name}, {told['bytes']:,} bytes")
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
