"""The console of every table and progress bar: text that reaches a terminal has no control characters of others."""

import sys
from collections.abc import Iterable
from typing import IO, Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from neurove_service.output import printable, unfiltered


class CleanConsole(Console):
    """A console of rich for text from outside.

    rich writes its own control characters (colours, cursor) to the terminal, and passes on those in the text that it
    shows. Here each segment of text is cleaned, and the result goes past the filter of `neurove_service.output`.
    """

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The segments of something to show; control characters in its text are replaced."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=printable(segment.text))

    def on_broken_pipe(self) -> None:
        """Let the error end the command; rich calls this where it handles a BrokenPipeError."""
        raise  # in rich's `except` block


def console(*, stderr: bool = False, file: IO[str] | None = None, **options: Any) -> Console:
    """A console on standard output, standard error or a file; `options` are those of rich."""
    return CleanConsole(file=file or unfiltered(sys.stderr if stderr else sys.stdout), **options)
