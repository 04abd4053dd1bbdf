"""Functions of tasks, which other processes import."""

import os
import signal
import time
from pathlib import Path


def square(number: int) -> int:
    return number * number


def square_below_3(number: int) -> int:
    if number >= 3:
        raise ValueError(f"{number} is too large")
    return number * number


def end_once(job: tuple[Path, int]) -> int:
    """The square; the first process that asks for that of 2 ends as if it had been killed."""
    folder, number = job
    marker = folder / "ended"
    if number == 2 and not marker.exists():
        marker.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def square_when_told(job: tuple[Path, int]) -> int:
    """The square, as soon as the file `go` exists; `begun` says that the task runs."""
    folder, number = job
    (folder / "begun").write_text("")
    while not (folder / "go").exists():
        time.sleep(0.01)
    return number * number


def end_always(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def until_failure(results, found: dict[str, int]) -> None:
    """Take the results of a pool, which may end with an error, into a dictionary."""
    found.update((name, result) for name, result in results)
