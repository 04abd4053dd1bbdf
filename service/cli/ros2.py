"""The command ros2: the bridge between a robot's topics and the service."""

import argparse
import json
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from neurove_protocol.errors import EXIT_FAILURE, InvalidField
from neurove_service.cli.arguments import (
    add_axes_flag,
    add_client_flags,
    add_lens_flags,
    client_config,
    command,
    mounting_of,
    sigma,
)
from neurove_service.cli.waiting import Wait, add_wait
from neurove_service.endpoints import check_endpoint
from neurove_service.lifecycle import stop_on_signals

if TYPE_CHECKING:
    from neurove_service.config import ClientConfig
    from neurove_service.guard import Guard
    from neurove_service.ros2.bridge import CameraTopics
    from neurove_service.ros2.link import Link
    from neurove_service.ros2.velocity import Frame

_DISTROS: Final = ("humble", "jazzy", "kilted", "lyrical")
_VARIANCE: Final = 1e6


def ros2(args: argparse.Namespace) -> int:
    """Bridge the event cameras of a ROS 2 robot to the service, and its estimates back, until Ctrl-C."""
    import gc

    from neurove_core.io.axes import parse_axes
    from neurove_core.io.calibration import check_calibration
    from neurove_service.guard import Guard
    from neurove_service.ros2.bridge import Bridge
    from neurove_service.ros2.feed import Feed, warm_up
    from neurove_service.ros2.rclpy_link import check_program
    from neurove_service.ros2.velocity import Velocity

    stop = stop_on_signals(with_parent=args.with_parent)
    config = client_config(args)
    cameras, frame = _cameras(args), _frame(args)
    axes = None if args.imu_axes is None else parse_axes(args.imu_axes)
    endpoints = config.connect if args.ros_connect is None else (_endpoint(args.ros_connect),)
    if args.calibration is not None:
        check_calibration(args.calibration)
    if args.via == "rclpy":
        check_program(args.ros_python)
    guard = Guard()
    warm_up()
    wait = Wait(config, args.wait, stop)
    with wait.connect(config) as transport:
        link = _link(args, endpoints, config, cameras, wait, stop, guard)
        parts = [
            (
                topics,
                Feed(topics.stream, args.height, args.calibration, axes),
                Velocity(topics.stream, frame, args.doubtful, args.variance),
            )
            for topics in cameras
        ]
        bridge = Bridge(link, transport, config.keys, parts, args.namespace, config.prefix, guard)
        gc.freeze()
        counts = bridge.run(stop, lambda: _say(cameras, args.namespace))
        fault = link.fault if args.via == "rclpy" else ""
    if args.json:
        print(json.dumps({"streams": counts, "internal_errors": guard.counts}))
    else:
        print("\n".join(_line(stream, one) for stream, one in counts.items()))
    if fault:
        print(f"neurove: {fault}", file=sys.stderr)
    return EXIT_FAILURE if guard.counts or fault else 0


def _say(cameras: "list[CameraTopics]", namespace: str) -> None:
    for topics in cameras:
        about = f"{topics.events} -> stream {topics.stream} -> {namespace}/{topics.stream}/velocity"
        print(f"neurove: {about}", file=sys.stderr, flush=True)


def _line(stream: str, counts: dict[str, Any]) -> str:
    doubtful = ", ".join(f"{name} {count:,}" for name, count in counts.pop("doubtful").items())
    told = ("messages", "events", "imu_samples", "velocity_sent")
    lost = [
        f"{count:,} {name}" for name, count in counts.items() if count and name not in (*told, "packets", "cameras")
    ]
    held = f"{counts['messages']:,} messages, {counts['events']:,} events, {counts['velocity_sent']:,} velocities"
    return (
        f"{stream}: {held}"
        + "".join(f", {one}" for one in lost)
        + (f"; linear part in doubt: {doubtful}" * bool(doubtful))
    )


def _cameras(args: argparse.Namespace) -> "list[CameraTopics]":
    """The topics of each camera, checked."""
    from neurove_service.ros2.bridge import CameraTopics
    from neurove_service.ros2.graph import check_domain, check_name, check_topic

    check_domain(args.domain)
    check_topic("--namespace", args.namespace)
    streams = args.stream or [f"cam{i}" for i in range(len(args.events))]
    if len(streams) != len(args.events) or len(set(streams)) != len(streams):
        bound = f"one different name for each of the {len(args.events)} --events"
        raise InvalidField("ros2", "--stream", ", ".join(streams), bound)
    cameras = []
    for stream, events in zip(streams, args.events, strict=True):
        topics = CameraTopics.of_driver(check_name("--stream", stream), check_topic("--events", events))
        if args.camera_info is not None:
            topics = topics._replace(camera_info=_topic("--camera-info", args.camera_info))
        if args.imu is not None:
            topics = topics._replace(imu=_topic("--imu", args.imu))
        cameras.append(topics)
    return cameras


def _topic(flag: str, name: str) -> str | None:
    from neurove_service.ros2.graph import check_topic

    return None if name == "none" else check_topic(flag, name)


def _frame(args: argparse.Namespace) -> "Frame":
    from neurove_service.ros2.velocity import Frame

    if args.extrinsics is None:
        return Frame(args.frame)
    if args.frame is None:
        bound = "it needs --frame NAME, the frame in which the file gives the pose of the camera"
        raise InvalidField("ros2", "--extrinsics", str(args.extrinsics), bound)
    return Frame(args.frame, mounting_of("ros2", args.extrinsics))


def _link(
    args: argparse.Namespace,
    endpoints: tuple[str, ...],
    config: "ClientConfig",
    cameras: "list[CameraTopics]",
    wait: Wait,
    stop: threading.Event,
    guard: "Guard",
) -> "Link":
    """The link to ROS."""
    from neurove_service.ros2.rclpy_link import RclpyLink
    from neurove_service.ros2.zenoh_link import ZenohLink
    from neurove_service.transport import TIMESTAMPS, open_transport

    name = "bridge_" + "_".join(topics.stream for topics in cameras)
    if args.via == "rclpy":
        return RclpyLink(args.ros_python, args.domain, args.namespace, name[:64], stop)
    transport = open_transport(
        "client",
        connect=endpoints,
        config_file=config.zenoh_config,
        patience_s=wait.left_s,
        stop=stop,
        guard=guard,
        more=TIMESTAMPS,
    )
    return ZenohLink(transport, args.domain, args.namespace, name[:64], args.distro, guard)


def _endpoint(text: str) -> str:
    try:
        return check_endpoint(text)
    except ValueError as error:
        raise InvalidField("ros2", "--ros-connect", text, str(error)) from None


def add_ros2(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove ros2`."""
    command(parser, ros2)
    about = "topic of event_camera_msgs/EventPacket, such as /event_camera/events; repeat it for each camera"
    parser.add_argument("--events", action="append", required=True, metavar="TOPIC", help=about)
    about = "name of the stream of each --events; default cam0, cam1, ..."
    parser.add_argument("--stream", action="append", metavar="NAME", help=about)
    about = (
        "topic of sensor_msgs/CameraInfo, latched or not, or none; default: camera_info in the namespace of the events"
    )
    parser.add_argument("--camera-info", metavar="TOPIC", help=about)
    about = "topic of sensor_msgs/Imu, or none; default: imu in the namespace of the events"
    parser.add_argument("--imu", metavar="TOPIC", help=about)
    add_lens_flags(parser)
    add_axes_flag(parser)
    parser.add_argument(
        "--frame", metavar="NAME", help="frame_id of the velocities; default: the camera's optical frame"
    )
    about = "pose of the camera's optical frame in --frame: the 16 numbers of a matrix, or x y z qx qy qz qw"
    parser.add_argument("--extrinsics", type=Path, metavar="FILE", help=about)
    about = (
        "what a linear velocity without scale or certainty becomes: `covariance` sends it with --variance, `withhold` "
    )
    about += "sends no message; default covariance"
    parser.add_argument("--doubtful", choices=("covariance", "withhold"), default="covariance", help=about)
    about = f"variance of each axis of a doubtful velocity [m2/s2, rad2/s2]; default {_VARIANCE:.0e}"
    parser.add_argument("--variance", type=sigma, default=_VARIANCE, metavar="V", help=about)
    parser.add_argument("--domain", type=int, default=0, metavar="N", help="ROS_DOMAIN_ID; default 0")
    about = "namespace of our node and topics; default /neurove"
    parser.add_argument("--namespace", default="/neurove", metavar="NAME", help=about)
    about = "ROS distribution of the robot; default kilted"
    parser.add_argument("--distro", choices=_DISTROS, default="kilted", help=about)
    about = "way to ROS: zenoh (rmw_zenoh, no ROS here) or rclpy (any middleware, ROS is installed here); default zenoh"
    parser.add_argument("--via", choices=("zenoh", "rclpy"), default="zenoh", help=about)
    about = "with --via rclpy: Python that can import rclpy; default python3"
    parser.add_argument("--ros-python", default="python3", metavar="PROGRAM", help=about)
    about = "endpoint of the router of ROS (rmw_zenohd); default: that of --connect"
    parser.add_argument("--ros-connect", metavar="ENDPOINT", help=about)
    add_client_flags(parser)
    add_wait(parser)
    parser.add_argument("--with-parent", action="store_true", help="end when the parent process ends")
