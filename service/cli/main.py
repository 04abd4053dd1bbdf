"""neurove: parse the command line, run one command, print for people or with --json for machines.

Exit codes: 0 fine; 1 failure, such as no service, a stream that loses packets, a broken recording or a full disk;
2 wrong usage, such as an unknown source, setting or file, or an extra that is not installed; 3 another client changed
the model first; 128 plus the number of the signal that ended a command.

Every command inherits what this module does: output that cannot fail with a traceback (`neurove_service.output`), the
same clean end by SIGTERM and SIGHUP as by Ctrl-C (`neurove_service.lifecycle`), and one sentence for each expected
error (`failures`). `neurove --help` and `neurove --version` import nothing beyond the standard library.
"""

import os
import signal
import sys
from collections.abc import Sequence

from neurove_service.cli.commands import build_parser
from neurove_service.lifecycle import interrupt_on_signals
from neurove_service.output import standard_streams


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code.

    Args:
        arguments: words of the command line after the program's name; by default those of this process.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads slow a small machine down
    words = list(sys.argv[1:] if arguments is None else arguments)
    chosen = next((word for word in words if not word.startswith("-")), "")
    interrupt_on_signals()
    with standard_streams():
        return _run(words, chosen)


def _run(words: list[str], chosen: str) -> int:
    """Run one command; an expected error becomes a sentence and an exit code."""
    try:
        try:
            return _command(words, chosen)
        finally:
            sys.stdout.flush()  # an error of what is buffered is known here
    except KeyboardInterrupt as ended:  # a command that sets its own signal handlers does not raise it
        return 128 + getattr(ended, "number", signal.SIGINT)
    except BrokenPipeError:  # the reader of our output has closed it, such as `| head`
        return 0
    except MemoryError:  # there may be none left to import what follows
        print("neurove: not enough memory: free some, or raise the limit of the address space", file=sys.stderr)
        return 1
    except Exception as error:
        from neurove_service.cli.failures import failure

        known = failure(error, chosen)
        if known is None:
            raise
        message, code = known
        print(f"neurove: {message}", file=sys.stderr)
        return code


def _command(words: list[str], chosen: str) -> int:
    parser = build_parser({chosen})
    parser.check_words(words)
    args = parser.parse_args(words)
    args.words = words  # a command may start itself again, on other devices
    code: int = args.run(args)
    return code


if __name__ == "__main__":
    sys.exit(main())
