"""Metrics of real nodes: probes, a flood of clients, a real Prometheus that answers every panel of the dashboard."""

import contextlib
import json
import re
import shutil
import signal
import socket
import subprocess
import threading
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

import pytest

from neurove_service.clients import ask
from tests.live.conftest import Heard, free_endpoint, neurove, running, service, wait_until

pytestmark = pytest.mark.live

DEPLOY = Path(__file__).parents[2] / "deploy"
DASHBOARD = json.loads((DEPLOY / "grafana" / "neurove.json").read_text())
needs_prometheus = pytest.mark.skipif(shutil.which("prometheus") is None, reason="prometheus is not installed")


def free_address():
    return free_endpoint().removeprefix("tcp/")


def get(address, path):
    """Status and text; None while nothing listens there."""
    try:
        with urllib.request.urlopen(f"http://{address}{path}", timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()
    except OSError:
        return None


def value(text, name):
    """Sum of the samples of one metric."""
    found = re.findall(rf"^{name}(?:\{{.*\}})? (\S+)$", text, re.MULTILINE)
    return sum(map(float, found)) if found else None


@pytest.fixture(scope="module")
def node():
    """A node with metrics, one stream, and the endpoint, the address and the session."""
    endpoint, address = free_endpoint(), free_address()
    with (
        service(endpoint, "--metrics", address) as (_, transport, config),
        running("drive", "pattern://", "--connect", endpoint, "--wait", "90"),
    ):
        wait_until(lambda: (value(get(address, "/metrics")[1], "neurove_estimates_total") or 0) > 0)
        yield endpoint, address, transport, config


def test_a_node_that_serves_is_live_and_ready_and_its_counters_grow(node):
    _, address, transport, config = node
    assert get(address, "/live") == (200, "live\n")
    assert get(address, "/ready") == (200, "ready\n")
    before = value(get(address, "/metrics")[1], "neurove_estimates_total")
    wait_until(lambda: value(get(address, "/metrics")[1], "neurove_estimates_total") > before)
    status, text = get(address, "/health")
    (said,) = json.loads(text)["nodes"]
    assert (said["node"], status) == ("n1", 200 if said["ok"] else 503)
    (status,) = ask.health(transport, config)[0].streams
    assert sum(status.latency_histogram.counts) == pytest.approx(status.estimates, abs=5)  # some may be under way
    assert status.flag_counts["unscaled"] > 0
    wait_until(lambda: ask.health(transport, config)[0].streams[0].sigma is not None)


def test_a_flood_of_slow_and_greedy_clients_does_not_stop_the_estimates(node):
    _, address, transport, config = node
    host, port = address.split(":")
    heard, done = Heard(transport, config), threading.Event()

    def flood():
        while not done.is_set():
            get(address, "/metrics")

    with contextlib.ExitStack() as idle:
        for _ in range(100):
            client = idle.enter_context(socket.create_connection((host, int(port)), timeout=60))
            client.sendall(b"GET /metrics HTTP/1.1\r\n")
        threads = [threading.Thread(target=flood) for _ in range(3)]
        for thread in threads:
            thread.start()
        try:
            wait_until(lambda: len(heard.estimates) >= 20)
            assert get(address, "/live") == (200, "live\n")
        finally:
            done.set()
            for thread in threads:
                thread.join()
    seqs = [one.seq for one in heard.of("cam0")]
    assert seqs == sorted(set(seqs))


def test_a_node_that_waits_for_its_router_is_live_and_not_ready():
    address = free_address()
    flags = ("--mode", "client", "--connect", free_endpoint(), "--metrics", address)
    with running("serve", *flags) as waiting:
        wait_until(lambda: get(address, "/live") or waiting.child.poll() is not None)
        assert get(address, "/live") == (200, "live\n")
        assert get(address, "/ready")[0] == 503
        assert 'neurove_node_up{node="edge"} 0.0' in get(address, "/metrics")[1]


def test_the_fleet_is_shown_once_or_served(node):
    endpoint, *_ = node
    once = neurove("metrics", "--once", "--connect", endpoint)
    assert once.returncode == 0
    assert 'neurove_node_up{node="n1"} 1.0\n' in once.stdout
    assert value(once.stdout, "neurove_estimates_total") > 0


@needs_prometheus
def test_prometheus_scrapes_the_fleet_and_every_panel_of_the_dashboard_has_data(node, tmp_path):
    endpoint, *_ = node
    exporter, prometheus = free_address(), free_address()
    shutil.copy(DEPLOY / "prometheus" / "neurove-alerts.yml", tmp_path)
    config = (DEPLOY / "prometheus" / "prometheus.yml").read_text()
    config = config.replace("127.0.0.1:9465", exporter)
    config = re.sub(r"(scrape|evaluation)_interval: 15s", r"\1_interval: 2s", config)
    config = config.replace("scrape_timeout: 5s", "scrape_timeout: 2s")
    (tmp_path / "prometheus.yml").write_text(config)
    command = [
        "prometheus",
        f"--config.file={tmp_path / 'prometheus.yml'}",
        f"--storage.tsdb.path={tmp_path / 'data'}",
        f"--web.listen-address={prometheus}",
        "--log.level=error",
    ]
    with (
        running("metrics", "--listen", exporter, "--connect", endpoint),
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server,
    ):
        try:
            wait_until(lambda: query(prometheus, "count_over_time(neurove_node_up[1m]) >= 2"))
            *panels, change = expressions()
            left = dict.fromkeys(panels)
            assert len(left) > 20

            def all_answered():
                for expression in list(left):
                    if query(prometheus, expression):
                        del left[expression]
                return not left

            with contextlib.suppress(pytest.fail.Exception):
                wait_until(all_answered)
            assert list(left) == []
            assert neurove("activate", "untrained", "--connect", endpoint, "--force", "test").returncode == 0
            wait_until(lambda: query(prometheus, change))
            (group,) = json.loads(get(prometheus, "/api/v1/rules")[1])["data"]["groups"]
            assert {rule["health"] for rule in group["rules"]} <= {"ok", "unknown"}  # unknown: not evaluated yet
            assert {rule["lastError"] for rule in group["rules"] if "lastError" in rule} <= {""}
        finally:
            server.send_signal(signal.SIGTERM)
            neurove("rollback", "--connect", endpoint)


def expressions():
    """Every expression of the dashboard, with the variables of Grafana replaced; the last one shows model changes."""
    found = [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]
    found += [
        re.sub(r"label_values\((.*), \w+\)", r"\1", variable["definition"])
        for variable in DASHBOARD["templating"]["list"]
        if "definition" in variable
    ]
    (annotation,) = DASHBOARD["annotations"]["list"]
    found.append(annotation["expr"])
    return [one.replace("$node", ".*").replace("$stream", ".*").replace("$__rate_interval", "1m") for one in found]


def query(prometheus, expression):
    """The samples of an expression now; none while Prometheus starts."""
    answer = get(prometheus, f"/api/v1/query?{urllib.parse.urlencode({'query': expression})}")
    if answer is None or answer[0] == 503:
        return []
    assert answer[0] == 200, (expression, answer[1])
    return json.loads(answer[1])["data"]["result"]
