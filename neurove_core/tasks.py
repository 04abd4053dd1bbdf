"""Tasks that do not depend on each other: here, in processes of this machine, or on a cluster.

    for name, result in tasks.local(4).run(work, {"sequence 7": job}):
        ...

`work` is a function of a module, and the jobs and results can be pickled. A lost process or machine costs its task,
which runs again. A task that fails costs itself: the others are done first, then the error names it. `cluster.Cluster`
has the same interface.
"""

import concurrent.futures
import contextlib
import logging
import multiprocessing
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from neurove_protocol.errors import EXIT_FAILURE, InvalidField, NeuroVEError

log = logging.getLogger(__name__)

Job = TypeVar("Job")
Result = TypeVar("Result")

_NAMED: Final = 5  # failed tasks that an error names
_LOST_ALONE: Final = 2  # times that a task may end a process of its own
_PARENT_CHECK_S: Final = 1.0


class FailedTasks(NeuroVEError):
    """Some tasks failed; all others are done."""

    code = "failed_tasks"
    exit_code = EXIT_FAILURE

    def __init__(self, failed: Mapping[str, str], of: int) -> None:
        named = "; ".join(f"{name}: {why}" for name, why in list(failed.items())[:_NAMED])
        more = f"; and {len(failed) - _NAMED} more" if len(failed) > _NAMED else ""
        super().__init__(f"{len(failed)} of {of} tasks failed: {named}{more}", failed=len(failed), of=of)
        self.failed = dict(failed)  # why, by the name of the task


class Pool(Protocol):
    """Where tasks run."""

    def run(self, work: Callable[[Job], Result], jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """Run a task for each job, and yield its name and result when it is done, in any order.

        Args:
            work: function of a module.
            jobs: by the name of the task.

        Raises:
            FailedTasks: some tasks failed. It is raised after the results of all others.
        """


class Done(NamedTuple, Generic[Result]):
    """The end of a task: its result, or why it failed."""

    result: Result | None
    failed: str = ""


def guarded(work: Callable[[Job], Result], job: Job) -> Done[Result]:
    """Run a task; its exception becomes text, because not every exception can be pickled."""
    try:
        return Done(work(job))
    except Exception as error:
        log.info("task failed", exc_info=True)
        known = isinstance(error, NeuroVEError | OSError)
        return Done(None, str(error) if known else f"{type(error).__name__}: {error}")


class Here:
    """Runs the tasks in this process, one after the other; the first exception is raised as it is."""

    def run(self, work: Callable[[Job], Result], jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """See `Pool`."""
        for name, job in jobs.items():
            yield name, work(job)


HERE: Final = Here()
"""The pool of this process."""


class Processes:
    """Runs the tasks in processes of this machine; they start with the first task and end after the last one.

    Args:
        count: number of processes.
    """

    def __init__(self, count: int) -> None:
        self._count = count

    def run(self, work: Callable[[Job], Result], jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """See `Pool`. After a process ended early, the tasks that it may have run are tried alone."""
        missing, suspects = dict(jobs), list[str]()
        lost_alone, failed = Counter[str](), dict[str, str]()
        while missing:
            running: dict[concurrent.futures.Future[Done[Result]], str] = {}
            names = iter(suspects or list(missing))
            at_once = 1 if suspects else 2 * self._count
            try:
                with _executor(1 if suspects else self._count) as pool:
                    while True:
                        while len(running) < at_once and (name := next(names, None)) is not None:
                            running[pool.submit(guarded, work, missing[name])] = name
                        if not running:
                            break
                        for future in concurrent.futures.wait(running, return_when="FIRST_COMPLETED").done:
                            done = future.result()
                            name = running.pop(future)
                            del missing[name]
                            suspects = [one for one in suspects if one != name]
                            if done.failed:
                                failed[name] = done.failed
                            else:
                                yield name, done.result  # type: ignore[misc]  # a task without a failure has a result
            except BrokenProcessPool:
                lost = list(running.values())
                log.warning("a process of the pool ended early: tasks=%s", ", ".join(lost))
                if at_once == 1:
                    lost_alone.update(lost)
                    for name in lost:
                        if lost_alone[name] >= _LOST_ALONE:
                            del missing[name]
                            suspects.remove(name)
                            failed[name] = f"it ended its process {_LOST_ALONE} times"
                else:
                    suspects = lost
        if failed:
            raise FailedTasks(failed, len(jobs))


@contextlib.contextmanager
def _executor(count: int) -> Iterator[concurrent.futures.ProcessPoolExecutor]:
    context = multiprocessing.get_context("spawn")  # the threads of torch do not survive a fork
    with concurrent.futures.ProcessPoolExecutor(count, context, _end_with_parent, (os.getpid(),)) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)  # a full disk or a signal: do not start the rest
            raise


def _end_with_parent(parent: int) -> None:
    """End this process when its parent has ended, which sends no message where it was killed."""

    def watch() -> None:
        never = threading.Event()
        while os.getppid() == parent:
            never.wait(_PARENT_CHECK_S)
        os._exit(1)

    threading.Thread(target=watch, name="parent watch", daemon=True).start()


def local(count: int) -> Pool:
    """A pool of processes of this machine; this process itself if `count` is 1.

    Raises:
        InvalidField: the count is below 1.
    """
    if count < 1:
        raise InvalidField("tasks", "workers", count, "must be at least 1")
    return HERE if count == 1 else Processes(count)
