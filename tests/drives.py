"""A short simulated drive of a robot as a ROS bag: events, a lens, odometry of its base, and twists."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Twists
from neurove_core.geometry.mounting import Mounting
from neurove_core.sources import open_source
from tests import ros_bags

PITCH_DEG, HEIGHT_M, POSITION_M = 10.0, 0.4, (0.3, 0.0, 0.4)
STAMP_NS = 1_700_000_000 * 10**9
EVENTS, ODOM, TWIST, INFO = "/cam/events", "/odom", "/twist", "/cam/camera_info"


class Drive(NamedTuple):
    """What a robot did, and its bag."""

    bag: Path
    base: Twists  # of the base, on the clock of the events
    camera: Twists


def base_of(camera: Twists, mounting: Mounting) -> Twists:
    """Twists of the base of a robot from those of its camera."""
    w = camera.twist[:, 3:] @ mounting.rotation.T
    v = camera.twist[:, :3] @ mounting.rotation.T - np.cross(w, mounting.position_m)
    return Twists(camera.t, np.concatenate([v, w], 1))


def poses_of(base: Twists, every: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [us], positions and quaternions of a base that moves by these twists."""
    q, p, found = np.array([[0.0, 0, 0, 1]]), np.zeros((1, 3)), []
    steps = np.diff(base.t, append=base.t[-1]) / 1e6
    for i, (t, step, twist) in enumerate(zip(base.t, steps, base.twist, strict=True)):
        if i % every == 0:
            found.append((t, p[0], q[0]))
        p = p + rotations.turn(q, twist[None, :3] * step)
        q = rotations.product(q, rotations.exp(twist[None, 3:] * step))
    t, position, orientation = zip(*found, strict=True)
    return np.array(t), np.array(position), np.array(orientation)


def make_drive(
    folder: Path, seconds: float, seed: int, ros: int = 1, *, mcap: bool = False, late_s: float = 0
) -> Drive:
    """Simulate a drive with a lens and a height that the default model does not expect, and write its bag."""
    url = f"sim://street?seed={seed}&seconds={seconds}&camera=pinhole:24x18:55&height={HEIGHT_M}&pitch={PITCH_DEG}"
    source = open_source(url)
    camera = source.twists()
    assert camera is not None
    base = base_of(camera, Mounting.from_angles(pitch_deg=PITCH_DEG, position_m=POSITION_M))
    store = ros_bags.Store(ros)
    messages = []
    for seq, part in enumerate(source.chunks()):
        for first in range(0, part.n, 2000):
            piece = part.span(first, min(first + 2000, part.n))
            ns = STAMP_NS + int(piece.t[0]) * 1000
            rows = np.zeros(piece.n, [("dt", "<u4"), ("x", "<u2"), ("y", "<u2")])
            rows["dt"] = (piece.t - piece.t[0]) * 1000
            rows["x"], rows["y"] = piece.x, piece.y | piece.p.astype(np.uint16) << 15
            packet = ros_bags.packet(
                store,
                rows.tobytes(),
                ns=ns,
                seq=seq,
                base_ns=int(piece.t[0]) * 1000,
                encoding="mono",
                sensor=source.sensor,
            )
            messages.append((EVENTS, ns, packet))
    messages += _motion(store, base, late_s)
    info = source.camera("c")
    assert info is not None
    messages.append((INFO, STAMP_NS, _lens(store, info)))
    path = folder / ("drive.bag" if ros == 1 else "drive")
    ros_bags.write_bag(path, store, sorted(messages, key=lambda one: one[1]), mcap=mcap)
    return Drive(path, base, camera)


def _motion(store, base: Twists, late_s: float) -> list:
    found = []
    zero = np.zeros(36)
    point, quaternion = "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion"
    vector = "geometry_msgs/msg/Vector3"

    def twist(six):
        return store.of("geometry_msgs/msg/Twist", store.of(vector, *six[:3]), store.of(vector, *six[3:]))

    for t, position, orientation in zip(*poses_of(base, 20), strict=True):
        ns = STAMP_NS + int(t) * 1000 + round(late_s * 1e9)
        pose = store.of("geometry_msgs/msg/Pose", store.of(point, *position), store.of(quaternion, *orientation))
        covariant = store.of("geometry_msgs/msg/PoseWithCovariance", pose, zero)
        rest = store.of("geometry_msgs/msg/TwistWithCovariance", twist([0.0] * 6), zero)
        found.append((ODOM, ns, store.of(ros_bags.ODOMETRY, store.header(ns, "odom"), "base_link", covariant, rest)))
    for t, six in zip(base.t[::20], base.twist[::20], strict=True):
        ns = STAMP_NS + int(t) * 1000 + round(late_s * 1e9)
        found.append((TWIST, ns, store.of("geometry_msgs/msg/TwistStamped", store.header(ns), twist(six.tolist()))))
    return found


def _lens(store, info):
    matrix = np.array([info.fx, 0, info.cx, 0, info.fy, info.cy, 0, 0, 1.0])
    region = store.of("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    fields = (info.height, info.width, "plumb_bob", np.zeros(5), matrix, np.eye(3).ravel(), np.zeros(12), 0, 0, region)
    return store.of(ros_bags.CAMERA, store.header(STAMP_NS), *fields)
