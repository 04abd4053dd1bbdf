"""Estimates -> geometry_msgs/TwistWithCovarianceStamped, without a metre that may be wrong."""

from collections import Counter
from typing import Final, Literal, NamedTuple

import numpy as np

from neurove_core.geometry.mounting import Mounting
from neurove_core.io.formats.ros.types import AXES, Header, TwistMessage
from neurove_protocol import Flag, TwistEstimate
from neurove_protocol.duty import Newest

DOUBTFUL_VARIANCE: Final = 1e6
"""Default variance of each axis of a doubtful part [m2/s2, rad2/s2]: a filter that weighs by covariance ignores it."""

NO_COVARIANCE: Final = "no_covariance"
"""Doubt about an estimate of a model that gives no covariance."""

ALL_DOUBTS: Final = (Flag.UNTRAINED, Flag.UNCALIBRATED, Flag.RESET, Flag.SETTLING, Flag.FROZEN)
"""Flags that put both parts of a twist in doubt."""

LINEAR_DOUBTS: Final = (Flag.UNSCALED, Flag.UNCERTAIN)
"""Flags that put the linear part alone in doubt."""

WHY: Final[dict[str, str]] = {
    Flag.UNTRAINED: "the model is not trained",
    Flag.UNCALIBRATED: "no camera_info or --calibration gives the lens",
    Flag.UNSCALED: "the height of the camera is unknown: give --height",
    Flag.RESET: "the state of the network was reset",
    Flag.SETTLING: "the network is settling",
    Flag.FROZEN: "the camera repeats the same events",
    Flag.UNCERTAIN: "the model is uncertain",
    NO_COVARIANCE: "the model gives no covariance",
}
"""Each doubt in words."""

Doubtful = Literal["covariance", "withhold"]


class Frame(NamedTuple):
    """Frame of the twists."""

    name: str | None = None  # frame_id; None: that of the events, or <stream>_optical_frame
    mounting: Mounting | None = None  # pose of the camera in it; None: the optical frame itself


class Doubts(NamedTuple):
    """Why the parts of an estimate are in doubt; empty if they are not."""

    linear: tuple[str, ...]
    angular: tuple[str, ...]

    @classmethod
    def of(cls, estimate: TwistEstimate) -> "Doubts":
        """The doubts about an estimate."""
        both = [flag.value for flag in ALL_DOUBTS if flag in estimate.flags]
        both += [] if estimate.covariance is not None else [NO_COVARIANCE]
        linear = [flag.value for flag in LINEAR_DOUBTS if flag in estimate.flags]
        return cls((*both, *linear), tuple(both))


class Velocity:
    """Makes the messages of one stream.

    Args:
        stream: its name.
        frame: of the twists.
        doubtful: `covariance`: a doubtful part keeps its numbers, with the variance below and no correlation;
            `withhold`: a message whose linear part is doubtful is not sent.
        variance: of each axis of a doubtful part.
    """

    def __init__(
        self,
        stream: str,
        frame: Frame = Frame(),  # noqa: B008  # it cannot change
        doubtful: Doubtful = "covariance",
        variance: float = DOUBTFUL_VARIANCE,
    ) -> None:
        self._stream, self._frame, self._doubtful, self._variance = stream, frame, doubtful, variance
        self.sent = self.withheld = self.unstamped = 0
        self._rule = Newest()
        self.doubted: Counter[str] = Counter()  # estimates by doubt about the linear part
        self.newest = Doubts((), ())

    def takes(self, estimate: TwistEstimate, now_ns: int) -> bool:
        """Whether an estimate is to be sent: where several nodes can answer the stream, each window is sent once.

        Args:
            estimate: of this stream.
            now_ns: when it arrived, monotonic [ns].
        """
        return self._rule.takes(estimate.term, estimate.start_us, now_ns)

    def message(self, estimate: TwistEstimate, stamp_ns: int | None, frame_id: str) -> TwistMessage | None:
        """The message of an estimate; None if it must not be sent, which is counted.

        Args:
            estimate: of this stream.
            stamp_ns: ROS time of the end of its window [ns]; None: unknown.
            frame_id: of the events.
        """
        doubts = self.newest = Doubts.of(estimate)
        self.doubted.update(doubts.linear)
        if stamp_ns is None:
            self.unstamped += 1
            return None
        if doubts.linear and self._doubtful == "withhold":
            self.withheld += 1
            return None
        twist = np.array(estimate.twist)
        covariance = np.zeros((AXES, AXES)) if estimate.covariance is None else _matrix(estimate.covariance)
        if self._frame.mounting is not None:
            adjoint = self._frame.mounting.adjoint
            twist, covariance = adjoint @ twist, adjoint @ covariance @ adjoint.T
            covariance = (covariance + covariance.T) / 2
        for part, doubt in ((slice(0, 3), doubts.linear), (slice(3, 6), doubts.angular)):
            if doubt:
                covariance[part, :] = covariance[:, part] = 0
                covariance[part, part] = self._variance * np.eye(3)
        self.sent += 1
        header = Header.at(stamp_ns, self._frame.name or frame_id or f"{self._stream}_optical_frame")
        return TwistMessage(header, tuple(twist[:3]), tuple(twist[3:]), tuple(covariance.ravel()))


def _matrix(covariance: tuple[float, ...]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.array(covariance).reshape(AXES, AXES)
