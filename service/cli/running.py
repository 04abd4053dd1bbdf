"""The commands that run something: demo, serve, drive; and config, which shows the settings of serve."""

import argparse
import contextlib
import gc
import json
import math
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from neurove_protocol.errors import EXIT_FAILURE, InvalidField
from neurove_service import logs
from neurove_service.cli.arguments import (
    add_axes_flag,
    add_client_flags,
    add_force,
    add_lens_flags,
    add_playback_flags,
    add_refine_flag,
    add_service_flags,
    add_source,
    client_config,
    command,
    flags,
    refuse_existing,
    stream_name,
    subcommand,
    tell_faults,
)
from neurove_service.cli.extras import one_thread
from neurove_service.cli.parser import Parser
from neurove_service.cli.waiting import Wait, add_wait
from neurove_service.config import ClientConfig, ServiceConfig, load
from neurove_service.lifecycle import stop_on_signals
from neurove_service.limits import check_limits

DEFAULT_SOURCE = "sim://"
_DEFAULT_DEMO_S = 20.0
_STREAM = "cam0"
_AT_ONCE_S = 1.0  # a service that runs subscribes to a new session within this time


def serve(args: argparse.Namespace) -> int:
    """Run the service until SIGINT or SIGTERM; SIGHUP reloads the log level and lists the models again."""
    reloads: list[Callable[[], None]] = []  # filled as soon as there is something to reload
    stop = stop_on_signals(with_parent=args.with_parent, on_hangup=lambda: [reload() for reload in reloads])

    def read() -> ServiceConfig:
        return load(ServiceConfig, flags(args, ServiceConfig), args.config)[0]

    logs.configure()  # what the settings say while they are read
    config = read()
    logs.configure(config.log_level)
    check_limits()
    one_thread()

    from neurove_service.node import memory
    from neurove_service.node.app import Service
    from neurove_service.node.reload import Reload

    sys.setswitchinterval(0.0005)  # Zenoh's threads wait for ours: the default of 5 ms is a packet's period
    service = Service(config, stop)
    reloads.append(Reload(config, read, service.available))
    memory.release_memory()
    gc.freeze()  # the collector would traverse all libraries at each run, with all threads stopped
    service.run()
    gc.freeze()  # again before the exit, which otherwise takes up to 2 s on a busy machine
    return 0


def drive(args: argparse.Namespace) -> int:
    """Publish a recording, a synthetic source, a camera or a network stream as one stream; see deploy/cameras.md."""
    from neurove_core.io.axes import with_axes
    from neurove_core.io.calibration import lens_of
    from neurove_core.sources import is_live, open_source

    stop = stop_on_signals(with_parent=args.with_parent)
    if is_live(args.source):
        return _drive_live(args, stop)
    config = client_config(args)
    recording = with_axes(open_source(args.source, args.sensor, args.topic, args.time_unit), args.imu_axes)
    lens = lens_of(recording, args.calibration, args.height)
    replayed = _replayed(args, recording)
    with _connected(args, config, stop, lambda to, keys: _player(args, recording, replayed, lens, to, keys)) as player:
        duration_s = math.inf if args.seconds is None else args.seconds
        how = {"speed": args.speed, "loop": args.loop, "duration_s": duration_s}
        sent = player.play(stop, **how, **({} if args.json else {"on_behind": _tell_behind}))
    return _report(args, player.label, recording, sent)


def _drive_live(args: argparse.Namespace, stop: threading.Event) -> int:
    """Publish a camera or a network stream, as its events come."""
    from neurove_core.io.axes import rotation_of
    from neurove_core.io.calibration import lens_of
    from neurove_core.sources import open_live
    from neurove_service.clients.live_driver import LiveDriver

    for flag, value, usual, why in (
        ("--speed", args.speed, 1.0, "a live source has its own pace"),
        ("--loop", args.loop, False, "a live source cannot be played again"),
        ("--topic", args.topic, None, "a live source has one event stream"),
        ("--time-unit", args.time_unit, None, "the times of a live source are in us"),
    ):
        if value != usual:
            raise InvalidField("drive", flag, value, why)
    config = client_config(args)
    source = open_live(args.source, args.sensor)
    with contextlib.closing(source):
        lens = lens_of(source, args.calibration, args.height)
        rotation = rotation_of(args.imu_axes, source.name, source.streams)
        stream = args.stream or _STREAM
        with _connected(
            args, config, stop, lambda to, keys: LiveDriver(source, stream, to, keys, lens, rotation)
        ) as driver:
            if not args.json:
                print(f"neurove: driving {source.name} ({source.sensor}) as {stream}", file=sys.stderr, flush=True)
            sent = driver.play(stop, duration_s=math.inf if args.seconds is None else args.seconds)
    return _report(args, driver.label, source, sent)


@contextlib.contextmanager
def _connected(
    args: argparse.Namespace, config: ClientConfig, stop: threading.Event, make: Callable[..., Any]
) -> Iterator[Any]:
    """A driver with a session, after a service has subscribed to its stream.

    Args:
        args: of the command.
        config: where the service is.
        stop: ends the wait.
        make: the driver, from a session and the keys.
    """
    from neurove_service.clients import ask

    wait = Wait(config, args.wait, stop)
    with wait.connect(config) as transport:
        driver = make(transport, config.keys)
        if args.wait and not _listened_to(driver, wait, stop):
            hint = "; if one runs, does it accept this certificate?" if config.zenoh_config else ""
            raise ask.NoService(f"no service subscribed to stream {driver.label} within {args.wait:g} s{hint}")
        yield driver


def _report(args: argparse.Namespace, label: str, source: Any, sent: Any) -> int:
    """Print what was published and what was lost; the exit code."""
    from neurove_service.clients.pace import BEHIND_S

    faults = source.faults
    broken = sent.broken.message if sent.broken else next(map(str, faults.unread), None)
    if args.json:
        sensor = {"width": source.sensor.width, "height": source.sensor.height}
        found = [fault.as_json() for fault in faults.found]
        played = {
            "packets": sent.packets,
            "events": sent.events,
            "samples": sent.samples,
            "gaps": sent.gaps,
            "broken": broken,
            "faults": found,
        }
        print(json.dumps({"sensor": sensor, **played, "behind_s": round(sent.behind_s, 3)}))
    else:
        about = f"{source.name} ({source.sensor})"
        late = f", up to {sent.behind_s:.1f} s behind real time" if sent.behind_s > BEHIND_S else ""
        inertial = f" and {sent.samples:,} IMU samples" if sent.samples else ""
        lost = f", {sent.gaps:,} gap{'s' if sent.gaps > 1 else ''} where events were lost" if sent.gaps else ""
        print(f"{label}: {sent.packets:,} packets, {sent.events:,} events{inertial} of {about}{late}{lost}")
    if sent.broken:
        print(f"neurove: {broken}", file=sys.stderr)
    tell_faults(source)
    return EXIT_FAILURE if broken else 0


def _tell_behind(behind_s: float, elapsed_s: float) -> None:
    """Print to stderr that the source is slower than real time."""
    where = f"{behind_s:.1f} s behind after {elapsed_s:.1f} s of the source"
    cure = "its events arrive late; a smaller --speed, or a recording of the source, keeps up"
    print(f"neurove: cannot keep up with real time: {where}; {cure}", file=sys.stderr, flush=True)


def _listened_to(player: Any, wait: Wait, stop: threading.Event) -> bool:
    """Wait for a service that subscribes; return whether one did, or the user ended the wait."""
    if player.wait_for_listener(min(_AT_ONCE_S, wait.left_s), stop):
        return True
    if not stop.is_set():
        wait.say()
    return player.wait_for_listener(wait.left_s, stop) or stop.is_set()


def _replayed(args: argparse.Namespace, recording: Any) -> bool:
    """Whether the packets of a packet log are sent as they were published; its other flags must fit.

    Raises:
        InvalidField: a flag cannot be used with a replay.
    """
    from neurove_core.io.formats.packet_log.reader import McapRecording

    if (
        not isinstance(recording, McapRecording) or args.stream
    ):  # the name is in every packet, so another name means new packets
        return False
    if args.loop:
        why = "a replay would repeat sequence numbers and times; give --stream NAME to encode the events again"
        raise InvalidField("drive", "--loop", True, why)
    if _gives_lens(args) and not args.topic and len(recording.all_streams) > 1:
        why = f"this packet log has the streams {', '.join(recording.all_streams)}: choose one with --topic"
        raise InvalidField("drive", "--calibration, --height", args.calibration or args.height, why)
    return True


def _gives_lens(args: argparse.Namespace) -> bool:
    return args.calibration is not None or args.height is not None


def _player(args: argparse.Namespace, recording: Any, replayed: bool, lens: Any, transport: Any, keys: Any) -> Any:
    """A replay for a packet log, a driver for any other recording; both have the same methods."""
    from neurove_service.clients.driver import Driver
    from neurove_service.clients.replay import Replay

    if not replayed:
        return Driver(recording, args.stream or _STREAM, transport, keys, lens)
    stream = recording.stream if args.topic else None
    return Replay(recording, stream, transport, keys, lens if _gives_lens(args) else None)


def demo(args: argparse.Namespace) -> int:
    """Run driver, service and consumer on any source, then print a summary."""
    from neurove_core.io.calibration import with_lens
    from neurove_core.sim.truth import truth_of
    from neurove_core.sources import is_live, open_source
    from neurove_service.cli.console import console
    from neurove_service.cli.demo import run

    stop = stop_on_signals()
    logs.configure("warning")
    # the driver opens a live source: a camera can be opened once
    opened = None if is_live(args.source) else open_source(args.source, args.sensor, args.topic, args.time_unit)
    endless = opened is None or with_lens(opened, args.calibration, args.height).endless
    if args.screenshot:
        refuse_existing("demo", "--screenshot", args.screenshot, args.source, force=args.force)
    shown = console(stderr=args.json)
    duration_s = args.seconds
    if duration_s is None:
        duration_s = _DEFAULT_DEMO_S if endless and not shown.is_terminal else math.inf
    summary = run(
        args.source,
        playing=_playing(args, duration_s),
        serving=["--refine", args.refine, *(["--model", args.model] if args.model else [])],
        stop=stop,
        console=shown,
        screenshot=args.screenshot,
        truth=None
        if args.loop or opened is None
        else truth_of(opened),  # a repeated source has other times than its truth
        page=["--open"] * args.open if args.page or args.open else None,
    )
    print(json.dumps(summary) if args.json else _summary_text(summary))
    return EXIT_FAILURE if summary["broken"] else 0


def _playing(args: argparse.Namespace, duration_s: float) -> list[str]:
    """The flags of `neurove drive` for the source of a demo."""
    given = {
        "--sensor": args.sensor,
        "--topic": args.topic,
        "--time-unit": args.time_unit,
        "--calibration": args.calibration,
        "--height": args.height,
        "--speed": "max" if math.isinf(args.speed) else args.speed,
        "--seconds": duration_s if math.isfinite(duration_s) else None,
    }
    words = [word for flag, value in given.items() if value is not None for word in (flag, str(value))]
    return [*words, "--loop"] if args.loop else words


def _summary_text(summary: dict[str, Any]) -> str:
    from neurove_service.clients.pace import BEHIND_S

    sensor, numbers = summary["sensor"], summary["latency_ms"]
    if sensor is None:
        return "stopped before the driver had started"
    lost = ", ".join(f"{name} {count}" for name, count in summary["lost"].items()) or "nothing"
    latency = f"p50 {numbers['p50']:.1f} ms, p99 {numbers['p99']:.1f} ms" if numbers else "no estimate"
    error = summary["error"]
    off = error and f"{error['linear_m_s']:.2f} m/s, {math.degrees(error['angular_rad_s']):.1f} deg/s against the truth"
    slow = f"the source was up to {summary['behind_s']:.1f} s behind real time: this machine cannot play it live"
    model = summary["model"] if summary["trained"] else f"{summary['model']}, UNTRAINED: the estimates have no meaning"
    lines = (
        f"source     {summary['source']} ({sensor['width']}x{sensor['height']})",
        f"packets    {summary['packets_received']:,} of {summary['packets_sent']:,}",
        f"events     {summary['events_received']:,} of {summary['events_sent']:,}",
        f"estimates  {summary['estimates']:,} of {summary['windows']:,} windows, {summary['rate_hz']:.1f} per second",
        f"latency    {latency}",
        f"lost       {lost}",
        *([f"error      {off} (RMS)"] if off else []),
        *([f"slow       {slow}"] if summary["behind_s"] > BEHIND_S else []),
        f"model      {model}",
        *([f"broken     {summary['broken']}"] if summary["broken"] else []),
    )
    return "\n".join(lines)


def show_config(args: argparse.Namespace) -> int:
    """Print the settings that `neurove serve` would use, as TOML."""
    logs.configure("warning")
    config, origin = load(ServiceConfig, flags(args, ServiceConfig), args.config)
    values = config.model_dump(mode="json")
    if args.json:
        print(json.dumps({name: {"value": value, "origin": origin[name]} for name, value in values.items()}))
        return 0
    for name, value in values.items():
        comment = f"  # {origin[name]}" if args.origin else ""
        print(f"{'# ' if value is None else ''}{name} = {_toml(value)}{comment}")
    return 0


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(name)} = {json.dumps(text)}" for name, text in value.items()) + "}"
    return json.dumps(value)


def add_demo(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove demo`."""
    add_source(command(parser, demo), nargs="?", default=DEFAULT_SOURCE)
    add_lens_flags(parser)
    most = f"{_DEFAULT_DEMO_S:.0f} s of an endless source that no terminal shows"
    add_playback_flags(parser, f"seconds of the source to play; default: until its end or Ctrl-C, {most}")
    add_refine_flag(parser)
    about = "bundle to serve, or the name of a built-in model; default `default`"
    parser.add_argument("--model", metavar="BUNDLE", help=about)
    parser.add_argument("--screenshot", type=Path, metavar="FILE", help="write the last live table as SVG")
    add_force(parser, "FILE")
    parser.add_argument("--page", action="store_true", help="show a live page for browsers too; needs the extra page")
    parser.add_argument("--open", action="store_true", help="open that page in the browser of this machine")


def add_serve(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove serve`."""
    add_service_flags(command(parser, serve, as_json=False))
    _add_with_parent(parser)


def add_drive(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove drive`."""
    add_source(command(parser, drive))
    add_lens_flags(parser)
    add_axes_flag(parser)
    add_client_flags(parser)
    about = f"name of the stream, one key chunk; default {_STREAM}, and for a packet log the names in it"
    parser.add_argument("--stream", type=stream_name, metavar="NAME", help=about)
    add_playback_flags(parser, "seconds of the source to play; default: until its end")
    add_wait(parser)
    _add_with_parent(parser)


def _add_with_parent(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--with-parent", action="store_true", help="end when the parent process ends")


def add_config(parser: Parser) -> None:
    """Add the commands of `neurove config`."""
    show = subcommand(parser.add_commands(), "show", show_config)
    show.add_argument("--origin", action="store_true", help="add where each value comes from")
    add_service_flags(show)
