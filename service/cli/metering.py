"""The command metrics: one exporter for all nodes."""

import argparse
import sys

from neurove_service.cli.arguments import add_client_flags, address, client_config, command
from neurove_service.cli.waiting import Wait, add_wait
from neurove_service.endpoints import is_loopback, split_address
from neurove_service.lifecycle import stop_on_signals

DEFAULT_ADDRESS = "127.0.0.1:9465"


def metrics(args: argparse.Namespace) -> int:
    """Show the metrics of every node, by HTTP until Ctrl-C, or once on standard output."""
    from neurove_service.clients.fleet import Nodes
    from neurove_service.guard import Guard
    from neurove_service.metrics.exporter import Exporter
    from neurove_service.metrics.families import exposition
    from neurove_service.metrics.http import HttpServer

    stop = stop_on_signals()
    config = client_config(args)
    host, port = split_address(args.listen)
    wait = Wait(config, args.wait, stop)
    with wait.connect(config) as transport:
        nodes = Nodes(transport, config)
        if args.once:
            fleet = nodes.read()
            sys.stdout.write(exposition(fleet).decode())
            return 0 if fleet.replies and not fleet.silent else 1
        exporter = Exporter(nodes.read, live=str, ready=str)  # str() is empty: it lives as long as it answers
        server = HttpServer(host, port, exporter.respond, Guard())
        try:
            print(f"{server.url}/metrics", flush=True)
            if not is_loopback(host):
                print("neurove: every host that reaches this address can read the metrics", file=sys.stderr, flush=True)
            stop.wait()
        finally:
            server.close()
    return 0


def add_metrics(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove metrics`."""
    add_client_flags(command(parser, metrics, as_json=False))
    add_wait(parser)
    about = f"address of the HTTP server, with /metrics, /live, /ready and /health; default {DEFAULT_ADDRESS}"
    parser.add_argument("--listen", type=address, default=DEFAULT_ADDRESS, metavar="HOST:PORT", help=about)
    about = "print the metrics once and exit; exit code 1 if no node answers, or one does not"
    parser.add_argument("--once", action="store_true", help=about)
