"""How far a long command is: bars on a terminal, else a line now and then."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def progress() -> Iterator[Callable[[str, int, int, str], None]]:
    """Shows how far each task is: bars on a terminal, else a line now and then."""
    if not sys.stderr.isatty():
        yield _say
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), TextColumn("{task.fields[about]}"))
    with Progress(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[str, Any] = {}

        def show(what: str, done: int, of: int, about: str) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=of, about="")
            bars.update(tasks[what], completed=done, about=about)

        yield show


def _say(what: str, done: int, of: int, about: str) -> None:
    if what.startswith(("simulated", "cut")) or done % 100 < 4 or done == of:
        sys.stderr.write(f"{what} {done}/{of}: {about}\n")
        sys.stderr.flush()
