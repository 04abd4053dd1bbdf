"""The commands that query a running service: watch, health, models."""

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
from neurove_protocol.errors import EXIT_FAILURE
from neurove_service.cli.arguments import add_client_flags, client_config, command
from neurove_service.config import ClientConfig
from neurove_service.lifecycle import stop_on_signals


def watch(args: argparse.Namespace) -> int:
    """Show live estimates of all streams."""
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
    printed = 0
    while not stop.is_set() and (args.count is None or printed < args.count):
        with contextlib.suppress(queue.Empty):
            estimate = estimates.get(timeout=0.2)
            print(estimate.model_dump_json() if args.json else _line(estimate), flush=True)
            printed += 1
    return 0


def _ignore_status(_: StreamStatus) -> None:
    """The lines show estimates only."""


def _line(estimate: TwistEstimate) -> str:
    numbers = " ".join(f"{name}={value:+.3f}" for name, value in estimate.twist._asdict().items())
    return (
        f"{estimate.stream} {estimate.end_us / 1e6:.3f} s {numbers} model={estimate.model} [{' '.join(estimate.flags)}]"
    )


def _watch_table(config: ClientConfig, transport: Any, stop: threading.Event) -> int:
    from rich.live import Live

    from neurove_service.cli.console import console
    from neurove_service.cli.views import Board
    from neurove_service.clients import ask

    board = Board()
    ask.listen(transport, config, board.on_estimate, board.on_status)
    with Live(board, console=console(), refresh_per_second=8):
        stop.wait()
    return 0


def health(args: argparse.Namespace) -> int:
    """Show the health of every node."""
    from neurove_service.cli import views
    from neurove_service.clients import ask

    replies = _query(args, ask.health, views.health_table)
    return 0 if all(reply.ok for reply in replies) else EXIT_FAILURE


def models(args: argparse.Namespace) -> int:
    """List the models of every node."""
    from neurove_service.cli import views
    from neurove_service.clients import ask

    _query(args, ask.models, views.models_table)
    return 0


def _query(
    args: argparse.Namespace,
    query: Callable[[Any, ClientConfig, str], list[MessageT]],
    table: Callable[[list[MessageT]], Any],
) -> list[MessageT]:
    """Query the nodes, print their replies and return them."""
    from neurove_service.clients import ask

    config = client_config(args)
    with ask.connect(config) as transport:
        replies = query(transport, config, args.node)
    if args.json:
        print(json.dumps([reply.model_dump() for reply in replies]))
    else:
        from neurove_service.cli.console import console

        console().print(table(replies))
    return replies


def add_watch(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove watch`."""
    add_client_flags(command(parser, watch))
    parser.add_argument("--count", type=int, metavar="N", help="end after N lines; default: until Ctrl-C")


def add_health(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove health`."""
    _add_query(command(parser, health))


def add_models(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove models`."""
    _add_query(command(parser, models))


def _add_query(parser: argparse.ArgumentParser) -> None:
    add_client_flags(parser)
    parser.add_argument("--node", default="*", help="name of one node; default: all nodes")
