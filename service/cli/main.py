"""neurove: parse the command line, run one command, print for people or with --json for machines.

Exit codes: 0 fine; 1 failure, such as no service, a stream that loses packets or a broken recording; 2 wrong usage,
such as an unknown source, setting or file, or an extra that is not installed; 3 another client changed the model first.

`neurove --help` and `neurove --version` import nothing beyond the standard library.
"""

import os
import signal
import sys
from collections.abc import Sequence

from neurove_service.cli.commands import COMMANDS, build_parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code.

    Args:
        arguments: words of the command line after the program's name; by default those of this process.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads slow a small machine down
    words = list(sys.argv[1:] if arguments is None else arguments)
    chosen = next((word for word in words if not word.startswith("-")), "")
    try:
        parser = build_parser({chosen})
        parser.check_words(words)
        args = parser.parse_args(words)
        code: int = args.run(args)
        return code
    except KeyboardInterrupt:  # before the command set its own signal handlers
        return 128 + signal.SIGINT
    except BrokenPipeError:  # the reader of our output has closed it, such as `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        failure = _failure(error, chosen)
        if failure is None:
            raise
        message, code = failure
        print(f"neurove: {message}", file=sys.stderr)
        return code


def _failure(error: Exception, command: str) -> tuple[str, int] | None:
    """The sentence and the exit code of an expected error; None for a bug, which ends with its traceback."""
    from neurove_core.extras import MissingExtra
    from neurove_protocol.errors import NeuroVEError
    from neurove_service.cli.extras import missing_extra

    if isinstance(error, ModuleNotFoundError):
        usual = next((one.extra for one in COMMANDS if one.name == command), "")
        error = missing_extra(error, usual) or error
    if isinstance(error, MissingExtra):
        extra, library = error.details["extra"], error.details["library"]
        needs = f"this command needs the extra '{extra}': pip install 'neurove[{extra}]'"
        return f"{needs} ({library} is not installed)", error.exit_code
    return (error.message, error.exit_code) if isinstance(error, NeuroVEError) else None


if __name__ == "__main__":
    sys.exit(main())
