"""The bridge through rclpy: a real node of ROS 2 on Fast DDS publishes events and receives velocities."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from neurove_service.clients import ask
from neurove_service.ros2.rclpy_link import NoRos, RclpyLink
from neurove_service.transport import open_transport
from tests.builders import SENSOR, make_events
from tests.builders_evt import write_evt3
from tests.live.conftest import Heard, client, free_endpoint, running, service, wait_until

pytestmark = pytest.mark.live

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".venv-ros2" / "bin" / "python"
ROBOT = ROOT / "tests" / "ros2" / "robot.py"
ROS_NS = 1_700_000_000 * 10**9
MESSAGES, MESSAGE_US, WINDOW_US = 60, 10_000, 50_000


@pytest.fixture(scope="module")
def ros():
    """Environment of the nodes: they find each other on this machine alone. Skips where `make ros2` made no ROS."""
    failed = ROOT / ".venv-ros2.why"
    if not (ROOT / ".venv-ros2" / "ready").exists():
        why = failed.read_text().strip() if failed.exists() else "make ros2 was not run"
        pytest.skip(f"no ROS 2 from PyPI: {why}")
    domain = str(100 + os.getpid() % 100)
    return {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": domain}


def plan():
    """One driver's messages: EVT3 words of uniform events, stamped with the time of the first event."""
    messages = []
    for i in range(MESSAGES):
        events = make_events(200, seed=20_600 + i, start_us=i * MESSAGE_US, duration_us=MESSAGE_US)
        events.t[0] = i * MESSAGE_US
        words = write_evt3(events).words.tobytes().hex()
        messages.append({"stamp_ns": ROS_NS + i * MESSAGE_US * 1000, "seq": i, "events": words})
    return {"width": SENSOR.width, "height": SENSOR.height, "k": 60.0, "messages": messages}


def test_a_real_node_publishes_events_and_receives_every_velocity(ros, tmp_path):
    (tmp_path / "plan.json").write_text(json.dumps(plan()))
    windows, endpoint = (MESSAGES - 1) * MESSAGE_US // WINDOW_US, free_endpoint()
    flags = ("--via", "rclpy", "--ros-python", str(PYTHON), "--domain", ros["ROS_DOMAIN_ID"], "--height", "1.2")
    with service(endpoint, "--queue-s", "30") as (_, transport, config), client(endpoint) as consumer:
        heard = Heard(consumer, config)
        topics = ("--connect", endpoint, "--events", "/event_camera/events", "--stream", "cam0", "--json")
        with running("ros2", *topics, *flags, **ros) as bridge:
            command = [str(PYTHON), str(ROBOT), str(tmp_path / "plan.json"), str(windows)]
            robot = subprocess.run(
                command, env=os.environ | ros, capture_output=True, text=True, timeout=180, check=False
            )
            assert robot.returncode == 0, robot.stderr
            wait_until(lambda: len(heard.of("cam0")) >= windows)
            counted = ask.health(transport, config)[0].streams[0]
            code, out, err = bridge.end()
    found = json.loads(robot.stdout)
    assert (code, err.count("->")) == (0, 2), err
    assert "/neurove/bridge_cam0" in found["nodes"]
    assert (counted.packets_received, counted.events_received, counted.calibrated) == (MESSAGES, MESSAGES * 200, True)
    assert (counted.windows, counted.lost.nonzero()) == (windows, {})
    estimates = heard.of("cam0")
    assert len(found["velocities"]) == len(estimates) == windows
    for velocity, estimate in zip(found["velocities"], estimates, strict=True):
        assert velocity["stamp_ns"] == ROS_NS + estimate.end_us * 1000
        assert velocity["frame"] == "event_camera"
        assert velocity["linear"] == list(estimate.twist[:3])
        assert np.linalg.eigvalsh(np.reshape(velocity["covariance"], (6, 6))).min() > 0
    counts = json.loads(out)["streams"]["cam0"]
    assert (counts["messages"], counts["velocity_sent"], counts["lost_messages"]) == (MESSAGES, windows, 0)


def router(endpoint):
    return open_transport("router", listen=(endpoint,))


def children(pid):
    """Processes that a process has started."""
    return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_the_end_of_the_process_of_ros_ends_the_bridge(ros):
    endpoint = free_endpoint()
    flags = ("--via", "rclpy", "--ros-python", str(PYTHON), "--domain", ros["ROS_DOMAIN_ID"], "--wait", "60")
    with router(endpoint), running("ros2", "--connect", endpoint, "--events", "/e/events", *flags) as bridge:
        found = []
        wait_until(lambda: found or found.extend(children(bridge.child.pid)))
        wait_until(lambda: "-> stream" in bridge.child.stderr.readline())
        for pid in found:
            os.kill(pid, 9)
        assert bridge.child.wait(timeout=120) == 1
        assert "the process of rclpy ended" in bridge.child.stderr.read()


@pytest.mark.parametrize(
    ("python", "why"), [("/no/python", "no such program"), (sys.executable, "No module named 'rclpy'")]
)
def test_a_python_without_rclpy_is_named(python, why):
    with pytest.raises(NoRos, match=why):
        RclpyLink(python, 0, "/neurove", "bridge_cam0", threading.Event())
