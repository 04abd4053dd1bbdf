"""Standard output and standard error of every command: what they may print, and what happens if they cannot.

`standard_streams` replaces `sys.stdout` and `sys.stderr` while a command runs, so that every command inherits this:

- control characters in what a peer, a bundle or a file says do not reach a terminal (`printable`);
- characters that the stream's encoding lacks become replacement characters;
- a full disk, a closed stream and the like become one `OutputError`; a reader that left stays a `BrokenPipeError`.

A library that draws, such as rich, writes its own control characters: it gets `unfiltered(sys.stdout)` and cleans the
text itself. This module imports only the standard library, because `neurove --help` does.
"""

import contextlib
import errno
import io
import os
import re
import sys
from collections.abc import Iterable, Iterator
from typing import Any, Final, TextIO, cast

REPLACEMENT: Final = "\N{REPLACEMENT CHARACTER}"
"""What a reader sees in the place of a control character."""

_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    r"""The text with a replacement character for each control character except tab and line feed.

    C0 and C1 control characters move a terminal's cursor, change its title or answer for the user. Marks of writing
    direction make a text read as another one.

    >>> printable("cam0\x1b[2J\n") == "cam0\N{REPLACEMENT CHARACTER}[2J\n"
    True
    """
    return _CONTROL.sub(REPLACEMENT, text)


class OutputError(Exception):
    """Standard output cannot be written. It is no OSError, because argparse ignores those of its output."""

    def __init__(self, error: Exception) -> None:
        closed = isinstance(error, ValueError) or (isinstance(error, OSError) and error.errno == errno.EBADF)
        self.why = "it is closed" if closed else getattr(error, "strerror", None) or str(error)
        super().__init__(f"cannot write to standard output: {self.why}")


class Stream:
    """A text stream that cleans what it writes and fails with one error.

    Args:
        stream: where it writes to.
        clean: replace control characters.
        must_succeed: raise an error where writing fails; otherwise the text is lost.
    """

    def __init__(self, stream: TextIO, *, clean: bool, must_succeed: bool) -> None:
        self._stream, self._clean, self._must_succeed = stream, clean, must_succeed

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text.

        Raises:
            OutputError: it cannot be written. BrokenPipeError: the reader has left.
        """
        with self._declared():
            self._stream.write(printable(text) if self._clean else text)
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write each text.

        Raises:
            OutputError, BrokenPipeError: as write.
        """
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Write what is buffered.

        Raises:
            OutputError: it cannot be written. BrokenPipeError: the reader has left.
        """
        with self._declared():
            self._stream.flush()

    def unfiltered(self) -> "Stream":
        """The same stream for text whose control characters are our own."""
        return Stream(self._stream, clean=False, must_succeed=self._must_succeed)

    @contextlib.contextmanager
    def _declared(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:  # ValueError: the stream is closed
            _discard_rest(self._stream)
            if not self._must_succeed:
                return
            if isinstance(error, BrokenPipeError):
                raise
            raise OutputError(error) from None


def unfiltered(stream: TextIO) -> TextIO:
    """The stream without the filter of control characters, for a program that draws with them."""
    return cast("TextIO", stream.unfiltered()) if isinstance(stream, Stream) else stream


@contextlib.contextmanager
def standard_streams() -> Iterator[None]:
    """Replace `sys.stdout` and `sys.stderr` for the block, as the module's text says.

    Flush `sys.stdout` in the block: an error of what is buffered is known only then.
    """
    before = sys.stdout, sys.stderr
    found = _opened(1, before[0]), _opened(2, before[1])
    kept = [_replacing(stream) for stream in found]
    sys.stdout = cast("TextIO", Stream(found[0], clean=True, must_succeed=True))
    sys.stderr = cast("TextIO", Stream(found[1], clean=True, must_succeed=False))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        for stream, errors in zip(found, kept, strict=True):
            if errors is not None and not stream.closed:
                _set_errors(stream, errors)


def _opened(number: int, stream: TextIO | None) -> TextIO:
    """The stream; if its descriptor was closed before this process started, one that takes its place.

    Otherwise the next file or socket would get the number of standard output. Writing to the replacement of standard
    output fails; text for standard error is lost.
    """
    if stream is not None:
        return stream
    mode = os.O_RDONLY if number == 1 else os.O_WRONLY
    while True:
        descriptor = os.open(os.devnull, mode)
        if descriptor >= number:
            break
    return io.TextIOWrapper(io.BufferedWriter(_Raw(descriptor)), encoding="utf-8", write_through=True)


class _Raw(io.RawIOBase):
    """Writes to a descriptor, whether it can be written or not."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return False

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        return os.write(self._descriptor, data)


def _replacing(stream: TextIO) -> str | None:
    """Let the stream replace characters that its encoding lacks; what it did before, None if it cannot be told."""
    errors = stream.errors
    return errors if _set_errors(stream, "replace") else None


def _set_errors(stream: TextIO, errors: str) -> bool:
    if not isinstance(stream, io.TextIOWrapper):
        return False
    try:
        stream.reconfigure(errors=errors)
    except (OSError, ValueError):  # what was buffered before cannot be written
        return False
    return True


def _discard_rest(stream: TextIO) -> None:
    """Send what is still buffered to nowhere, or the interpreter would fail again at its end."""
    with contextlib.suppress(OSError, ValueError):
        descriptor = os.open(os.devnull, os.O_WRONLY)
        os.dup2(descriptor, stream.fileno())
        os.close(descriptor)
