"""Falling back to the plain forms: one warning for each fast form that is off, and the check of the vector code.

Some fast forms use private parts of torch or numba, which a new release may change. Each of them is tried when a model
is loaded. Where it fails, the plain form computes the same result more slowly, and the log says so once.
"""

import functools
import logging

log = logging.getLogger(__name__)


@functools.cache
def warn_once(form: str, reason: str) -> None:
    """Log that a fast form is off, once for each form and reason."""
    log.warning("fast form off, using the plain form: form=%s reason=%s", form, reason)


def forget_warnings() -> None:
    """Log each warning again at the next load."""
    warn_once.cache_clear()


def reason_of(error: Exception) -> str:
    """The first line of an error, with its type where the error has no text."""
    return str(error).partition("\n")[0] or type(error).__name__


@functools.cache
def vectors_work() -> bool:
    """Whether this numba compiles vectors.py, which imports private modules of numba and llvmlite.

    Modules that import vectors.py at the top (sparse.py, sparse_int8.py and their kernels) may be imported only where
    this is true. The answer is computed once for a process.
    """
    try:
        from neurove_core.engine import vectors

        vectors.check()
    except Exception as error:  # noqa: BLE001  # a private module that has changed may raise anything
        warn_once("vector code", reason_of(error))
        return False
    return True
