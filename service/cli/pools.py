"""Where the tasks of a command run: here, in processes of this machine, or on a Dask cluster."""

import argparse
import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from neurove_protocol.errors import InvalidField
from neurove_service.cli.arguments import count

if TYPE_CHECKING:
    from neurove_core.tasks import Pool


def add_pool_flags(parser: argparse.ArgumentParser, work: str) -> None:
    """Add where the tasks of a command run.

    Args:
        parser: of the command.
        work: what the processes do, as a verb of the help text.
    """
    about = f"number of processes of this machine that {work}; default 1"
    parser.add_argument("--workers", type=count, default=1, metavar="N", help=about)
    about = f"{work} on the workers of this Dask scheduler instead, such as tcp://scheduler:8786"
    parser.add_argument("--dask", metavar="ADDRESS", help=about)


@contextlib.contextmanager
def pool_of(args: argparse.Namespace) -> Iterator["Pool"]:
    """The pool that the flags choose.

    Raises:
        InvalidField: both flags are given. MissingExtra, ClusterError: as `cluster.connected`.
    """
    from neurove_core import cluster, tasks

    if args.dask is None:
        yield tasks.local(args.workers)
        return
    if args.workers > 1:
        raise InvalidField(
            "tasks", "--workers", args.workers, "not together with --dask: its workers are the processes"
        )
    with cluster.connected(args.dask) as pool:
        yield pool
