"""The commands that run something: serve, drive, demo; and config, which shows what serve would use."""

import argparse
import gc
import json
import math
import sys
from typing import Any

from neurove_protocol.errors import InvalidField
from neurove_service import logs
from neurove_service.cli.arguments import (
    BAD_NEWS,
    add_client_flags,
    add_service_flags,
    add_source,
    client_config,
    command,
    flags,
    seconds,
    speed,
)
from neurove_service.config import ServiceConfig, load
from neurove_service.lifecycle import stop_on_signals

DEFAULT_SOURCE = "sim://"
_DEFAULT_DEMO_S = 20.0
_STREAM = "cam0"


def serve(args: argparse.Namespace) -> int:
    """The service, until SIGINT or SIGTERM."""
    stop = stop_on_signals(with_parent=args.with_parent)
    config, _ = load(ServiceConfig, flags(args, ServiceConfig), args.config)
    logs.configure(config.log_level)

    import torch  # late, for the clients' commands do without it

    from neurove_service.node.app import Service

    torch.set_num_threads(1)
    sys.setswitchinterval(0.0005)  # Zenoh's threads wait for ours: 5 ms, the default, is a packet's period
    service = Service(config, stop)
    gc.collect()
    gc.freeze()  # what is here stays: Python would look through all of torch again and again, with all threads stopped
    service.run()
    gc.freeze()  # and once more on the way out: up to 2 s on a busy machine
    return 0


def drive(args: argparse.Namespace) -> int:
    """Publish a recording or a synthetic source as one stream; a recording of ours as it was published."""
    from neurove_core.io import open_source

    stop = stop_on_signals(with_parent=args.with_parent)
    config = client_config(args)
    recording = open_source(args.source, args.sensor, args.topic)
    from neurove_service.clients import ask

    with ask.connect(config, patience_s=max(ask.CONNECT_S, args.wait), stop=stop) as transport:
        player = _player(args, recording, transport, config.keys)
        if args.wait and not player.wait_for_listener(args.wait, stop) and not stop.is_set():
            may = "; if one runs, may this certificate feed it?" if config.zenoh_config else ""
            raise ask.NoService(f"no service took up stream {player.label} within {args.wait:g} s{may}")
        sent = player.play(stop, speed=args.speed, loop=args.loop, duration_s=args.duration)
    broken = sent.broken.message if sent.broken else None
    if args.json:
        sensor = {"width": recording.sensor.width, "height": recording.sensor.height}
        print(json.dumps({"sensor": sensor, "packets": sent.packets, "events": sent.events, "broken": broken}))
    else:
        about = f"{recording.name} ({recording.sensor})"
        print(f"{player.label}: {sent.packets:,} packets, {sent.events:,} events of {about}")
    if broken:
        print(f"neurove: {broken}", file=sys.stderr)
    return BAD_NEWS if broken else 0


def _player(args: argparse.Namespace, recording: Any, transport: Any, keys: Any) -> Any:
    """A replay of packets for a recording of ours, a driver for every other; both are used alike."""
    from neurove_core.io import McapRecording
    from neurove_service.clients.driver import Driver
    from neurove_service.clients.replay import Replay

    if not isinstance(recording, McapRecording) or args.stream:  # another name stands in every packet: encoded anew
        return Driver(recording, args.stream or _STREAM, transport, keys)
    if args.loop:
        why = "what was recorded would repeat its numbers and times; give --stream NAME to encode it anew"
        raise InvalidField("drive", "--loop", True, why)
    return Replay(recording, recording.stream if args.topic else None, transport, keys)


def demo(args: argparse.Namespace) -> int:
    """Driver, service and consumer on this machine, and what came of it."""
    from rich.console import Console

    from neurove_core.io import open_source
    from neurove_service.cli import demo as demonstration

    stop = stop_on_signals()
    logs.configure("warning")
    endless = open_source(args.source, args.sensor, args.topic).endless
    console = Console(stderr=args.json)
    duration_s = args.duration
    if duration_s is None:
        duration_s = _DEFAULT_DEMO_S if endless and not console.is_terminal else math.inf
    summary = demonstration.run(
        args.source,
        sensor=str(args.sensor) if args.sensor else None,
        topic=args.topic,
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
    config, origin = load(ServiceConfig, flags(args, ServiceConfig), args.config)
    values = config.model_dump(mode="json")
    if args.json:
        print(json.dumps({name: {"value": value, "origin": origin[name]} for name, value in values.items()}))
        return 0
    for name, value in values.items():
        about = f"  # {origin[name]}" if args.origin else ""
        print(f"{'# ' if value is None else ''}{name} = {json.dumps(value)}{about}")
    return 0


def add(commands: Any) -> None:
    """Add these commands to the parser."""
    _add_demo(commands)
    _add_serve(commands)
    _add_drive(commands)
    _add_config(commands)


def _add_demo(commands: Any) -> None:
    parser = command(commands, "demo", demo)
    add_source(parser, nargs="?", default=DEFAULT_SOURCE)
    parser.add_argument("--duration", type=seconds, metavar="S", help="seconds of the source to play")
    parser.add_argument("--rate", type=speed, default=1.0, metavar="R", help="sensor seconds per second, or max")
    parser.add_argument(
        "--model", metavar="FILE", help="bundle to serve, or the name of a built-in model; default `default`"
    )
    parser.add_argument("--screenshot", metavar="FILE", help="write the last table as SVG")


def _add_serve(commands: Any) -> None:
    parser = command(commands, "serve", serve, as_json=False)
    add_service_flags(parser)
    parser.add_argument("--with-parent", action="store_true", help="end when the process that started this one ends")


def _add_drive(commands: Any) -> None:
    parser = command(commands, "drive", drive)
    add_source(parser)
    add_client_flags(parser)
    parser.add_argument(
        "--stream", metavar="S", help=f"name of the stream, one key chunk; default {_STREAM}, or as it was recorded"
    )
    parser.add_argument("--speed", type=speed, default=1.0, help="sensor seconds per second, or max; default 1.0")
    parser.add_argument("--duration", type=seconds, default=math.inf, metavar="S", help="seconds of the source to play")
    parser.add_argument("--wait", type=seconds, default=0.0, metavar="S", help="wait so long for a service to listen")
    parser.add_argument("--with-parent", action="store_true", help="end when the process that started this one ends")


def _add_config(commands: Any) -> None:
    parser = commands.add_parser("config", help="The service's settings.").add_subparsers(required=True)
    show = command(parser, "show", show_config)
    show.add_argument("--origin", action="store_true", help="where each value came from")
    add_service_flags(show)
