"""Liveness, readiness and health, and that many scrapes cost one look at the node."""

import json
import time

from neurove_service.guard import Guard
from neurove_service.metrics.exporter import FRESH_S, Exporter
from neurove_service.metrics.families import Fleet
from neurove_service.node.monitor import Monitor
from neurove_service.node.watchdog import STOPPED_LOOP_S
from tests.service.metrics.test_families import reply
from tests.service.metrics.test_http import get


def status_and_text(exporter, path):
    response = exporter.respond(path)
    return response.status.value, response.body.decode()


def test_scrapes_within_a_moment_read_the_node_once():
    now_s, reads = [100.0], []

    def read():
        reads.append(now_s[0])
        return Fleet([reply()])

    exporter = Exporter(read, str, str, lambda: now_s[0])
    for _ in range(50):
        assert exporter.respond("/metrics").status == 200
        exporter.respond("/health")
    now_s[0] += FRESH_S
    exporter.respond("/metrics")
    assert reads == [100.0, 100.0 + FRESH_S]


def test_health_is_json_and_its_status_is_the_verdict():
    for fleet, code in (
        (Fleet([reply()]), 200),
        (Fleet([reply(ok=False, why="cam0 is stalled")]), 503),
        (Fleet([reply()], silent=["n2"]), 503),
        (Fleet([]), 503),
    ):
        status, text = status_and_text(Exporter(lambda fleet=fleet: fleet, str, str), "/health")
        said = json.loads(text)
        assert (status, said["ok"]) == (code, code == 200)
        assert said["silent"] == list(fleet.silent)


def test_live_and_ready_say_why_not():
    exporter = Exporter(lambda: Fleet([]), lambda: "the loop of stream cam0 is stuck", str)
    assert status_and_text(exporter, "/live") == (503, "not live: the loop of stream cam0 is stuck\n")
    assert status_and_text(exporter, "/ready") == (200, "ready\n")
    assert exporter.respond("/admin") is None


def test_a_node_is_live_while_its_loops_turn_and_ready_once_it_serves():
    monitor = Monitor("n1", "127.0.0.1:0", Guard())
    try:
        exporter = Exporter(monitor.read, monitor.live, monitor.ready)
        assert status_and_text(exporter, "/live")[0] == 200
        assert status_and_text(exporter, "/ready")[0] == 503
        assert b'neurove_node_up{node="n1"} 0.0' in get(monitor, "/metrics")[1]

        beat_s, stuck, now = [time.monotonic()], [], [reply()]
        monitor.attach(lambda: now[0], lambda: stuck, lambda: beat_s[0])
        assert status_and_text(exporter, "/ready") == (200, "ready\n")

        stuck.append("cam0")
        assert status_and_text(exporter, "/live") == (503, "not live: the loop of stream cam0 is stuck\n")
        assert status_and_text(exporter, "/ready")[0] == 503
        stuck.clear()
        beat_s[0] -= STOPPED_LOOP_S + 1
        assert "the housekeeping loop has not turned for" in status_and_text(exporter, "/live")[1]
        beat_s[0] = time.monotonic()
        now[0] = reply(ready=False)
        assert status_and_text(exporter, "/ready") == (503, "not ready: the node shuts down\n")
        assert status_and_text(exporter, "/live")[0] == 200
    finally:
        monitor.close()
