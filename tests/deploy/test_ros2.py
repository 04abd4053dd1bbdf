"""deploy/ros2.md: its commands, tables and ekf.yaml agree with the code; the access list lets ROS and the bridge in."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import zenoh
from ruamel.yaml import YAML

from neurove_core.geometry.mounting import Mounting
from neurove_core.io.formats.ros import types
from neurove_core.io.formats.ros.events import ENCODINGS
from neurove_protocol import Flag
from neurove_protocol.keys import Keys
from neurove_service.cli.commands import build_parser
from neurove_service.ros2 import graph
from neurove_service.ros2.bridge import CameraTopics
from neurove_service.ros2.graph import DRIVER_QOS, LATCHED_QOS, VELOCITY_QOS, Topic
from neurove_service.ros2.velocity import ALL_DOUBTS, LINEAR_DOUBTS
from tests.deploy.secured import bare, deployment, free_tls
from tests.live.conftest import wait_until

PAGE = (Path(__file__).parents[2] / "deploy" / "ros2.md").read_text()
PARAMETERS = {
    *(
        "frequency",
        "two_d_mode",
        "odom_frame",
        "base_link_frame",
        "world_frame",
        "smooth_lagged_data",
        "history_length",
    ),
    *("twist0", "twist0_config", "twist0_queue_size", "twist0_rejection_threshold"),
}
"""Parameters of robot_localization's ekf_node that the page uses, by the names of its documentation."""


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def rows(heading):
    """The cells of the first table below a heading, without its first two lines."""
    table = re.search(r"(?:^\|.*\n)+", PAGE.split(f"## {heading}\n")[1], re.MULTILINE)[0]
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in table.splitlines()[2:]]


def test_the_commands_are_those_of_the_program():
    commands = [line for line in blocks("sh")[0].splitlines() if line.startswith("neurove ")]
    parsed = [build_parser({words[1]}).parse_args(words[1:]) for words in map(shlex.split, commands)]
    assert len(parsed) == 2
    assert (parsed[1].events, parsed[1].height, parsed[1].frame) == (["/event_camera/events"], 1.2, "base_link")
    assert set(re.findall(r"`(--[a-z0-9-]+)", PAGE)) <= {
        *(
            flag
            for command in ("serve", "ros2")
            for one in build_parser({command}).commands[command].arguments
            for flag in one.option_strings
        ),
    }


def test_the_example_of_a_pose_is_a_camera_that_looks_forward():
    numbers = [float(word) for word in blocks("text")[0].split()]
    mounting = Mounting.from_numbers("ros2.md", numbers)
    np.testing.assert_allclose(mounting.rotation, Mounting.from_angles().rotation, atol=1e-12)
    assert mounting.position_m.tolist() == [0.3, 0, 0.8]


def test_the_ekf_fragment_has_the_parameters_and_fuses_what_the_text_says():
    (text,) = blocks("yaml")
    parameters = YAML(typ="safe").load(text)["ekf_filter_node"]["ros__parameters"]
    assert set(parameters) == PARAMETERS
    assert parameters["twist0"] == "/neurove/cam0/velocity"
    names = [f"{part}{axis}" for part in ("", "r", "v", "w", "a") for axis in "xyz"]
    fused = [name for name, used in zip(names, parameters["twist0_config"], strict=True) if used]
    assert fused == ["vx", "vy", "wz"]
    assert parameters["base_link_frame"] == "base_link"


def test_the_table_of_flags_is_that_of_the_code():
    words = {True: "doubt", False: "as estimated"}
    found = {flag.strip("`"): (linear, angular) for flag, linear, angular, _ in rows("Flags and robot_localization")}
    assert found == {
        flag.value: (words[flag in ALL_DOUBTS + LINEAR_DOUBTS], words[flag in ALL_DOUBTS]) for flag in Flag
    }


def test_the_topics_and_their_qos_are_those_of_the_code():
    qos = {row[1]: row[3] for row in rows("Topics and QoS")}
    assert set(qos) == set(types.HASHES) - {types.POSE}
    for kind, one in ((types.EVENTS, DRIVER_QOS), (types.IMU, DRIVER_QOS), (types.TWIST, VELOCITY_QOS)):
        assert qos[kind] == f"{'reliable' if one.reliable else 'best effort'}, volatile, depth {one.depth}"
    assert (LATCHED_QOS.latched, qos[types.CAMERA]) == (True, f"reliable, latched or not, depth {LATCHED_QOS.depth}")
    topics = CameraTopics.of_driver("cam0", "/event_camera/events")
    assert (topics.camera_info, topics.imu) == ("/event_camera/camera_info", "/event_camera/imu")
    encodings = re.findall(r"`(\w+)`", PAGE.split("Encodings of events:")[1].split(". ")[0])
    assert sorted(encodings) == sorted(ENCODINGS)


def test_the_keys_are_those_of_the_code():
    keys = {row[0]: row[1].strip("`") for row in rows("Keys on Zenoh")}
    events, velocity = Topic("/event_camera/events", types.EVENTS), Topic("/neurove/cam0/velocity", types.TWIST)
    assert keys["events of a driver"] == graph.key(0, events, "kilted")
    assert keys["velocity"] == graph.key(0, velocity, "kilted")
    assert keys["what the bridge subscribes"] == graph.any_key(0, "/event_camera/events")
    assert keys["the same stream on our side"] == f"{Keys().events('cam0')}`, `{Keys().velocity('cam0')}"


@pytest.mark.live
def test_the_access_list_lets_the_bridge_and_ros_in_and_keeps_the_others_out(tmp_path):
    """Events and tokens of ROS reach the bridge, and the bridge publishes our streams; the others see only theirs."""
    endpoint = free_tls()
    names = ("router-box=127.0.0.1", "bridge-robot", "ros-robot", "consumer-planner", "node-edge1")
    folder = deployment(tmp_path, endpoint, *names)
    events, velocity = "0/cam/events/type/hash", "0/neurove/cam0/velocity/type/hash"
    heard = []

    def listen(name, session, *keys):
        for key in keys:
            handler = zenoh.handlers.Callback(lambda one: heard.append((name, str(one.key_expr))), indirect=False)
            kept.append(session.declare_subscriber(key, handler, allowed_origin=zenoh.Locality.REMOTE))

    kept = []
    with zenoh.open(zenoh.Config.from_file(str(folder / "router-box.json5"))):
        sessions = {
            name: bare(endpoint, folder / f"{name}.json5") for name in (one.partition("=")[0] for one in names[1:])
        }
        bridge, ros = sessions["bridge-robot"], sessions["ros-robot"]
        listen("bridge", bridge, graph.any_key(0, "/cam/events"), Keys().velocity(), "1/**")
        listen("ros", ros, velocity, Keys().events(), "1/**")
        listen("consumer", sessions["consumer-planner"], "0/**", "**")
        listen("node", sessions["node-edge1"], Keys().events())
        kept.append(ros.liveliness().declare_token("@ros2_lv/0/a/0/0/NN/%/%/driver"))
        sent = ((ros, events), (ros, "1/other/domain"), (ros, Keys().velocity("cam0")), (bridge, velocity))

        def spread():
            for session, key in (*sent, (bridge, Keys().events("cam0")), (sessions["consumer-planner"], events)):
                session.put(key, b"x")
            return {("bridge", events), ("ros", velocity), ("node", Keys().events("cam0"))} <= set(heard)

        wait_until(spread)
        wait_until(lambda: [one for one in bridge.liveliness().get("@ros2_lv/0/**", timeout=1.0) if one.ok])
        assert set(heard) == {("bridge", events), ("ros", velocity), ("node", Keys().events("cam0"))}
        assert [
            one for one in sessions["consumer-planner"].liveliness().get("@ros2_lv/0/**", timeout=1.0) if one.ok
        ] == []
        for session in sessions.values():
            session.close()
