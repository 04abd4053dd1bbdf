"""A real node of ROS 2: publishes events and receives velocities. `.venv-ros2/bin/python robot.py FILE COUNT`.

FILE is JSON: `width`, `height`, the focal length `k`, and `messages` with `stamp_ns`, `seq` and `events` (EVT3 words as
hex). The node publishes them in real time once the bridge has the lens, waits for COUNT velocities, and prints what it
received as JSON.
"""

import array
import json
import sys
import time
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from event_camera_msgs.msg import EventPacket
from geometry_msgs.msg import TwistWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo

DEADLINE_S = 120.0


def main():
    plan = json.loads(Path(sys.argv[1]).read_text())
    rclpy.init(args=[])
    node = rclpy.create_node("driver", namespace="event_camera")
    received, calibrated, deadline = [], [], time.monotonic() + DEADLINE_S

    def diagnosed(message):
        calibrated.extend(
            one for status in message.status for one in status.values if (one.key, one.value) == ("cameras", "1")
        )

    def spin_until(condition):
        while not condition() and time.monotonic() < deadline:
            rclpy.spin_once(node, timeout_sec=0.05)

    driver_qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
    latched_qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(EventPacket, "events", driver_qos)
    cameras = node.create_publisher(CameraInfo, "camera_info", latched_qos)
    node.create_subscription(TwistWithCovarianceStamped, "/neurove/cam0/velocity", received.append, 10)
    node.create_subscription(DiagnosticArray, "/diagnostics", diagnosed, 10)
    info = CameraInfo(width=plan["width"], height=plan["height"], distortion_model="plumb_bob")
    info.k[0] = info.k[4] = plan["k"]
    info.k[2], info.k[5], info.k[8] = plan["width"] / 2, plan["height"] / 2, 1.0
    cameras.publish(info)
    spin_until(lambda: publisher.get_subscription_count() and node.count_publishers("/neurove/cam0/velocity"))
    spin_until(lambda: calibrated)  # the bridge has the lens, so that it does not change after the first events
    begin, first_ns = time.monotonic(), plan["messages"][0]["stamp_ns"]
    for one in plan["messages"]:
        message = EventPacket(encoding="evt3", seq=one["seq"], width=plan["width"], height=plan["height"])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(one["stamp_ns"], 10**9)
        message.header.frame_id = "event_camera"
        message.events = array.array("B", bytes.fromhex(one["events"]))
        publisher.publish(message)
        due = begin + (one["stamp_ns"] - first_ns) / 1e9
        rclpy.spin_once(node, timeout_sec=max(0.001, due - time.monotonic()))
    spin_until(lambda: len(received) >= int(sys.argv[2]))
    names = sorted(f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces())
    found = [
        {
            "stamp_ns": one.header.stamp.sec * 10**9 + one.header.stamp.nanosec,
            "frame": one.header.frame_id,
            "covariance": list(one.twist.covariance),
            "linear": [one.twist.twist.linear.x, one.twist.twist.linear.y, one.twist.twist.linear.z],
        }
        for one in received
    ]
    print(json.dumps({"velocities": found, "nodes": names}), flush=True)


if __name__ == "__main__":
    main()
