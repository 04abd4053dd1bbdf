"""Tasks on a Dask cluster of real processes: a lost worker, a failed task, and every cluster that cannot be used."""

import json
import os
import shutil
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import distributed
import pytest

from neurove_core import cluster
from neurove_core.cluster import ClusterError
from neurove_core.tasks import FailedTasks
from tests.live.conftest import wait_until
from tests.neurove_core import works

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.filterwarnings("ignore")  # of dask and tornado


class Machines:
    """A scheduler on the loopback and its workers."""

    def __init__(self, folder):
        self._folder, self._processes = folder, []
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self._start("scheduler", "--port", self.address.rpartition(":")[2], cwd=ROOT)
        wait_until(self._answers)

    def worker(self, cwd=ROOT, **environment):
        return self._start("worker", self.address, "--nthreads", "1", "--no-nanny", cwd=cwd, **environment)

    def _start(self, kind, *arguments, cwd, **environment):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments, "--host", "127.0.0.1"]
        place = ["--no-dashboard"] if kind == "scheduler" else ["--no-dashboard", "--local-directory", self._folder]
        process = subprocess.Popen([*command, *place], cwd=cwd, env=os.environ | environment, stderr=subprocess.DEVNULL)
        self._processes.append(process)
        return process

    def _answers(self):
        host, _, port = self.address.removeprefix("tcp://").partition(":")
        with socket.socket() as one:
            return one.connect_ex((host, int(port))) == 0

    def close(self):
        for process in reversed(self._processes):
            process.kill()
            process.wait()


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@pytest.fixture
def machines(tmp_path):
    made = Machines(tmp_path)
    yield made
    made.close()


def run(*words):
    command = [sys.executable, "-m", "neurove_service.cli", *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_lost_worker_costs_its_task_and_a_failed_task_is_named(machines, tmp_path):
    """Two workers; one ends in the middle of a task. The results are those of this process."""
    for _ in range(2):
        machines.worker()
    with cluster.connected(machines.address) as pool:
        jobs = {f"number {number}": (tmp_path, number) for number in range(6)}
        assert dict(pool.run(works.end_once, jobs)) == {f"number {n}": n * n for n in range(6)}
        assert (tmp_path / "ended").exists()
        found = {}
        with pytest.raises(FailedTasks, match=r"1 of 4 tasks failed: number 3: ValueError: 3 is too large"):
            works.until_failure(pool.run(works.square_below_3, {f"number {n}": n for n in range(4)}), found)
        assert found == {"number 0": 0, "number 1": 1, "number 2": 4}
    series = ("simulate", "room", "--camera", "pinhole:24x18:75", "--seconds", "0.2", "--seed", "20300", "--count", "3")
    there = run(*series, "--out", tmp_path / "there", "--dask", machines.address, "--json")
    assert (there.returncode, json.loads(there.stdout)["simulated"]) == (0, 3), there.stderr
    assert run(*series, "--out", tmp_path / "here").returncode == 0
    assert content(tmp_path / "there") == content(tmp_path / "here")
    again = run(*series, "--out", tmp_path / "there", "--dask", machines.address)
    assert again.stdout == f"{tmp_path / 'there'}: 3 recordings, 0 of them new\n"


def test_a_task_that_the_scheduler_drops_is_given_to_it_again(machines, tmp_path):
    machines.worker()
    jobs = {"number 3": (tmp_path, 3)}
    with (
        cluster.connected(machines.address) as pool,
        distributed.Client(machines.address) as other,
        ThreadPoolExecutor() as threads,
    ):
        results = threads.submit(dict, pool.run(works.square_when_told, jobs))
        wait_until((tmp_path / "begun").exists)
        keys = other.run_on_scheduler(lambda dask_scheduler: list(dask_scheduler.tasks))
        other.cancel([distributed.Future(key, other) for key in keys], force=True)
        (tmp_path / "go").write_text("")
        assert results.result(timeout=60) == {"number 3": 9}


def test_workers_without_neurove_or_with_other_code_are_named(machines, tmp_path):
    lacking, other = tmp_path / "lacking", tmp_path / "other"
    (lacking / "neurove_core").mkdir(parents=True)
    text = "raise ModuleNotFoundError(\"No module named 'neurove_core'\", name='neurove_core')\n"
    (lacking / "neurove_core" / "__init__.py").write_text(text)
    shutil.copytree(ROOT / "neurove_core", other / "neurove_core", ignore=shutil.ignore_patterns("__pycache__"))
    with (other / "neurove_core" / "tasks.py").open("a") as file:
        file.write("# changed\n")
    for folder in (lacking, other):
        machines.worker(cwd=folder, PYTHONPATH=os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))

    def problems():
        with pytest.raises(ClusterError) as found, cluster.connected(machines.address):
            pass
        return found.value.message

    wait_until(lambda: "cannot import neurove" in (found := problems()) and "other versions" in found)
    assert "(neurove_core)" in problems()
    assert f"(here {cluster.about().code})" in problems()


def test_a_cluster_that_is_not_there_ends_in_one_line(tmp_path):
    address = f"tcp://127.0.0.1:{free_port()}"
    ended = run("simulate", "room", "--count", "1", "--out", tmp_path / "out", "--dask", address)
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"neurove: cluster {address}: no scheduler answers within 10 s")
    assert ended.stderr.count("\n") == 1
    ended = run("simulate", "room", "--count", "1", "--out", tmp_path, "--dask", address, "--workers", "2")
    assert ended.returncode == 2
    assert "--workers=2: not together with --dask" in ended.stderr
