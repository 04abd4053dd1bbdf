"""The switch between the fused path and the reference implementation."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_PLAIN: ContextVar[bool] = ContextVar("plain", default=False)


@contextmanager
def plain() -> Iterator[None]:
    """Inside this, nothing is fused: each step is plain PyTorch, the reference that the fast path is held against."""
    token = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(token)


def is_plain() -> bool:
    """Whether the caller runs inside `plain()`."""
    return _PLAIN.get()
