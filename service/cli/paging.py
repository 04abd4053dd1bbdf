"""The command page: a live page for browsers."""

import argparse
import sys
import webbrowser

from neurove_service.cli.arguments import add_client_flags, client_config, command
from neurove_service.endpoints import check_address, is_loopback, split_address
from neurove_service.lifecycle import stop_on_signals

DEFAULT_ADDRESS = "127.0.0.1:7480"


def page(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    from neurove_service.page.access import Access
    from neurove_service.page.server import bound, serve

    stop = stop_on_signals(with_parent=args.with_parent)
    config = client_config(args)
    host, port = split_address(args.listen)
    with bound(host, port) as listening:
        port = listening.getsockname()[1]
        url = f"http://{f'[{host}]' if ':' in host else host}:{port}/"

        def show_operator(token: str) -> None:
            print(f"operator: {url}#token={token} (works once)", flush=True)

        access = Access(loopback=is_loopback(host), operator=args.operator, on_operator_token=show_operator)
        address = url if access.viewer_token is None else f"{url}#token={access.viewer_token}"
        print(f"page: {address}", flush=True)
        access.issue()
        if not is_loopback(host):
            print("neurove: tokens and data travel unencrypted; use a trusted network or a tunnel", file=sys.stderr)
        if args.open:
            webbrowser.open(address)
        serve(config, listening, access, stop)
    return 0


def _address(text: str) -> str:
    try:
        return check_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def add_page(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove page`."""
    add_client_flags(command(parser, page, as_json=False))
    about = f"address of the page; port 0: a free one; beyond this machine a token is needed; default {DEFAULT_ADDRESS}"
    parser.add_argument("--listen", type=_address, default=DEFAULT_ADDRESS, metavar="HOST:PORT", help=about)
    about = "also activate models and roll back, with a token that works once"
    parser.add_argument("--operator", action="store_true", help=about)
    parser.add_argument("--open", action="store_true", help="open the page in the browser of this machine")
    parser.add_argument("--with-parent", action="store_true", help="end when the parent process ends")
