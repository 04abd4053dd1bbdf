"""The switch between the compiled path and the reference implementation, plain PyTorch."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_PLAIN: ContextVar[bool] = ContextVar("plain", default=False)


@contextmanager
def plain() -> Iterator[None]:
    """Run the body without compiled code: each step is plain PyTorch, the reference of the fast path."""
    token = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(token)


def is_plain() -> bool:
    """Whether the caller runs inside `plain()`, in this thread or task."""
    return _PLAIN.get()
