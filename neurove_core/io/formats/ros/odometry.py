"""Motion of a robot from one topic of a ROS bag: odometry, poses or twists with a header."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from neurove_core.geometry import motion
from neurove_core.geometry.motion import Twists
from neurove_core.io.checked import unread
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Reason, Tally
from neurove_core.io.formats.containers.bags import BagFile
from neurove_core.io.formats.ros import messages
from neurove_core.io.formats.ros.messages import BadMessage
from neurove_core.io.poses import checked_poses

POSE_READERS: Final[dict[str, Callable[..., messages.PoseSample]]] = {
    "nav_msgs/Odometry": messages.odometry,
    "geometry_msgs/PoseStamped": messages.pose,
    "geometry_msgs/PoseWithCovarianceStamped": messages.pose,  # its pose comes before its covariance
}
"""Types whose poses give the twist of the body that they track."""

TWIST_READERS: Final[dict[str, Callable[..., messages.TwistSample]]] = {
    "geometry_msgs/TwistStamped": messages.twist,
    "geometry_msgs/TwistWithCovarianceStamped": messages.twist,
}
"""Types that have the twist itself, in the body's own frame (REP 103: x forward, y left, z up)."""


def motion_topics(bag: BagFile) -> dict[str, str]:
    """Topics of a bag that have the motion of a body, by name, with their types."""
    readable = {*POSE_READERS, *TWIST_READERS}
    return {name: kind for name, kind in sorted(bag.topics.items()) if kind in readable}


def read_motion(bag: BagFile, topic: str, offset_us: int, tally: Tally) -> Twists:
    """Read the twists of a body, in its own frame (x forward, y left, z up).

    The twist of an odometry comes from its poses, because drivers disagree about the frame of its twist field.

    Args:
        bag: of the topic.
        topic: its name, one of `motion_topics`.
        offset_us: ROS time minus sensor time; it is subtracted from all stamps [us].
        tally: counts samples that are damaged, late or not finite; they are left out.

    Raises:
        UnknownSource: the bag has no such topic, its type has no motion, or it has fewer than two samples.
    """
    kind = bag.topics.get(topic)
    if kind in POSE_READERS:
        poses = _samples(bag, topic, POSE_READERS[kind], tally)
        if len(poses) > 1:
            t = np.array([one.stamp_ns // 1000 - offset_us for one in poses], np.int64)
            position = np.array([one.position_m for one in poses])
            turned = np.array([one.orientation for one in poses])
            found = checked_poses(t, position, turned, lambda i: f"{topic}: sample {i}", tally)
            return motion.twists(found)
    elif kind in TWIST_READERS:
        twists = _samples(bag, topic, TWIST_READERS[kind], tally)
        if len(twists) > 1:
            return _ordered(topic, twists, offset_us, tally)
    else:
        known = ", ".join(f"{name} ({type_})" for name, type_ in motion_topics(bag).items()) or "none"
        what = "does not exist" if kind is None else f"has the type {kind}"
        raise UnknownSource(bag.path, f"topic {topic!r} {what}; topics with the motion of a robot: {known}")
    raise UnknownSource(bag.path, f"topic {topic!r} has fewer than two samples")


def _samples(bag: BagFile, topic: str, read: Callable[..., Any], tally: Tally) -> list[Any]:
    """All samples of a topic that can be decoded, up to the place where the bag breaks."""
    found = []
    try:
        for message in bag.messages((topic,), tally=tally):
            try:
                found.append(read(message.data, cdr=bag.cdr))
            except BadMessage as why:
                tally.add(Reason.DAMAGED, message.where, str(why))
    except BrokenRecording as error:
        unread(tally, error)
    return found


def _ordered(topic: str, samples: list[messages.TwistSample], offset_us: int, tally: Tally) -> Twists:
    t = np.array([one.stamp_ns // 1000 - offset_us for one in samples], np.int64)
    twist = np.array([one.twist for one in samples], np.float64)
    finite = np.isfinite(twist).all(1)
    newest = np.maximum.accumulate(np.where(finite, t, np.iinfo(np.int64).min))
    later = np.append(True, t[1:] > newest[:-1])
    for reason, wrong in ((Reason.INVALID, ~finite), (Reason.LATE, finite & ~later)):
        if wrong.any():
            first = int(wrong.argmax())
            tally.add(
                reason, f"{topic}: sample {first}", f"twist {twist[first].tolist()} at {t[first]} us", int(wrong.sum())
            )
    kept = finite & later
    return Twists(t[kept], twist[kept])
