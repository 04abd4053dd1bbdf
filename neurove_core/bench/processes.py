"""Two processes on two cores against one: the windows per second of a machine with one process per core."""

import multiprocessing
import statistics
import time
from multiprocessing.connection import Connection
from typing import Final, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray

from neurove_core.bench import Row
from neurove_core.bench.window import SHIPPED, TINY, random_input
from neurove_core.engine.engine import Engine
from neurove_core.models import bundle
from neurove_core.networks.neurove import NetworkState, NeuroVE

PROCESSES: Final = 2
WINDOWS: Final = 300  # per process and run
_TIMEOUT_S: Final = 120.0


class _Share(NamedTuple):
    """The result of one process in one run."""

    cpu_ms: float
    twists: NDArray[np.float32]  # of the last window


def processes(rounds: int, *, quick: bool) -> list[Row]:
    """Windows of the shipped network, T = 1, in one process and in two processes at once.

    The wall time is what a user gets, including the effect of other work on the machine. The CPU time shows whether the
    processes slow each other down through caches and memory, as if the two cores were free of other work.
    """
    windows = 3 if quick else WINDOWS
    spawn = multiprocessing.get_context("spawn")
    pipes = [spawn.Pipe() for _ in range(PROCESSES)]
    workers = [spawn.Process(target=_work, args=(pipe[1], quick, windows), daemon=True) for pipe in pipes]
    for worker in workers:
        worker.start()
    pipe_ends = [pipe[0] for pipe in pipes]
    for connection in pipe_ends:
        _receive(connection)  # the process has warmed up
    wall: dict[int, list[float]] = {1: [], PROCESSES: []}
    cpu: dict[int, list[float]] = {1: [], PROCESSES: []}
    answers: list[NDArray[np.float32]] = []
    for _ in range(rounds):
        for count in (1, PROCESSES):
            began = time.monotonic()
            shares = _run(pipe_ends[:count])
            wall[count].append(1e3 * (time.monotonic() - began) / (count * windows))
            cpu[count].append(statistics.mean(share.cpu_ms for share in shares) / (count * windows))
            answers += [share.twists for share in shares]
    for connection, worker in zip(pipe_ends, workers, strict=True):
        connection.close()
        worker.join(_TIMEOUT_S)
    equal = all(np.array_equal(answer, answers[0]) for answer in answers)
    return [
        _row(f"{PROCESSES} processes, shipped, {kind} time per window", times, equal)
        for kind, times in (("wall", wall), ("CPU", cpu))
    ]


def _row(name: str, times: dict[int, list[float]], equal: bool) -> Row:
    many, one = statistics.median(times[PROCESSES]), statistics.median(times[1])
    return Row(name, many, "1 process", one, one / many, one / many / PROCESSES, equal)


def _run(pipe_ends: list[Connection]) -> list[_Share]:
    for connection in pipe_ends:
        connection.send("go")
    return [_receive(connection) for connection in pipe_ends]


def _receive(connection: Connection) -> _Share:
    if not connection.poll(_TIMEOUT_S):
        raise TimeoutError(f"a process of the benchmark did not answer in {_TIMEOUT_S:.0f} s")
    share: _Share = connection.recv()
    return share


def _work(pipe_end: Connection, quick: bool, windows: int) -> None:  # pragma: no cover (another process)
    torch.set_num_threads(1)
    config = TINY if quick else SHIPPED
    network = cast("NeuroVE", bundle.untrained(0, config).network.eval())
    engine, spikes = Engine(network), random_input(config, 1)
    pipe_end.send(_share(engine, network.initial_state(1), spikes, windows))
    while True:
        try:
            pipe_end.recv()
        except EOFError:
            return
        pipe_end.send(_share(engine, network.initial_state(1), spikes, windows))


def _share(engine: Engine, state: NetworkState, spikes: torch.Tensor, windows: int) -> _Share:  # pragma: no cover
    began = time.process_time()
    for _ in range(windows):
        twists, state = engine(spikes, state)
    return _Share(1e3 * (time.process_time() - began), twists.numpy().copy())
