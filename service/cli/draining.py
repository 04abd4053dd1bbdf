"""The command that hands over the streams of a node before it is stopped: drain."""

import argparse
import sys

from neurove_protocol.duty import DrainReply
from neurove_protocol.errors import EXIT_FAILURE
from neurove_service.cli.arguments import add_client_flags, client_config, command, node_name
from neurove_service.cli.waiting import Wait, add_wait


def drain(args: argparse.Namespace) -> int:
    """Hand over every stream that a node answers to a node that follows it, such as before an update.

    The node goes on as a follower until it is stopped or `--resume` ends the draining. Exit code 1: it still answers a
    stream, because no other node follows it with equal state.
    """
    from neurove_service.clients import ask

    config = client_config(args)
    wait = Wait(config, args.wait)
    with wait.connect(config) as transport:
        wait.until(lambda: ask.need_service(transport, config, args.node or "*"))
        (node,) = ask.nodes(transport, config, args.node, every=False)
        reply = ask.drain(transport, config, node, resume=args.resume)
    print(reply.model_dump_json() if args.json else _shown(reply, resume=args.resume), flush=True)
    if reply.kept and not args.json:
        print(f"neurove: {node} still answers {', '.join(sorted(reply.kept))}", file=sys.stderr)
    return EXIT_FAILURE if reply.kept else 0


def _shown(reply: DrainReply, *, resume: bool) -> str:
    if resume:
        return f"{reply.node}: may answer streams again"
    lines = [f"{reply.node}: {stream}: {node} answers it now" for stream, node in sorted(reply.handed.items())]
    lines += [f"{reply.node}: {stream}: {why}" for stream, why in sorted(reply.kept.items())]
    return "\n".join(lines or [f"{reply.node}: answers no stream"])


def add_drain(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove drain`."""
    parser = command(parser, drain)
    add_client_flags(parser)
    add_wait(parser)
    parser.add_argument("--node", type=node_name, help="name of the node; default: the only node that is alive")
    parser.add_argument("--resume", action="store_true", help="end the draining: the node may answer streams again")
