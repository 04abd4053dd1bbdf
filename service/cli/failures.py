"""Expected errors of every command: a sentence and an exit code. Everything else is a bug and keeps its traceback."""

import errno
import os
from typing import Final

from neurove_protocol.errors import EXIT_FAILURE, EXIT_WRONG_USAGE, NeuroVEError
from neurove_service.cli.commands import COMMANDS
from neurove_service.output import OutputError

_WRONG_PATH: Final = {
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.EEXIST,
    errno.ENOTEMPTY,
    errno.ENAMETOOLONG,
    errno.ELOOP,
}
"""Errors of a path that the user can correct."""

_OUT_OF_MEMORY: Final = ("can't allocate memory", "not enough memory", "bad allocation", "cuda out of memory")
_NO_THREAD: Final = "can't start new thread"


def failure(error: Exception, command: str) -> tuple[str, int] | None:
    """The sentence and the exit code of an expected error; None for a bug.

    Args:
        error: what ended the command.
        command: name of the command.
    """
    from neurove_core.extras import MissingExtra
    from neurove_service.cli.extras import missing_extra

    if isinstance(error, ModuleNotFoundError):
        usual = next((one.extra for one in COMMANDS if one.name == command), "")
        error = missing_extra(error, usual) or error
    if isinstance(error, MissingExtra):
        extra, library = error.details["extra"], error.details["library"]
        needs = f"this command needs the extra '{extra}': pip install 'neurove[{extra}]'"
        return f"{needs} ({library} is not installed)", error.exit_code
    if isinstance(error, OutputError):
        return str(error), EXIT_FAILURE
    if isinstance(error, NeuroVEError):
        return error.message, error.exit_code
    if isinstance(error, OSError):
        return _of_system(error)
    return _of_memory(error)


def _of_system(error: OSError) -> tuple[str, int] | None:
    """An error of the operating system: the file and the reason."""
    if error.errno is None:
        return None
    why = error.strerror or os.strerror(error.errno)
    names = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    sentence = f"{' to '.join(names)}: {why}" if names else why
    return sentence, EXIT_WRONG_USAGE if error.errno in _WRONG_PATH else EXIT_FAILURE


def _of_memory(error: Exception) -> tuple[str, int] | None:
    """An error of too little memory or too few threads; libraries have no class for it."""
    text = str(error).lower()
    if isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(known in text for known in _OUT_OF_MEMORY)
    ):
        return "not enough memory: free some, or raise the limit of the address space (ulimit -v)", EXIT_FAILURE
    if isinstance(error, RuntimeError) and _NO_THREAD in text:
        return "cannot start a thread: raise the limit of tasks (ulimit -u, TasksMax, pids limit)", EXIT_FAILURE
    return None
