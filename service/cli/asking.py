"""The commands that ask a running service: watch, health, models."""

import argparse
import contextlib
import json
import sys
import threading
from collections.abc import Callable
from typing import Any

from neurove_protocol import TwistEstimate
from neurove_protocol.codec import MessageT
from neurove_protocol.control import StreamStatus
from neurove_service.cli.arguments import BAD_NEWS, add_client_flags, client_config, command
from neurove_service.config import ClientConfig
from neurove_service.lifecycle import stop_on_signals


def watch(args: argparse.Namespace) -> int:
    """Live estimates of all streams."""
    from neurove_service.clients import ask

    stop = stop_on_signals()
    config = client_config(args)
    with ask.connect(config, stop=stop) as transport:
        ask.need_service(transport, config)
        return (
            _watch_lines(args, config, transport, stop)
            if args.json or not sys.stdout.isatty()
            else _watch_table(config, transport, stop)
        )


def _watch_lines(args: argparse.Namespace, config: ClientConfig, transport: Any, stop: threading.Event) -> int:
    import queue

    from neurove_service.clients import ask

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

    from neurove_service.cli.views import Board
    from neurove_service.clients import ask

    board = Board()
    ask.listen(transport, config, board.on_estimate, board.on_status)
    with Live(board, refresh_per_second=8):
        stop.wait()
    return 0


def health(args: argparse.Namespace) -> int:
    """How every node is."""
    from neurove_service.cli import views
    from neurove_service.clients import ask

    replies = _asked(args, ask.health, views.health_table)
    return 0 if all(reply.ok for reply in replies) else BAD_NEWS


def models(args: argparse.Namespace) -> int:
    """Which models every node has."""
    from neurove_service.cli import views
    from neurove_service.clients import ask

    _asked(args, ask.models, views.models_table)
    return 0


def _asked(
    args: argparse.Namespace,
    question: Callable[[Any, ClientConfig, str], list[MessageT]],
    table: Callable[[list[MessageT]], Any],
) -> list[MessageT]:
    """Every node's reply to a question, printed."""
    from neurove_service.clients import ask

    config = client_config(args)
    with ask.connect(config) as transport:
        replies = question(transport, config, args.node)
    if args.json:
        print(json.dumps([reply.model_dump() for reply in replies]))
    else:
        from rich.console import Console

        Console().print(table(replies))
    return replies


def add(commands: Any) -> None:
    """Add these commands to the parser."""
    parser = command(commands, "watch", watch)
    add_client_flags(parser)
    parser.add_argument("--count", type=int, default=sys.maxsize, metavar="N", help="end after so many lines")
    for name, run in (("health", health), ("models", models)):
        parser = command(commands, name, run)
        add_client_flags(parser)
        parser.add_argument("--node", default="*", help="one node; default all")
