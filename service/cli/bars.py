"""Progress of a long command: bars on a terminal, else lines at intervals."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

_EACH_STEP = ("simulated", "split into windows")
"""Tasks whose steps take so long that each one is a line."""


@contextlib.contextmanager
def progress(*, shown: bool = True) -> Iterator[Callable[[str, int, int, str], None]]:
    """Yield a function that shows the progress of a task: (task, steps done, of how many, detail).

    Args:
        shown: show nothing if it is false.
    """
    if not shown:
        yield lambda *_: None
        return
    if not sys.stderr.isatty():
        yield _print_line
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from neurove_service.cli.console import console

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[detail]}"),
    )
    with Progress(*columns, console=console(stderr=True)) as bars:
        tasks: dict[str, Any] = {}

        def show(task: str, done: int, of: int, detail: str) -> None:
            if task not in tasks:
                tasks[task] = bars.add_task(task, total=of, detail="")
            bars.update(tasks[task], completed=done, detail=detail)

        yield show


@contextlib.contextmanager
def event_count(name: str) -> Iterator[Callable[[int], None]]:
    """Show the events read so far on a terminal; the length of a recording is unknown before its end."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from neurove_service.cli.console import console

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console(stderr=True)) as bar:
        task = bar.add_task(name, total=None)

        def show(events: int) -> None:
            bar.update(task, description=f"{name}: {events:,} events")

        yield show


def _print_line(task: str, done: int, of: int, detail: str) -> None:
    if task.startswith(_EACH_STEP) or done % 100 < 4 or done == of:
        sys.stderr.write(f"{task} {done}/{of}: {detail}\n")
        sys.stderr.flush()
