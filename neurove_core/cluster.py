"""Tasks on the machines of a Dask cluster (https://distributed.dask.org), with the interface of `tasks.Pool`.

    with cluster.connected("tcp://scheduler:8786") as pool:
        for name, result in pool.run(work, {"sequence 7": job}):
            ...

The key of a task is a digest of its function, its job and this code. A worker that is lost costs the tasks that it ran,
and two clients that ask for the same task share its result. Every task checks that its worker runs the code of the
client.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import logging
import pickle
import platform
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import neurove_protocol
from neurove_core import tasks
from neurove_core.extras import MissingExtra
from neurove_core.tasks import Done, FailedTasks
from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError

log = logging.getLogger(__name__)

Job = TypeVar("Job")
Result = TypeVar("Result")

ATTEMPTS: Final = 3
"""How often a task is given to the scheduler at most; the scheduler itself gives that of a lost worker to another."""

_CONNECT_S: Final = 10.0
_WORKERS_S: Final = 60.0  # until the first worker must be there
_SILENT_S: Final = 30.0  # without a result, until the workers are counted
_AT_ONCE: Final = 256  # tasks that the scheduler has at once; their jobs and results take memory
_DROPPED: Final = ("cancelled", "lost")  # status of a task that the scheduler no longer has
_PACKAGES: Final = ("numpy", "numba", "distributed")
_ASK: Final = "__import__('neurove_core.cluster', fromlist=['about']).about()"
"""Text that a worker evaluates: unlike a function of ours, it arrives where neurove is not installed."""


class ClusterError(NeuroVEError):
    """A cluster cannot be used."""

    code = "cluster"
    exit_code = EXIT_FAILURE

    def __init__(self, address: str, why: str) -> None:
        super().__init__(f"cluster {address}: {why}", address=address, why=why)


class About(NamedTuple):
    """What must be equal on client and worker for the same results."""

    neurove: str
    code: str  # digest of the sources of neurove
    python: str
    packages: str


@functools.cache
def about() -> About:
    """The versions of this process."""
    versions = (f"{name} {_version(name)}" for name in _PACKAGES)
    return About(_version("neurove"), _code_digest(), platform.python_version(), ", ".join(versions))


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def _code_digest() -> str:
    """Digest of all sources that a task can run."""
    found = hashlib.sha256()
    for folder in (Path(__file__).parent, Path(str(neurove_protocol.__file__)).parent):
        for path in sorted(folder.rglob("*.py")):
            found.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:12]


def difference(ours: About, theirs: About) -> str:
    """What differs on a worker; empty if nothing does.

    >>> difference(About("1.0", "ab", "3.11.2", "numpy 2"), About("1.1", "cd", "3.11.2", "numpy 2"))
    'neurove 1.1 (here 1.0), code cd (here ab)'
    """
    pairs = zip(About._fields, theirs, ours, strict=True)
    return ", ".join(f"{name} {there} (here {here})" for name, there, here in pairs if there != here)


def checked(ours: About, work: Callable[[Job], Result], job: Job) -> Done[Result]:
    """Run a task on a worker, if the worker has the versions of the client."""
    different = difference(ours, about())
    if different:
        return Done(None, f"worker {platform.node()} has other versions: {different}")
    return tasks.guarded(work, job)


@contextlib.contextmanager
def connected(address: str) -> Iterator["Cluster"]:
    """Connect to the scheduler of a cluster, and check its workers.

    Args:
        address: of the scheduler, such as `tcp://scheduler:8786`.

    Raises:
        MissingExtra: dask.distributed is not installed.
        ClusterError: no scheduler answers, it has no worker, or workers lack neurove or have other versions.
    """
    try:
        import distributed
    except ModuleNotFoundError:
        raise MissingExtra("distributed", "cluster") from None
    logging.getLogger("distributed").setLevel(logging.ERROR)  # a lost worker is our own warning
    try:
        client = distributed.Client(  # type: ignore[no-untyped-call]  # of dask
            address, timeout=_CONNECT_S, set_as_default=False
        )
    except (OSError, ValueError) as error:
        why = f"no scheduler answers within {_CONNECT_S:g} s ({error}); start one with `dask scheduler`"
        raise ClusterError(address, why) from None
    try:
        _check_workers(client, address)
        yield Cluster(client, address)
    finally:
        client.close()  # type: ignore[no-untyped-call]  # of dask


def _check_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_WORKERS_S)
    except TimeoutError:
        why = f"the scheduler has no worker after {_WORKERS_S:g} s; start some with `dask worker {address}`"
        raise ClusterError(address, why) from None
    lacking, different = [], []
    for worker, told in client.run(eval, _ASK, on_error="return").items():
        if isinstance(told, ModuleNotFoundError):
            lacking.append(f"{worker} ({told.name})")
        elif not isinstance(told, tuple):
            different.append(f"{worker}: {told}")
        elif about() != told:
            different.append(f"{worker}: {difference(about(), About(*told))}")
    problems = []
    if lacking:
        problems.append(f"workers cannot import neurove, install it there: {', '.join(lacking)}")
    if different:
        problems.append(f"workers have other versions: {'; '.join(different)}")
    if problems:
        raise ClusterError(address, ". ".join(problems))


class Cluster:
    """Runs tasks on the workers of a scheduler; made by `connected`."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address

    def run(self, work: Callable[[Job], Result], jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """See `Pool`.

        Raises:
            ClusterError: the scheduler is lost.
        """
        names, running, failed = iter(jobs), dict[Any, str](), dict[str, str]()
        attempts = dict.fromkeys(jobs, 1)
        try:
            while True:
                while len(running) < _AT_ONCE and (name := next(names, None)) is not None:
                    running[self._submit(work, jobs[name])] = name
                if not running:
                    break
                for future in self._done(list(running)):
                    name = running.pop(future)
                    if self._is_given_up(future, attempts[name]):
                        future.release()
                        running[self._submit(work, jobs[name], attempts[name])] = name
                        attempts[name] += 1
                        continue
                    done = self._result(future)
                    future.release()
                    if done.failed:
                        failed[name] = done.failed
                    else:
                        yield name, done.result  # type: ignore[misc]  # a task without a failure has a result
        finally:
            for future in running:
                future.cancel()
        if failed:
            raise FailedTasks(failed, len(jobs))

    def _is_given_up(self, future: Any, attempts: int) -> bool:
        """Whether a scheduler that is there has dropped a task, which it gets ATTEMPTS times at most."""
        if future.status not in _DROPPED or self._client.status != "running" or attempts >= ATTEMPTS:
            return False
        log.warning("the scheduler dropped a task and gets it again: address=%s task=%s", self._address, future.key)
        return True

    def _submit(self, work: Callable[[Job], Result], job: Job, attempts: int = 0) -> Any:
        named = f"{work.__module__}.{work.__qualname__}".encode()
        digest = hashlib.sha256(pickle.dumps((about(), named, job), protocol=5)).hexdigest()[:32]
        again = f"-{attempts}" if attempts else ""  # a dropped key is not run again
        return self._client.submit(checked, about(), work, job, key=f"{work.__name__.strip('_')}-{digest}{again}")

    def _done(self, futures: list[Any]) -> set[Any]:
        """The futures that are done, at least one of them."""
        import distributed

        while True:
            try:
                with self._client.as_current():
                    found: Any = distributed.wait(  # type: ignore[no-untyped-call]  # of dask
                        futures, timeout=_SILENT_S, return_when="FIRST_COMPLETED"
                    )
                return set(found.done)
            except TimeoutError:
                if not self._client.scheduler_info()["workers"]:
                    log.warning("no worker at the scheduler, waiting: address=%s tasks=%d", self._address, len(futures))
            except Exception as error:
                dropped = {one for one in futures if one.status in _DROPPED}
                if dropped and self._client.status == "running":
                    return dropped
                if self._client.status != "running" or isinstance(error, OSError):
                    raise ClusterError(self._address, f"the scheduler is lost ({error})") from error
                raise

    def _result(self, future: Any) -> Done[Any]:
        if future.status in _DROPPED:
            raise ClusterError(self._address, "the scheduler is lost")
        if future.status == "error":  # nothing that the task raised: see `guarded`
            error = future.exception()
            return Done(None, f"{type(error).__name__}: {' '.join(str(error).split())}")
        done: Done[Any] = future.result()
        return done
