"""The commands that query a running service: watch, health, models."""

import argparse
import contextlib
import importlib
import json
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Final, TypeVar

from neurove_protocol import TwistEstimate
from neurove_protocol.control import HealthReply, ModelsReply, StreamStatus
from neurove_protocol.errors import EXIT_FAILURE, InvalidField
from neurove_service.cli import lines
from neurove_service.cli.arguments import add_client_flags, address, client_config, command, count, node_name
from neurove_service.cli.waiting import Wait, add_wait
from neurove_service.config import ClientConfig
from neurove_service.lifecycle import stop_on_signals

_FOXGLOVE: Final = "127.0.0.1:8765"
_ONCE_S: Final = 2.0  # longest wait for an estimate of every stream
_POLL_S: Final = 0.05
_LINE_POLL_S: Final = 0.1

ReplyT = TypeVar("ReplyT", HealthReply, ModelsReply)


def watch(args: argparse.Namespace) -> int:
    """Show live estimates of all streams."""
    from neurove_service.clients import ask

    if args.foxglove is not None:
        importlib.import_module("foxglove")  # a missing extra is named before the wait for a service

    stop = stop_on_signals()
    config = client_config(args)
    wait = Wait(config, args.wait, stop)
    with wait.connect(config) as transport:
        wait.until(lambda: ask.need_service(transport, config))
        if args.foxglove is not None:
            return _watch_foxglove(args.foxglove, config, transport, stop)
        if args.once:
            return _watch_once(args, config, transport, stop)
        if args.json or not sys.stdout.isatty():
            return _watch_lines(args, config, transport, stop)
        return _watch_table(config, transport, stop)


def _watch_once(args: argparse.Namespace, config: ClientConfig, transport: Any, stop: threading.Event) -> int:
    """Show the newest estimate of every stream once; exit code 1 if no stream has one."""
    from neurove_service.cli.board import Board
    from neurove_service.cli.console import console
    from neurove_service.clients import ask

    board = Board()
    ask.listen(transport, config, board.on_estimate, board.on_status)
    for reply in ask.health(transport, config):
        for status in reply.streams:
            board.on_status(status)
    deadline = time.monotonic() + _ONCE_S
    while time.monotonic() < deadline and not all(one.last for one in board.streams().values()):
        if stop.wait(_POLL_S):
            break
    streams = board.streams()
    if args.json or not sys.stdout.isatty():
        for name, one in streams.items():
            print(lines.of_stream(name, one, json_wanted=args.json))
    else:
        console().print(board)
    if any(one.last for one in streams.values()):
        return 0
    print(f"neurove: no estimate of {len(streams)} streams within {_ONCE_S:g} s", file=sys.stderr)
    return EXIT_FAILURE


def _watch_lines(args: argparse.Namespace, config: ClientConfig, transport: Any, stop: threading.Event) -> int:
    import queue

    from neurove_service.clients import ask

    estimates: queue.SimpleQueue[TwistEstimate] = queue.SimpleQueue()
    ask.listen(transport, config, estimates.put, _ignore_status)
    notices = lines.Notices()
    printed = 0
    while not stop.is_set() and (args.count is None or printed < args.count):
        with contextlib.suppress(queue.Empty):
            estimate = estimates.get(timeout=_LINE_POLL_S)
            _tell(notices.arrived(estimate))
            print(lines.as_json(estimate) if args.json else lines.as_text(estimate), flush=True)
            printed += 1
        _tell(notices.silent())
    return 0


def _tell(notices: Iterable[str]) -> None:
    """Print to stderr what the lines of estimates cannot say."""
    for notice in notices:
        print(f"neurove: {notice}", file=sys.stderr, flush=True)


def _ignore_status(_: StreamStatus) -> None:
    """The lines show estimates only."""


def _watch_table(config: ClientConfig, transport: Any, stop: threading.Event) -> int:
    from rich.live import Live

    from neurove_service.cli.board import Board
    from neurove_service.cli.console import console
    from neurove_service.clients import ask

    board = Board()
    ask.listen(transport, config, board.on_estimate, board.on_status)
    with Live(board, console=console(), refresh_per_second=8):
        stop.wait()
    return 0


def _watch_foxglove(address: str, config: ClientConfig, transport: Any, stop: threading.Event) -> int:
    """Serve the streams to Foxglove until Ctrl-C."""
    from neurove_service.clients.viewer import Viewer
    from neurove_service.endpoints import is_loopback, split_address

    host, port = split_address(address)
    try:
        viewer = Viewer(transport, config, host, port)
    except (OSError, RuntimeError) as error:
        raise InvalidField("watch", "--foxglove", address, f"cannot listen there: {error}") from None
    where = f"[{host}]:{viewer.port}" if ":" in host else f"{host}:{viewer.port}"
    print(f"ws://{where}", flush=True)
    if not is_loopback(host):
        print("neurove: every host that reaches this address sees the streams", file=sys.stderr, flush=True)
    try:
        viewer.run(stop)
    finally:
        viewer.close()
    return 0


def health(args: argparse.Namespace) -> int:
    """Show the health of every node."""
    from neurove_service.cli import views
    from neurove_service.clients import ask

    replies, silent = _query(args, ask.health, views.health_table)
    return 0 if all(reply.ok for reply in replies) and not silent else EXIT_FAILURE


def models(args: argparse.Namespace) -> int:
    """List the models of every node."""
    from neurove_service.cli import views
    from neurove_service.clients import ask

    _query(args, ask.models, views.models_table)
    return 0


def _query(
    args: argparse.Namespace,
    query: Callable[[Any, ClientConfig, str], list[ReplyT]],
    table: Callable[[list[ReplyT]], Any],
) -> tuple[list[ReplyT], list[str]]:
    """Query the nodes and print their replies.

    Returns:
        the replies, and the names of nodes that are alive and do not answer.
    """
    from neurove_service.clients import ask

    config = client_config(args)
    wait = Wait(config, args.wait)
    with wait.connect(config) as transport:
        replies = wait.until(lambda: query(transport, config, args.node))
        silent = ask.silent(transport, config, {reply.node for reply in replies}, args.node)
    if args.json:
        print(json.dumps([reply.model_dump() for reply in replies]))
    else:
        from neurove_service.cli.console import console

        console().print(table(replies))
    for node in silent:
        print(f"neurove: node {node} is connected and does not answer", file=sys.stderr)
    return replies, silent


def add_watch(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove watch`."""
    add_client_flags(command(parser, watch))
    add_wait(parser)
    about = "show the newest estimate of every stream once; exit code 1 if there is none"
    parser.add_argument("--once", action="store_true", help=about)
    about = f"serve the streams to Foxglove on this address; default {_FOXGLOVE}; extra foxglove"
    parser.add_argument("--foxglove", nargs="?", type=address, const=_FOXGLOVE, metavar="HOST:PORT", help=about)
    parser.add_argument("--count", type=count, metavar="N", help="end after N lines; default: until Ctrl-C")


def add_health(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove health`."""
    _add_query(command(parser, health))


def add_models(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove models`."""
    _add_query(command(parser, models))


def _node(text: str) -> str:
    """The name of a node, or * for all nodes."""
    return text if text == "*" else node_name(text)


def _add_query(parser: argparse.ArgumentParser) -> None:
    add_client_flags(parser)
    add_wait(parser)
    parser.add_argument("--node", type=_node, default="*", help="name of one node; default: all nodes")
