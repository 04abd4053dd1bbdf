"""neurove: every command. Parse, call one function, print for people or --json for machines.

Exit codes: 0 fine; 1 the answer is bad news (nobody serves, a stream loses packets, a recording is broken); 2 wrong
usage (an unknown source, setting or file).
"""

import argparse
import contextlib
import gc
import json
import math
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from protocol import Sensor, TwistEstimate
from protocol.codec import MessageT
from protocol.control import PeerError, StreamStatus
from protocol.errors import InvalidField, NeuroVEError
from service import logs
from service.config import ClientConfig, ServiceConfig, load
from service.lifecycle import stop_on_signals

BAD_NEWS, WRONG_USAGE = 1, 2

DEFAULT_SOURCE = "pattern://"
_DEFAULT_DEMO_S = 20.0

Command = Callable[[argparse.Namespace], int]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads starve a small machine
    args = _parser().parse_args(arguments)
    try:
        run: Command = args.run
        return run(args)
    except NeuroVEError as error:
        print(f"neurove: {error.message}", file=sys.stderr)
        return _exit_code(error)
    except KeyboardInterrupt:  # before a command took the signals over
        return 128 + signal.SIGINT
    except BrokenPipeError:  # the reader of our output has gone, such as `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _exit_code(error: NeuroVEError) -> int:
    bad_news = {"no_service", "broken_recording", "demo"}
    return BAD_NEWS if isinstance(error, PeerError) or error.code in bad_news else WRONG_USAGE


def serve(args: argparse.Namespace) -> int:
    """The service, until SIGINT or SIGTERM."""
    stop = stop_on_signals(with_parent=args.with_parent)
    config, _ = load(ServiceConfig, _flags(args, ServiceConfig), args.config)
    logs.configure(config.log_level)

    import torch  # late, for the clients' commands do without it

    from service.app import Service

    torch.set_num_threads(1)
    sys.setswitchinterval(0.0005)  # Zenoh's threads wait for ours: 5 ms, the default, is a packet's period
    Service(config, stop).run()
    gc.freeze()  # else Python collects all of torch once more on the way out: up to 2 s on a busy machine
    return 0


def drive(args: argparse.Namespace) -> int:
    """Publish a recording or a synthetic source as one stream."""
    from neurove_core.io import open_source
    from service.driver import Driver

    stop = stop_on_signals(with_parent=args.with_parent)
    config = _client(args)
    recording = open_source(args.source, args.sensor)
    from service import ask

    with ask.connect(config, patience_s=max(ask.CONNECT_S, args.wait), stop=stop) as transport:
        driver = Driver(recording, args.stream, transport, config.keys)
        if args.wait and not driver.wait_for_listener(args.wait, stop) and not stop.is_set():
            raise ask.NoService(f"no service took up stream {args.stream} within {args.wait:g} s")
        sent = driver.play(stop, speed=args.speed, loop=args.loop, duration_s=args.duration)
    broken = sent.broken.message if sent.broken else None
    if args.json:
        sensor = {"width": recording.sensor.width, "height": recording.sensor.height}
        print(json.dumps({"sensor": sensor, "packets": sent.packets, "events": sent.events, "broken": broken}))
    else:
        print(
            f"{args.stream}: {sent.packets:,} packets, {sent.events:,} events of {recording.name} ({recording.sensor})"
        )
    if broken:
        print(f"neurove: {broken}", file=sys.stderr)
    return BAD_NEWS if broken else 0


def watch(args: argparse.Namespace) -> int:
    """Live estimates of all streams."""
    from service import ask

    stop = stop_on_signals()
    config = _client(args)
    with ask.connect(config, stop=stop) as transport:
        ask.need_service(transport, config)
        return (
            _watch_lines(args, config, transport, stop)
            if args.json or not sys.stdout.isatty()
            else _watch_table(config, transport, stop)
        )


def _watch_lines(args: argparse.Namespace, config: ClientConfig, transport: Any, stop: threading.Event) -> int:
    import queue

    from service import ask

    estimates: queue.SimpleQueue[TwistEstimate] = queue.SimpleQueue()
    ask.listen(transport, config, estimates.put, _ignore_status)
    shown = 0
    while not stop.is_set() and shown < args.count:
        with contextlib.suppress(queue.Empty):
            estimate = estimates.get(timeout=0.2)
            print(estimate.model_dump_json() if args.json else _line(estimate), flush=True)
            shown += 1
    return 0


def _ignore_status(_: StreamStatus) -> None:
    """Lines show estimates only."""


def _line(estimate: TwistEstimate) -> str:
    numbers = " ".join(f"{name}={value:+.3f}" for name, value in estimate.twist._asdict().items())
    return (
        f"{estimate.stream} {estimate.end_us / 1e6:.3f} s {numbers} model={estimate.model} [{' '.join(estimate.flags)}]"
    )


def _watch_table(config: ClientConfig, transport: Any, stop: threading.Event) -> int:
    from rich.live import Live

    from service import ask
    from service.views import Board

    board = Board()
    ask.listen(transport, config, board.on_estimate, board.on_status)
    with Live(board, refresh_per_second=8):
        stop.wait()
    return 0


def health(args: argparse.Namespace) -> int:
    """How every node is."""
    from service import ask, views

    replies = _asked(args, ask.health, views.health_table)
    return 0 if all(reply.ok for reply in replies) else BAD_NEWS


def models(args: argparse.Namespace) -> int:
    """Which models every node has."""
    from service import ask, views

    _asked(args, ask.models, views.models_table)
    return 0


def _asked(
    args: argparse.Namespace,
    question: Callable[[Any, ClientConfig, str], list[MessageT]],
    table: Callable[[list[MessageT]], Any],
) -> list[MessageT]:
    """Every node's reply to a question, printed."""
    from service import ask

    config = _client(args)
    with ask.connect(config) as transport:
        replies = question(transport, config, args.node)
    if args.json:
        print(json.dumps([reply.model_dump() for reply in replies]))
    else:
        from rich.console import Console

        Console().print(table(replies))
    return replies


def activate(args: argparse.Namespace) -> int:
    """Change the model of a node while it runs."""
    from service import ask

    config = _client(args)
    with ask.connect(config) as transport:
        replies = ask.activate(transport, config, args.model, args.node)
    for reply in replies:
        if args.json:
            print(reply.model_dump_json())
        else:
            new, old = reply.active, reply.previous
            print(f"{reply.node}: {new.name} ({new.digest[:12]}) now serves, was {old.name} ({old.digest[:12]})")
    return 0


def demo(args: argparse.Namespace) -> int:
    """Driver, service and consumer on this machine, and what came of it."""
    from rich.console import Console

    from neurove_core.io import open_source
    from service import demo as demonstration

    stop = stop_on_signals()
    logs.configure("warning")
    endless = open_source(args.source, args.sensor).endless
    console = Console(stderr=args.json)
    duration_s = args.duration
    if duration_s is None:
        duration_s = _DEFAULT_DEMO_S if endless and not console.is_terminal else math.inf
    summary = demonstration.run(
        args.source,
        sensor=str(args.sensor) if args.sensor else None,
        speed=str(args.rate),
        loop=args.loop,
        duration_s=duration_s,
        model=args.model,
        stop=stop,
        console=console,
        screenshot=args.screenshot,
    )
    print(json.dumps(summary) if args.json else _told(summary))
    return BAD_NEWS if summary["broken"] else 0


def _told(summary: dict[str, Any]) -> str:
    sensor, numbers = summary["sensor"], summary["latency_ms"]
    if sensor is None:
        return "stopped before the driver began"
    lost = ", ".join(f"{name} {count}" for name, count in summary["lost"].items()) or "nothing"
    latency = f"p50 {numbers['p50']:.1f} ms, p99 {numbers['p99']:.1f} ms" if numbers else "no estimate"
    model = summary["model"] if summary["trained"] else f"{summary['model']}, UNTRAINED: the velocities mean nothing"
    lines = (
        f"source     {summary['source']} ({sensor['width']}x{sensor['height']})",
        f"packets    {summary['packets_received']:,} of {summary['packets_sent']:,}",
        f"events     {summary['events_received']:,} of {summary['events_sent']:,}",
        f"estimates  {summary['estimates']:,} of {summary['windows']:,} windows, {summary['rate_hz']:.1f} per second",
        f"latency    {latency}",
        f"lost       {lost}",
        f"model      {model}",
        *([f"broken     {summary['broken']}"] if summary["broken"] else []),
    )
    return "\n".join(lines)


def show_config(args: argparse.Namespace) -> int:
    """The service's settings as they would be used."""
    config, origin = load(ServiceConfig, _flags(args, ServiceConfig), args.config)
    values = config.model_dump(mode="json")
    if args.json:
        print(json.dumps({name: {"value": value, "origin": origin[name]} for name, value in values.items()}))
        return 0
    for name, value in values.items():
        about = f"  # {origin[name]}" if args.origin else ""
        print(f"{'# ' if value is None else ''}{name} = {json.dumps(value)}{about}")
    return 0


def new_model(args: argparse.Namespace) -> int:
    """Write a bundle with random weights, to try a change of model with."""
    from neurove_core import bundle

    path: Path = args.file
    if path.suffix != bundle.SUFFIX:
        raise InvalidField("model new", "FILE", str(path), f"its name must end in {bundle.SUFFIX}")
    made = bundle.untrained(args.seed, name=path.stem)
    try:
        bundle.save(made, path)
    except OSError as error:
        raise InvalidField("model new", "FILE", str(path), error.strerror or str(error)) from None
    print(f"{path}: {made.name}, {made.digest[:12]}, untrained")
    return 0


def inspect_model(args: argparse.Namespace) -> int:
    """What a bundle's file holds."""
    from neurove_core import bundle

    found = bundle.load(args.file)
    about = found.info.model_dump() | {"config": found.config.model_dump(mode="json")}
    print(json.dumps(about, indent=None if args.json else 2))
    return 0


def reproduce_firing(args: argparse.Namespace) -> int:
    """How often ALIF, LIF and LTC fire under one random current."""
    from neurove_core.experiments import firing

    report = firing.run(args.seed)
    files = firing.save(report, args.out) if args.out else []
    print(firing.to_json(report) if args.json else firing.to_markdown(report), end="")
    for file in files:
        print(f"wrote {file}", file=sys.stderr)
    return 0


def reproduce_sine(args: argparse.Namespace) -> int:
    """Tables I and II: regression and forecast of a sine by ASLSTM, ASLSTM-w/o, SLSTM and LTC."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from neurove_core.experiments import sine_report

    models, seeds = args.models.split(","), range(args.seed, args.seed + args.seeds)
    command, commit = shlex.join(["neurove", *sys.argv[1:]]), _commit()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        tasks: dict[tuple[str, int], Any] = {}

        def progress(model: str, seed: int, update: int, updates: int, mse: float) -> None:
            if (model, seed) not in tasks:
                tasks[model, seed] = bar.add_task("", total=updates)
            rmse = f"{model} seed {seed}: update {update}, RMSE {mse**0.5:.2e}"
            bar.update(tasks[model, seed], completed=update, description=rmse)

        runs: list[sine_report.Run] = []
        files: dict[Path, None] = {}
        for run in sine_report.reproduce(models, seeds, quick=args.quick, progress=progress):
            runs.append(run)
            if args.out:
                files |= dict.fromkeys(sine_report.save_run(runs, args.out, command=command, commit=commit))
    if args.out:
        files |= dict.fromkeys(sine_report.save(runs, args.out))
    figures = [run.figures for run in runs]
    tables = sine_report.tables(figures)
    print(json.dumps(figures) if args.json else "\n".join(sine_report.markdown(tables[n], n) for n in tables))
    for file in files:
        print(f"wrote {file}", file=sys.stderr)
    return 0


def _commit() -> str:
    """The commit of the code that runs, with a + where it was changed since; or the version of the package."""
    import importlib.metadata
    import subprocess

    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return importlib.metadata.version("neurove")


def _client(args: argparse.Namespace) -> ClientConfig:
    config, _ = load(ClientConfig, _flags(args, ClientConfig))
    logs.configure(config.log_level if "NEUROVE_LOG_LEVEL" in os.environ else "warning")
    return config


def _flags(args: argparse.Namespace, kind: type[ServiceConfig] | type[ClientConfig]) -> dict[str, Any]:
    return {name: getattr(args, name, None) for name in kind.model_fields}


def _sensor(text: str) -> Sensor:
    width, _, height = text.partition("x")
    try:
        return Sensor(int(width), int(height))
    except (ValueError, NeuroVEError):
        raise argparse.ArgumentTypeError(f"{text!r}: give WIDTHxHEIGHT in pixels, such as 640x480") from None


def _speed(text: str) -> float:
    try:
        speed = math.inf if text in ("max", "inf") else float(text)
    except ValueError:
        speed = math.nan
    if not speed > 0:
        raise argparse.ArgumentTypeError(f"{text!r}: give a factor above 0, such as 1.0, or max")
    return speed


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not seconds > 0:
        raise argparse.ArgumentTypeError(f"{text!r}: give seconds above 0")
    return seconds


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="neurove",
        description="Ego-velocity from event cameras, as a service on Zenoh.",
        epilog="Settings come from defaults, then --config FILE (TOML), then NEUROVE_* variables, then flags.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_demo(commands)
    _add_serve(commands)
    _add_drive(commands)
    _add_clients(commands)
    _add_config(commands)
    _add_model(commands)
    _add_reproduce(commands)
    return parser


def _command(commands: Any, name: str, run: Command, *, as_json: bool = True) -> argparse.ArgumentParser:
    about = (run.__doc__ or "").splitlines()[0]
    parser: argparse.ArgumentParser = commands.add_parser(name, help=about, description=about)
    parser.set_defaults(run=run)
    if as_json:
        parser.add_argument("--json", action="store_true", help="for machines")
    return parser


def _add_source(parser: argparse.ArgumentParser, **source: Any) -> None:
    parser.add_argument("source", metavar="SOURCE", help="a recording, or pattern:// (the built-in pattern)", **source)
    parser.add_argument("--sensor", type=_sensor, metavar="WxH", help="sensor size, where the recording lacks it")
    parser.add_argument("--loop", action="store_true", help="begin again at the end")


def _add_demo(commands: Any) -> None:
    parser = _command(commands, "demo", demo)
    _add_source(parser, nargs="?", default=DEFAULT_SOURCE)
    parser.add_argument("--duration", type=_seconds, metavar="S", help="seconds of the source to play")
    parser.add_argument("--rate", type=_speed, default=1.0, metavar="R", help="sensor seconds per second, or max")
    parser.add_argument("--model", metavar="FILE", help="bundle to serve")
    parser.add_argument("--screenshot", metavar="FILE", help="write the last table as SVG")


def _add_serve(commands: Any) -> None:
    parser = _command(commands, "serve", serve, as_json=False)
    _add_service_flags(parser)
    parser.add_argument("--with-parent", action="store_true", help="end when the process that started this one ends")


def _add_service_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings as TOML")
    for name, field in ServiceConfig.model_fields.items():
        flag = "--" + name.replace("_", "-")
        parser.add_argument(flag, metavar=name.upper(), help=f"{field.description} Default: {field.default}")


def _add_drive(commands: Any) -> None:
    parser = _command(commands, "drive", drive)
    _add_source(parser)
    _add_client_flags(parser)
    parser.add_argument("--stream", default="cam0", help="name of the stream, one key chunk; default cam0")
    parser.add_argument("--speed", type=_speed, default=1.0, help="sensor seconds per second, or max; default 1.0")
    parser.add_argument(
        "--duration", type=_seconds, default=math.inf, metavar="S", help="seconds of the source to play"
    )
    parser.add_argument("--wait", type=_seconds, default=0.0, metavar="S", help="wait so long for a service to listen")
    parser.add_argument("--with-parent", action="store_true", help="end when the process that started this one ends")


def _add_client_flags(parser: argparse.ArgumentParser) -> None:
    for name in ("connect", "prefix", "zenoh_config"):
        field = ClientConfig.model_fields[name]
        parser.add_argument("--" + name.replace("_", "-"), metavar=name.upper(), help=field.description)


def _add_clients(commands: Any) -> None:
    parser = _command(commands, "watch", watch)
    _add_client_flags(parser)
    parser.add_argument("--count", type=int, default=sys.maxsize, metavar="N", help="end after so many lines")
    for name, run in (("health", health), ("models", models), ("activate", activate)):
        parser = _command(commands, name, run)
        _add_client_flags(parser)
        parser.add_argument("--node", default="*", help="one node; default all")
        if run is activate:
            parser.add_argument("model", metavar="MODEL", help="its name, or the first 8 digits of its digest")


def _add_config(commands: Any) -> None:
    parser = commands.add_parser("config", help="The service's settings.").add_subparsers(required=True)
    show = _command(parser, "show", show_config)
    show.add_argument("--origin", action="store_true", help="where each value came from")
    _add_service_flags(show)


def _add_model(commands: Any) -> None:
    parser = commands.add_parser("model", help="Model bundles.").add_subparsers(required=True)
    new = _command(parser, "new", new_model, as_json=False)
    new.add_argument("file", type=Path, metavar="FILE", help="bundle to write, ending in .safetensors")
    new.add_argument("--seed", type=int, default=0, help="of the weights")
    inspect = _command(parser, "inspect", inspect_model)
    inspect.add_argument("file", type=Path, metavar="FILE", help="bundle to read")


def _add_reproduce(commands: Any) -> None:
    parser = commands.add_parser("reproduce", help="The paper's experiments.").add_subparsers(required=True)
    firing = _command(parser, "firing", reproduce_firing)
    firing.add_argument("--seed", type=int, default=0, help="of the first of ten runs; default 0")
    firing.add_argument("--out", type=Path, metavar="DIR", help="write table and figure (PNG, SVG) into this folder")
    sine = _command(parser, "sine", reproduce_sine)
    sine.add_argument("--models", default="aslstm,aslstm-spiking,aslstm-wo,slstm,ltc", help="which, joined by commas")
    sine.add_argument("--seed", type=int, default=0, help="the first seed; default 0")
    sine.add_argument("--seeds", type=int, default=1, metavar="N", help="so many seeds, one after the other; default 1")
    sine.add_argument("--quick", action="store_true", help="a few updates, to see that it runs: figures mean nothing")
    sine.add_argument("--out", type=Path, metavar="DIR", help="write figures, tables, pictures and networks there")


if __name__ == "__main__":
    sys.exit(main())
