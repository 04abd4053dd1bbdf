"""The commands that change running nodes, one after the other: push, activate, rollback.

With --all a refusal does not end the command: the next node is asked, and a summary by node follows. Exit code 0: every
node is as wanted; 4: some nodes refused; the code of the error, or 1 if they differ: all refused.
"""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from neurove_protocol.control import CHUNK_SCHEMA, ActivateReply, ModelInfo, ProgressReply, PushReply
from neurove_protocol.errors import EXIT_FAILURE, EXIT_PARTIAL, InvalidField, NeuroVEError
from neurove_service.cli.arguments import add_client_flags, client_config, command, node_name, seconds, stream_names
from neurove_service.cli.waiting import Wait, add_wait
from neurove_service.config import ClientConfig

MAX_SHADOW_S: Final = 3600.0
"""Longest time that a model runs in shadow [s]."""


class Outcome(NamedTuple):
    """What a command did on one node, and a sentence about it."""

    result: Literal["changed", "unchanged", "refused"]
    text: str
    exit_code: int = 0


Change = Callable[[Any, ClientConfig, str], Outcome]
"""Changes one node over a transport and prints its progress."""


def push(args: argparse.Namespace) -> int:
    """Send a bundle to a running node; with --activate also make it the active model."""
    from neurove_service.clients import ask
    from neurove_service.clients.push_source import PushSource

    if args.force is not None and not args.activate:
        raise InvalidField("push", "--force", args.force, "it is about the model change: give --activate too")
    with PushSource(args.bundle) as source:

        def change(transport: Any, config: ClientConfig, node: str) -> Outcome:
            done = _shown(args, ask.push(transport, config, source.request, node, _progress(args)))
            if not args.activate:
                return done
            wanted = {"force": args.force, "on_progress": _progress(args)}
            return _shown(args, ask.activate(transport, config, source.digest, node, **wanted))

        return _each(
            args,
            change,
            lambda transport, keys: transport.answer(keys.chunks(source.digest), source.chunk, CHUNK_SCHEMA),
        )


def activate(args: argparse.Namespace) -> int:
    """Change the model of a running node."""
    from neurove_service.clients import ask

    def change(transport: Any, config: ClientConfig, node: str) -> Outcome:
        wanted = {"expect": args.expect, "shadow_s": args.shadow, "canary": args.canary, "force": args.force}
        return _shown(args, ask.activate(transport, config, args.model, node, **wanted, on_progress=_progress(args)))

    return _each(args, change)


def rollback(args: argparse.Namespace) -> int:
    """Activate the previous model of a running node again."""
    from neurove_service.clients import ask

    def change(transport: Any, config: ClientConfig, node: str) -> Outcome:
        return _shown(args, ask.rollback(transport, config, node, expect=args.expect, on_progress=_progress(args)))

    return _each(args, change)


def _each(args: argparse.Namespace, change: Change, prepare: Callable[[Any, Any], None] = lambda _, __: None) -> int:
    """Change one node after the other, also after a refusal; of several nodes a summary follows."""
    from neurove_service.clients import ask

    config = client_config(args)
    wait = Wait(config, args.wait)
    with wait.connect(config) as transport:
        wait.until(lambda: ask.need_service(transport, config, args.node or "*"))
        nodes = ask.nodes(transport, config, args.node, args.all)
        prepare(transport, config.keys)
        if len(nodes) == 1:
            change(transport, config, nodes[0])
            return 0
        outcomes = {}
        for node in nodes:
            try:
                outcomes[node] = change(transport, config, node)
            except NeuroVEError as error:
                print(f"neurove: {error.message}", file=sys.stderr, flush=True)
                text = error.message.removeprefix(f"{node}: ")
                outcomes[node] = Outcome("refused", text, error.exit_code)
    print(_summary(outcomes, as_json=args.json), flush=True)
    return _exit_code(list(outcomes.values()))


def _exit_code(outcomes: list[Outcome]) -> int:
    refused = [one.exit_code for one in outcomes if one.result == "refused"]
    if len(refused) < len(outcomes):
        return EXIT_PARTIAL if refused else 0
    return refused[0] if len(set(refused)) == 1 else EXIT_FAILURE


def _summary(outcomes: dict[str, Outcome], *, as_json: bool) -> str:
    if as_json:
        return json.dumps(
            {"summary": {node: {"result": one.result, "text": one.text} for node, one in outcomes.items()}}
        )
    of = {
        result: sum(one.result == result for one in outcomes.values()) for result in ("changed", "unchanged", "refused")
    }
    counts = ", ".join(f"{count} {result}" for result, count in of.items() if count)
    width = max(len(node) for node in outcomes)
    return "\n".join(
        (
            f"summary of {len(outcomes)} nodes: {counts}",
            *(f"  {node:{width}}  {one.result}: {one.text}" for node, one in outcomes.items()),
        )
    )


def _progress(args: argparse.Namespace) -> Callable[[ProgressReply], None]:
    def show(reply: ProgressReply) -> None:
        if args.json:
            print(reply.model_dump_json(), flush=True)
        elif reply.step != "refused":  # the error repeats it
            print(f"{reply.node}: {reply.step}: {reply.text}", flush=True)

    return show


def _shown(args: argparse.Namespace, reply: PushReply | ActivateReply) -> Outcome:
    """Print the reply of a node."""
    outcome = _outcome(reply)
    print(reply.model_dump_json() if args.json else f"{reply.node}: {outcome.text}", flush=True)
    return outcome


def _outcome(reply: PushReply | ActivateReply) -> Outcome:
    if isinstance(reply, PushReply):
        if not reply.fetched:
            return Outcome("unchanged", f"already has {_name(reply.model)}, no bytes transferred")
        return Outcome("changed", f"{_name(reply.model)} is stored, {reply.fetched:,} bytes transferred")
    if not reply.changed:
        return Outcome("unchanged", f"already has {_name(reply.active)} as its active model")
    return Outcome("changed", f"{_name(reply.active)} is active and replaces {_name(reply.previous)}")


def _name(model: ModelInfo) -> str:
    return f"{model.name} ({model.digest[:12]})"


def digest_prefix(text: str) -> str:
    """The first 8 or more digits of a digest."""
    if not 8 <= len(text) <= 64 or text.strip("0123456789abcdef"):
        raise argparse.ArgumentTypeError(f"{text!r}: give the first 8 or more digits of a digest from `neurove models`")
    return text


def _reason(text: str) -> str:
    if not 1 <= len(text.strip()) <= 200:
        raise argparse.ArgumentTypeError(f"{text!r}: give a reason of 1 to 200 characters")
    return text.strip()


def _model(text: str) -> str:
    if not 1 <= len(text) <= 128:
        raise argparse.ArgumentTypeError(f"{text!r}: give a name or a digest of 1 to 128 characters")
    return text


def _shadow(text: str) -> float:
    value = seconds(text)
    if value > MAX_SHADOW_S:
        raise argparse.ArgumentTypeError(f"{text!r}: give at most {MAX_SHADOW_S:g} s")
    return value


def add_push(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove push`."""
    _add_nodes(command(parser, push))
    parser.add_argument("bundle", type=Path, metavar="BUNDLE", help="bundle to send, with BUNDLE.sig if it exists")
    parser.add_argument("--activate", action="store_true", help="make it the active model too")
    _add_force(parser)


def add_activate(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove activate`."""
    _add_nodes(command(parser, activate))
    _add_expect(parser)
    parser.add_argument(
        "model", type=_model, metavar="MODEL", help="name of the model, or the first 8 digits of its digest"
    )
    about = "seconds that it runs in shadow before it becomes active; default: none"
    parser.add_argument("--shadow", type=_shadow, default=0.0, metavar="S", help=about)
    about = "change these streams only; default: all streams"
    parser.add_argument("--canary", type=stream_names, default=(), metavar="STREAM,...", help=about)
    _add_force(parser)


def add_rollback(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove rollback`."""
    _add_nodes(command(parser, rollback))
    _add_expect(parser)


def _add_nodes(parser: argparse.ArgumentParser) -> None:
    add_client_flags(parser)
    add_wait(parser)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--node", type=node_name, help="name of one node; default: the only node that is alive")
    where.add_argument("--all", action="store_true", help="change every node, one after the other")


def _add_force(parser: argparse.ArgumentParser) -> None:
    about = "do not refuse the model for a difference from the active one; the reason is logged on the node"
    parser.add_argument("--force", type=_reason, metavar="REASON", help=about)


def _add_expect(parser: argparse.ArgumentParser) -> None:
    about = "change the node only if this model is active"
    parser.add_argument("--expect", type=digest_prefix, metavar="DIGEST", help=about)
