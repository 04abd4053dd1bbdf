import json
import os
import signal
from pathlib import Path

import pytest

from neurove_core.io.packets import slices
from neurove_core.models import bundle
from neurove_core.sources import open_source
from tests.live.conftest import Process, client, free_endpoint, neurove, running, service, start_router, wait_until
from tests.recordings import shared

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def node(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    bundle.save(bundle.untrained(1, name="other"), folder / "other.safetensors")
    (folder / "foreign.safetensors").write_text("not a model")
    with service(free_endpoint(), "--models-dir", str(folder)) as (_, _, config):
        yield config.connect[0]


def test_drive_watch_health_models_and_activate_work_together(node, run):
    with running("drive", "pattern://", "--connect", node, "--stream", "cam1", "--wait", "90") as driver:
        watched = run("watch", "--connect", node, "--json", "--count", "5")
        lines = [json.loads(line) for line in watched.out.splitlines()]
        assert len(lines) == 5
        assert all(len(line["twists"]) == 5 and len(line["twists"][0]) == 6 for line in lines)
        assert not any("untrained" in line["flags"] for line in lines)
        people = run("watch", "--connect", node, "--count", "1").out
        assert people.startswith("cam1 ")
        assert "model=default" in people

        (health,) = json.loads(run("health", "--connect", node, "--json").out)
        assert health["streams"][0]["stream"] == "cam1"
        assert "cam1" in run("health", "--connect", node).out

        activated = run("activate", "other", "--connect", node)
        assert (activated.code, activated.err) == (0, "")
        assert "other" in activated.out
        (line,) = run("watch", "--connect", node, "--json", "--count", "1").out.splitlines()
        assert (json.loads(line)["model"], json.loads(line)["epoch"]) == ("other", 1)

        models = run("models", "--connect", node).out
        assert "active" in models
        assert "foreign.safetensors" in models
        (listed,) = json.loads(run("models", "--connect", node, "--json").out)
        assert listed["previous"]["name"] == "default"

        code, out, _ = driver.end(signal.SIGINT)
        assert code == 0
        assert "packets" in out


def test_a_node_refuses_to_activate_an_unknown_model(node, run):
    refused = run("activate", "../foreign", "--connect", node)
    assert refused.code == 1
    assert refused.err.count("\n") == 1
    assert "model='../foreign': not on this node; available: default, " in refused.err
    assert "other" in refused.err
    assert "not a safetensors file" in run("activate", "foreign", "--connect", node).err


def test_a_port_in_use_is_reported_in_one_line(node):
    second = neurove("serve", "--listen", node)
    assert second.returncode == 2
    said = [line for line in second.stderr.splitlines() if line.startswith("neurove: ")]
    assert said == [f"neurove: cannot open a Zenoh session: listen={node}: Address already in use"]


@pytest.mark.parametrize("command", [("health",), ("watch",), ("models",), ("activate", "other")])
def test_a_client_reports_a_missing_service(command, run):
    ran = run(*command, "--connect", free_endpoint(), "--wait", "0")
    assert ran.code == 1
    assert ran.err.startswith("neurove: no service")
    assert ran.err.count("\n") == 1


def test_a_router_without_a_node_counts_as_no_service(run):
    endpoint = free_endpoint()
    router = start_router(endpoint)
    try:
        with client(endpoint):
            pass
        assert run("watch", "--connect", endpoint, "--wait", "0").code == 1
        assert "is `neurove serve` running there" in run("health", "--connect", endpoint, "--wait", "0").err
        undriven = run("drive", "pattern://", "--connect", endpoint, "--wait", "0.5")
        assert (undriven.code, "no service subscribed to stream cam0" in undriven.err) == (1, True)
    finally:
        router.kill()
        router.wait()


def test_the_demo_counts_every_packet_event_and_window(tmp_path):
    picture = tmp_path / "demo.svg"
    shown = neurove("demo", "pattern://", "--seconds", "2", "--json", "--screenshot", str(picture), timeout_s=180)
    assert shown.returncode == 0, shown.stderr
    summary = json.loads(shown.stdout)
    assert summary["packets_sent"] == 500
    assert summary["packets_received"] + sum(summary["lost"].values()) == summary["packets_sent"]
    assert summary["estimates"] == summary["windows"] > 0
    assert summary["sensor"] == {"width": 173, "height": 130}
    assert (summary["model"], summary["trained"]) == ("default", True)
    assert 0 < summary["latency_ms"]["p50"] <= summary["latency_ms"]["p95"] <= summary["latency_ms"]["p99"]
    assert "UNTRAINED" not in picture.read_text()


def test_the_demo_plays_a_real_recording_and_prints_a_summary():
    path = shared("ecd/shapes_rotation")
    shown = neurove("demo", str(path), timeout_s=180)
    assert shown.returncode == 0, shown.stderr
    events = sum(piece.events.n for piece in slices(open_source(str(path)).chunks()))
    assert f"events     {events:,} of {events:,}" in shown.stdout
    assert "estimates  3 of 3 windows" in shown.stdout
    assert "lost       nothing" in shown.stdout
    assert "model      default\n" in shown.stdout


def test_the_demo_plays_a_damaged_recording_and_names_the_place_of_the_damage(tmp_path):
    lines = [f"{i / 1000:.6f} {i % 240} {i % 180} {i % 2}" for i in range(300)]
    (tmp_path / "events.txt").write_text("\n".join(lines) + "\n0.300 7 br\n")
    shown = neurove("demo", str(tmp_path), timeout_s=180)
    assert shown.returncode == 0
    assert "events     300 of 300" in shown.stdout
    assert "line 301" in shown.stderr


def test_the_demo_of_a_missing_source_says_so_in_one_line():
    shown = neurove("demo", "nowhere.xyz")
    assert shown.returncode == 2
    assert shown.stderr == "neurove: source 'nowhere.xyz': no such file or folder\n"


def test_a_demo_whose_model_cannot_be_loaded_prints_the_reason(tmp_path):
    foreign = tmp_path / "foreign.safetensors"
    foreign.write_text("hello, I am no model at all")
    shown = neurove("demo", "pattern://", "--model", str(foreign), "--seconds", "1", timeout_s=180)
    assert shown.returncode == 1
    assert "not a safetensors file" in shown.stderr
    assert "Traceback" not in shown.stderr


def test_ctrl_c_ends_the_demo_and_all_its_processes_in_order():
    demo = Process("demo", "pattern://", "--seconds", "60", "--json")
    wait_until(lambda: len(children(demo.child.pid)) == 2, timeout_s=180)  # the service and the driver
    started = children(demo.child.pid)
    code, out, errors = demo.end(signal.SIGINT)
    assert (code, errors) == (0, "")
    assert json.loads(out)["packets_sent"] >= 0
    assert not any(Path(f"/proc/{pid}").exists() for pid in started)


def children(pid):
    """Child processes of a process; empty if it has ended."""
    try:
        return [
            int(child)
            for task in Path(f"/proc/{pid}/task").iterdir()
            for child in (task / "children").read_text().split()
        ]
    except OSError:
        return []


def running_as(command, parent):
    """Children that run one of our commands; a child that has not started its program yet is none of them."""
    return [pid for pid in children(parent) if command in Path(f"/proc/{pid}/cmdline").read_text().split("\0")]


def test_killing_the_demo_leaves_no_process_behind():
    demo = Process("demo", "pattern://", "--seconds", "60", "--json")
    wait_until(lambda: len(children(demo.child.pid)) == 2, timeout_s=180)
    started = children(demo.child.pid)
    demo.end(signal.SIGKILL)
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in started))


def test_a_service_that_waits_for_a_router_ends_in_order_on_sigterm():
    with running("serve", "--mode", "client", "--connect", free_endpoint(), "--node", "n1") as waiting:
        for line in waiting.child.stderr:
            if "waiting for a router" in line:
                break
        code, _, errors = waiting.end(signal.SIGTERM)
    assert (code, "Traceback" in errors) == (0, False)


@pytest.mark.parametrize(("victim", "words"), [("serve", "the service ended"), ("drive", "the driver ended")])
def test_a_demo_that_loses_one_of_its_processes_says_which(victim, words):
    demo = Process("demo", "pattern://", "--seconds", "60", "--json")
    wait_until(lambda: len(running_as(victim, demo.child.pid)) == len(children(demo.child.pid)) - 1 == 1, timeout_s=180)
    os.kill(*running_as(victim, demo.child.pid), signal.SIGKILL)
    out, errors = demo.child.communicate(timeout=60)
    assert (demo.child.returncode, out) == (1, "")
    assert errors.startswith(f"neurove: {words}")
    assert errors.count("\n") == 1
