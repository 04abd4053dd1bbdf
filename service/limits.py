"""Limits of the process, checked before a node starts: below them it would say `ready` and serve nothing."""

import os
import resource
from typing import Final, NamedTuple

from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError


class LimitTooLow(NeuroVEError):
    """A limit of the process is too low for a node."""

    code = "limit"
    exit_code = EXIT_FAILURE

    def __init__(self, what: str, value: int, bound: int, where: str) -> None:
        text = f"{what}: the limit is {value:,}, a node needs at least {bound:,}: raise it ({where})"
        super().__init__(text, field=what, value=value, bound=bound)


class _Limit(NamedTuple):
    number: int
    what: str
    bound: int
    where: str  # it is set


# Measured with one stream: 21 descriptors, 2.0 GB of addresses, of which 0.45 GB are memory, and 17 threads. The bounds
# leave room for some more streams and clients.
_LIMITS: Final = (
    _Limit(resource.RLIMIT_NOFILE, "open files", 128, "ulimit -n, LimitNOFILE="),
    _Limit(resource.RLIMIT_AS, "address space [bytes]", 4 << 30, "ulimit -v, LimitAS="),
    _Limit(resource.RLIMIT_NPROC, "tasks of the user", 64, "ulimit -u, LimitNPROC="),
)


def check_limits() -> None:
    """Raise the number of open files as far as the system allows, then check that a node can work.

    Raises:
        LimitTooLow: a limit is too low.
    """
    for number, what, bound, where in _LIMITS:
        soft, hard = resource.getrlimit(number)
        if number == resource.RLIMIT_NPROC and os.geteuid() == 0:
            continue  # it does not apply to root
        if number == resource.RLIMIT_NOFILE and soft != hard:
            soft = hard
            resource.setrlimit(number, (soft, hard))
        if soft != resource.RLIM_INFINITY and soft < bound:
            raise LimitTooLow(what, soft, bound, where)
