"""The commands that change a running service: push, activate, rollback. One node after the other."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from neurove_protocol.control import CHUNK_SCHEMA, ActivateReply, ErrorReply, PeerError, ProgressReply, PushReply
from neurove_protocol.errors import NeuroVEError
from neurove_service.cli.arguments import add_client_flags, client_config, command, seconds
from neurove_service.config import ClientConfig

Change = Callable[[Any, ClientConfig, str], None]
"""Changes one node over a transport, and prints how it goes."""


def push(args: argparse.Namespace) -> int:
    """Send a bundle to a node while it runs; with --activate it serves then."""
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
    """Change the model of a node while it runs."""
    from neurove_service.clients import ask

    def change(transport: Any, config: ClientConfig, node: str) -> None:
        wanted = {"expect": args.expect, "shadow_s": args.shadow, "canary": args.canary}
        _print(args, ask.activate(transport, config, args.model, node, **wanted, on_progress=_progress(args)))

    return _each(args, change)


def rollback(args: argparse.Namespace) -> int:
    """Put a node back to the model before, while it runs."""
    from neurove_service.clients import ask

    def change(transport: Any, config: ClientConfig, node: str) -> None:
        _print(args, ask.rollback(transport, config, node, expect=args.expect, on_progress=_progress(args)))

    return _each(args, change)


def _each(args: argparse.Namespace, change: Change, prepare: Callable[[Any, Any], None] = lambda _, __: None) -> int:
    """Change one node after the other: what one refuses is not tried on the next."""
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
                left = f"{error.message}; not asked then: {', '.join(nodes[number:])}"
                raise PeerError(ErrorReply(code=error.code, message=left, details=error.details)) from None
    return 0


def _progress(args: argparse.Namespace) -> Callable[[ProgressReply], None]:
    def show(said: ProgressReply) -> None:
        if args.json:
            print(said.model_dump_json(), flush=True)
        elif said.step != "refused":  # the error says the same
            print(f"{said.node}: {said.step}: {said.text}", flush=True)

    return show


def _print(args: argparse.Namespace, reply: PushReply | ActivateReply) -> None:
    if args.json:
        print(reply.model_dump_json(), flush=True)
    elif isinstance(reply, PushReply):
        model = reply.model
        print(f"{reply.node}: {model.name} ({model.digest[:12]}) is there, {reply.fetched:,} bytes moved", flush=True)
    else:
        new, old = reply.active, reply.previous
        print(
            f"{reply.node}: {new.name} ({new.digest[:12]}) now serves, was {old.name} ({old.digest[:12]})", flush=True
        )


def _digest_prefix(text: str) -> str:
    if not 8 <= len(text) <= 64 or text.strip("0123456789abcdef"):
        raise argparse.ArgumentTypeError(
            f"{text!r}: give the first 8 or more digits of a digest, as `neurove models` has it"
        )
    return text


def _streams(text: str) -> tuple[str, ...]:
    return tuple(part for part in text.split(",") if part)


def add(commands: Any) -> None:
    """Add these commands to the parser."""
    for name, run in (("push", push), ("activate", activate), ("rollback", rollback)):
        parser = command(commands, name, run)
        add_client_flags(parser)
        where = parser.add_mutually_exclusive_group()
        where.add_argument("--node", help="one node; default the only one that is alive")
        where.add_argument("--all", action="store_true", help="every node, one after the other")
        if run is push:
            parser.add_argument("bundle", type=Path, metavar="BUNDLE", help="its file; BUNDLE.sig goes with it")
            parser.add_argument("--activate", action="store_true", help="and make it the active model")
            continue
        parser.add_argument("--expect", type=_digest_prefix, metavar="DIGEST", help="only if this is the active model")
        if run is activate:
            parser.add_argument("model", metavar="MODEL", help="its name, or the first 8 digits of its digest")
            parser.add_argument(
                "--shadow", type=seconds, default=0.0, metavar="S", help="first run beside for so long [s]"
            )
            parser.add_argument("--canary", type=_streams, default=(), metavar="STREAM,...", help="these streams only")
