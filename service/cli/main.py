"""neurove: every command. Parse, call one function, print for people or --json for machines.

The commands are in `commands_*`, a module for each group. Exit codes: 0 fine; 1 the answer is bad news (nobody serves,
a stream loses packets, a recording is broken); 2 wrong usage (an unknown source, setting or file); 3 somebody else
changed the model first.
"""

import argparse
import os
import signal
import sys
from collections.abc import Sequence

from neurove_protocol.errors import NeuroVEError
from neurove_service.cli import asking, bench, bundles, changing, experiments, recordings, running, training
from neurove_service.cli.arguments import Command


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads starve a small machine
    args = _parser().parse_args(arguments)
    try:
        run: Command = args.run
        return run(args)
    except NeuroVEError as error:
        print(f"neurove: {error.message}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:  # before a command took the signals over
        return 128 + signal.SIGINT
    except BrokenPipeError:  # the reader of our output has gone, such as `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="neurove",
        description="Ego-velocity from event cameras, as a service on Zenoh.",
        epilog="Settings come from defaults, then --config FILE (TOML), then NEUROVE_* variables, then flags.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    running.add(commands)
    asking.add(commands)
    changing.add(commands)
    recordings.add(commands)
    training.add(commands)
    bundles.add(commands)
    experiments.add(commands)
    bench.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
