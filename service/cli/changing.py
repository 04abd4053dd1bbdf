"""The commands that change running nodes, one after the other: push, activate, rollback."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from neurove_protocol.control import CHUNK_SCHEMA, ActivateReply, ErrorReply, PeerError, ProgressReply, PushReply
from neurove_protocol.errors import NeuroVEError
from neurove_service.cli.arguments import add_client_flags, client_config, command, seconds
from neurove_service.config import ClientConfig

Change = Callable[[Any, ClientConfig, str], None]
"""Changes one node over a transport and prints its progress."""


def push(args: argparse.Namespace) -> int:
    """Send a bundle to a running node; with --activate also make it the active model."""
    from neurove_service.clients import ask
    from neurove_service.clients.push_source import PushSource

    with PushSource(args.bundle) as source:

        def change(transport: Any, config: ClientConfig, node: str) -> None:
            _print(args, ask.push(transport, config, source.request, node, _progress(args)))
            if args.activate:
                _print(args, ask.activate(transport, config, source.digest, node, on_progress=_progress(args)))

        return _each(
            args,
            change,
            lambda transport, keys: transport.answer(keys.chunks(source.digest), source.chunk, CHUNK_SCHEMA),
        )


def activate(args: argparse.Namespace) -> int:
    """Change the model of a running node."""
    from neurove_service.clients import ask

    def change(transport: Any, config: ClientConfig, node: str) -> None:
        wanted = {"expect": args.expect, "shadow_s": args.shadow, "canary": args.canary}
        _print(args, ask.activate(transport, config, args.model, node, **wanted, on_progress=_progress(args)))

    return _each(args, change)


def rollback(args: argparse.Namespace) -> int:
    """Activate the previous model of a running node again."""
    from neurove_service.clients import ask

    def change(transport: Any, config: ClientConfig, node: str) -> None:
        _print(args, ask.rollback(transport, config, node, expect=args.expect, on_progress=_progress(args)))

    return _each(args, change)


def _each(args: argparse.Namespace, change: Change, prepare: Callable[[Any, Any], None] = lambda _, __: None) -> int:
    """Change one node after the other, and stop at the first that refuses."""
    from neurove_service.clients import ask

    config = client_config(args)
    with ask.connect(config) as transport:
        nodes = ask.nodes(transport, config, args.node, args.all)
        prepare(transport, config.keys)
        for number, node in enumerate(nodes, 1):
            try:
                change(transport, config, node)
            except NeuroVEError as error:
                if number == len(nodes):
                    raise
                left = f"{error.message}; not changed: {', '.join(nodes[number:])}"
                raise PeerError(ErrorReply(code=error.code, message=left, details=error.details)) from None
    return 0


def _progress(args: argparse.Namespace) -> Callable[[ProgressReply], None]:
    def show(reply: ProgressReply) -> None:
        if args.json:
            print(reply.model_dump_json(), flush=True)
        elif reply.step != "refused":  # the error repeats it
            print(f"{reply.node}: {reply.step}: {reply.text}", flush=True)

    return show


def _print(args: argparse.Namespace, reply: PushReply | ActivateReply) -> None:
    if args.json:
        print(reply.model_dump_json(), flush=True)
    elif isinstance(reply, PushReply):
        model = reply.model
        print(
            f"{reply.node}: {model.name} ({model.digest[:12]}) is stored, {reply.fetched:,} bytes transferred",
            flush=True,
        )
    else:
        new, old = reply.active, reply.previous
        print(
            f"{reply.node}: {new.name} ({new.digest[:12]}) is active and replaces {old.name} ({old.digest[:12]})",
            flush=True,
        )


def _digest_prefix(text: str) -> str:
    if not 8 <= len(text) <= 64 or text.strip("0123456789abcdef"):
        raise argparse.ArgumentTypeError(f"{text!r}: give the first 8 or more digits of a digest from `neurove models`")
    return text


def _streams(text: str) -> tuple[str, ...]:
    return tuple(part for part in text.split(",") if part)


def add_push(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove push`."""
    _add_nodes(command(parser, push))
    parser.add_argument("bundle", type=Path, metavar="BUNDLE", help="bundle to send, with BUNDLE.sig if it exists")
    parser.add_argument("--activate", action="store_true", help="make it the active model too")


def add_activate(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove activate`."""
    _add_nodes(command(parser, activate))
    _add_expect(parser)
    parser.add_argument("model", metavar="MODEL", help="name of the model, or the first 8 digits of its digest")
    about = "seconds that it runs in shadow before it becomes active; default: none"
    parser.add_argument("--shadow", type=seconds, default=0.0, metavar="S", help=about)
    about = "change these streams only; default: all streams"
    parser.add_argument("--canary", type=_streams, default=(), metavar="STREAM,...", help=about)


def add_rollback(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove rollback`."""
    _add_nodes(command(parser, rollback))
    _add_expect(parser)


def _add_nodes(parser: argparse.ArgumentParser) -> None:
    add_client_flags(parser)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--node", help="name of one node; default: the only node that is alive")
    where.add_argument("--all", action="store_true", help="change every node, one after the other")


def _add_expect(parser: argparse.ArgumentParser) -> None:
    about = "change the node only if this model is active"
    parser.add_argument("--expect", type=_digest_prefix, metavar="DIGEST", help=about)
