"""A fleet: `python -m tests.long.fleet --nodes 6 --kills 8 --light 200`; minutes, not part of `make test`.

Real nodes (`neurove serve`, one process each) behind a router take rollouts: a bundle that fails on real windows once
its second step begins, a rollout that is killed again and again and resumed, and a node that is killed in its soak.
Then light nodes, each a session with tokens and a health queryable, are listed and planned for. The figures are printed
as JSON. The exit code is 1 if something does not hold.
"""

import argparse
import contextlib
import json
import random
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neurove_core.models import bundle
from neurove_service.config import ClientConfig
from neurove_service.fleet import roster
from neurove_service.transport import Transport
from tests.bundles import proven
from tests.live.conftest import Process, client, free_endpoint, neurove, running, start_router, wait_until
from tests.long.light_nodes import health_of
from tests.long.swaps import resident_kib
from tests.service.conftest import SMALL

START_S = 300.0


def save_models(folder: Path) -> None:
    """Two good bundles, and `wild`: the first one with a readout that is 100 times as large: it diverges on windows."""
    for seed, name in ((20001, "one"), (20002, "two")):
        bundle.save(proven(bundle.untrained(seed, SMALL, name)), folder / f"{name}.safetensors")
    wild = replace(bundle.untrained(20001, SMALL, "wild"))
    with torch.no_grad():
        for name, parameter in wild.network.named_parameters():
            if name.startswith("readout"):
                parameter.mul_(100.0)
    bundle.save(proven(wild), folder / "wild.safetensors")


class Fleet:
    """Real nodes behind a router."""

    def __init__(self, folder: Path, count: int, stack: contextlib.ExitStack) -> None:
        self.folder, self.endpoint, self.names = folder, free_endpoint(), [f"n{number}" for number in range(count)]
        self._stack, self.processes = stack, dict[str, Process]()
        save_models(folder)
        router = start_router(self.endpoint)
        stack.callback(router.wait)
        stack.callback(router.kill)
        self.config = ClientConfig(connect=(self.endpoint,))
        self.transport: Transport = stack.enter_context(client(self.endpoint))
        for name in self.names:
            self.start(name)
        wait_until(lambda: len(self.serving()) == count, START_S)

    def start(self, name: str) -> None:
        (self.folder / name).mkdir(exist_ok=True)
        where = ("--mode", "client", "--connect", self.endpoint, "--node", name, "--log-level", "warning")
        model = ("--model", str(self.folder / "one.safetensors"), "--state-dir", str(self.folder / name))
        self.processes[name] = self._stack.enter_context(running("serve", *where, *model, "--probation-s", "1"))

    def serving(self) -> dict[str, str]:
        return {name: one.model.name for name, one in roster.ask(self.transport, self.config).replies.items()}

    def command(self, *arguments: str) -> tuple[str, ...]:
        return ("rollout", "--connect", self.endpoint, "--json", *arguments)


def events_of(journal: Path) -> list[dict[str, Any]]:
    lines = journal.read_bytes().split(b"\n")[:-1] if journal.exists() else []
    return [json.loads(line) for line in lines]


def kinds(journal: Path) -> list[str]:
    return [event["event"] for event in events_of(journal)]


@contextlib.contextmanager
def camera(endpoint: str) -> Iterator[None]:
    """A camera of few events: every node of the run answers it, on the same cores."""
    process = Process(endpoint, "50000", "60", "cam0", module="tests.long.cameras")
    try:
        yield
    finally:
        process.end()


def bad_at_a_tenth(fleet: Fleet) -> dict[str, Any]:
    """The first node has no windows, so the bundle seems fine. Cameras begin with the second step."""
    journal = fleet.folder / "wild.jsonl"
    flags = (
        "--plan",
        "1,10%,100%",
        "--soak",
        "60s",
        "--patience",
        "20s",
        "--on-failure",
        "all",
        "--journal",
        str(journal),
    )
    process = Process(*fleet.command(str(fleet.folder / "wild.safetensors"), *flags))
    wait_until(lambda: kinds(journal).count("step") == 2 or process.child.poll() is not None, START_S)
    with camera(fleet.endpoint):
        code, _, err = process.end(0, timeout_s=START_S)
        again = neurove(*fleet.command("--resume", str(journal)), timeout_s=START_S)
    events = events_of(journal)
    return {
        "exit_code": code,
        "stderr": err[-300:],
        "changed": [one["node"] for one in events if one["event"] == "change"],
        "failed": {one["node"]: one["why"] for one in events if one["event"] == "failed"},
        "stop": [one["why"] for one in events if one["event"] == "stop"],
        "resumed_exit_code": again.returncode,
        "serving": fleet.serving(),
    }


def killed(fleet: Fleet, kills: int, seed: int) -> dict[str, Any]:
    """A rollout that is killed at random times and resumed until it ends."""
    journal, chance = fleet.folder / "two.jsonl", random.Random(seed)
    begin = (str(fleet.folder / "two.safetensors"), "--soak", "3s", "--patience", "20s", "--journal", str(journal))
    done = 0
    while done < kills and "end" not in kinds(journal):
        lines = len(events_of(journal))
        process = Process(*fleet.command(*(("--resume", str(journal)) if journal.exists() else begin)))
        wait_until(lambda n=lines, p=process: len(events_of(journal)) > n or p.child.poll() is not None, START_S)
        threading.Event().wait(chance.uniform(0.0, 3.0))
        if process.child.poll() is None:
            done += 1
            process.child.kill()
        process.end()
    last = neurove(*fleet.command("--resume", str(journal)), timeout_s=START_S)
    events = events_of(journal)
    return {
        "kills": done,
        "exit_code": last.returncode,
        "events": len(events),
        "bytes": journal.stat().st_size,
        "changes": {name: sum(e["event"] == "change" and e["node"] == name for e in events) for name in fleet.names},
        "fine": {name: sum(e["event"] == "fine" and e["node"] == name for e in events) for name in fleet.names},
        "serving": fleet.serving(),
    }


def node_killed(fleet: Fleet) -> dict[str, Any]:
    """kill -9 of a node in its soak; it starts again and serves the bundle, and still it is not fine."""
    journal, victim = fleet.folder / "one.jsonl", fleet.names[1]
    flags = ("--plan", "100%", "--soak", "20s", "--max-failed", "1", "--patience", "300s", "--journal", str(journal))
    process = Process(*fleet.command(str(fleet.folder / "one.safetensors"), *flags))
    wait_until(lambda: any(e["event"] == "active" and e["node"] == victim for e in events_of(journal)), START_S)
    fleet.processes[victim].child.kill()
    fleet.processes[victim].child.wait()
    fleet.start(victim)
    code, _, _ = process.end(0, timeout_s=2 * START_S)
    summary = events_of(journal)[-1]["summary"]
    return {"exit_code": code, "fine": sorted(summary["fine"]), "failed": summary["failed"]}


def real(count: int, kills: int, seed: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        fleet = Fleet(Path(folder), count, stack)
        report = {"bad_at_10_percent": bad_at_a_tenth(fleet), "killed": killed(fleet, kills, seed)}
        return report | {"node_killed": node_killed(fleet)}


class Counter:
    """Forwards the connections of one client to a server, and counts the bytes of each direction."""

    def __init__(self, endpoint: str) -> None:
        self._port, self.sent, self.received = int(endpoint.rpartition(":")[2]), 0, 0
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            near, _ = self._listening.accept()
            far = socket.create_connection(("127.0.0.1", self._port))
            threading.Thread(target=self._forward, args=(near, far, "sent"), daemon=True).start()
            threading.Thread(target=self._forward, args=(far, near, "received"), daemon=True).start()

    def _forward(self, source: socket.socket, sink: socket.socket, count: str) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                setattr(self, count, getattr(self, count) + len(data))
                sink.sendall(data)


def light(count: int, streams: int) -> dict[str, Any]:
    """List and plan for light nodes; bytes as a client of the router sends and receives them."""
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        router = start_router(endpoint)
        stack.callback(router.wait)
        stack.callback(router.kill)
        stack.enter_context(client(endpoint)).close()
        alone_kib = resident_kib(router.pid)
        words = [sys.executable, "-m", "tests.long.light_nodes", endpoint, str(count), str(streams)]
        nodes = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        stack.callback(nodes.wait)
        stack.callback(nodes.stdin.close)
        assert nodes.stdout.readline() == "ready\n"
        counted = Counter(endpoint)
        config = ClientConfig(connect=(counted.endpoint,))
        with client(counted.endpoint) as transport:
            wait_until(lambda: len(roster.ask(transport, config, timeout_s=60.0).replies) == count)
            before, times = (counted.sent, counted.received), []
            for _ in range(20):
                found = roster.ask(transport, config, timeout_s=60.0)
                assert len(found.replies) == count
                times.append(found.took_s)
            received = (counted.received - before[1]) // 20
            sent = (counted.sent - before[0]) // 20
            tokens = _tokens(transport, config, counted)
        listed, list_s = _timed("fleet", "list", "--connect", endpoint, "--timeout", "60", "--json")
        save_models(Path(folder))
        plan, plan_s = _timed(
            "rollout", f"{folder}/two.safetensors", "--connect", endpoint, "--timeout", "60", "--dry-run", "--json"
        )
        report = {
            "nodes": count,
            "streams_each": streams,
            "query_ms": {"median": round(1e3 * statistics.median(times), 1), "most": round(1e3 * max(times), 1)},
            "bytes": {"received": received, "sent": sent, "a_node": received // count},
            "health_reply_bytes": {n: len(health_of("robot-0000", n)) for n in (0, 1, 2, 10)},
            "tokens": tokens,
            "command_s": {"list": round(list_s, 2), "dry_run": round(plan_s, 2)},
            "listed": len(json.loads(listed.stdout)),
            "planned": [len(step) for step in json.loads(plan.stdout)["steps"]],
            "router_kib": {"alone": alone_kib, "with_nodes": resident_kib(router.pid)},
        }
        return report | {"left": _leave(nodes, endpoint, count)}


def _tokens(transport: Transport, config: ClientConfig, counted: Counter) -> dict[str, float]:
    """Bytes and time of a query for all tokens that say which node serves which stream."""
    before, began = counted.received, time.monotonic()
    found = transport.tokens(config.keys.serves(), 60.0)
    wait_until(lambda: counted.received > before)
    took_ms = 1e3 * (time.monotonic() - began)
    return {
        "serves": len(found),
        "bytes_each": round((counted.received - before) / len(found), 1),
        "ms": round(took_ms, 1),
    }


def _timed(*arguments: str) -> tuple[subprocess.CompletedProcess[str], float]:
    began = time.monotonic()
    return neurove(*arguments), time.monotonic() - began


def _leave(nodes: "subprocess.Popen[str]", endpoint: str, count: int) -> dict[str, Any]:
    """Ten nodes leave: how long until a list has no more of them."""
    config = ClientConfig(connect=(endpoint,))
    with client(endpoint) as transport:
        began = time.monotonic()
        nodes.stdin.write("close 10\n")
        nodes.stdin.flush()
        assert nodes.stdout.readline() == "done\n"
        wait_until(lambda: len(transport.tokens(config.keys.alive(), 60.0)) == count - 10)
        return {"nodes": 10, "gone_after_s": round(time.monotonic() - began, 2)}


def broken(report: dict[str, Any], nodes: int) -> list[str]:
    """What does not hold."""
    bad, kills, one = (report.get(name) for name in ("bad_at_10_percent", "killed", "node_killed"))
    holds = {}
    if bad:
        holds = {
            "the bad bundle stops at its second step": len(bad["changed"]) == 2 and bool(bad["stop"]),
            "every node serves its model before again": set(bad["serving"].values()) == {"one"},
            "a stop that reverted all has exit code 1": (bad["exit_code"], bad["resumed_exit_code"]) == (1, 1),
            "a killed rollout ends with every node fine": kills["exit_code"] == 0
            and kills["serving"] == {f"n{number}": "two" for number in range(nodes)},
            "no node is changed again after it was fine": set(kills["fine"].values()) == {1},
            "a node that was killed in its soak is not fine": one["exit_code"] == 4 and set(one["failed"]) == {"n1"},
        }
    if "light" in report:
        holds["every light node is listed and planned"] = (
            report["light"]["listed"] == report["light"]["nodes"] == sum(report["light"]["planned"])
        )
    return [what for what, kept in holds.items() if not kept]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=re.sub(r"\s+", " ", __doc__))
    parser.add_argument("--nodes", type=int, default=6, help="real nodes; 0: none")
    parser.add_argument("--kills", type=int, default=8, help="kill -9 of the rollout")
    parser.add_argument("--light", type=int, default=200, help="light nodes; 0: none")
    parser.add_argument("--streams", type=int, default=2, help="streams of each light node")
    parser.add_argument("--seed", type=int, default=20000)
    given = parser.parse_args()
    result = real(given.nodes, given.kills, given.seed) if given.nodes else {}
    if given.light:
        result["light"] = light(given.light, given.streams)
    print(json.dumps(result, indent=2))
    for what in broken(result, given.nodes):
        print(f"does not hold: {what}")
    sys.exit(1 if broken(result, given.nodes) else 0)
