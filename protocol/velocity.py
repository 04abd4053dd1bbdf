"""Twist, TwistEstimate and its quality flags: what the service publishes for a stream, once per window."""

import math
from enum import StrEnum
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from neurove_protocol.codec import Count, Int64, Message, Name, Part
from neurove_protocol.errors import InvalidField

SCHEMA = "application/msgpack;neurove.velocity.1"
"""Zenoh Encoding of a TwistEstimate."""

AXES = ("vx", "vy", "vz", "wx", "wy", "wz")
"""Order of a twist's six numbers: linear [m/s], then angular [rad/s]."""


Source = Literal["network", "refined", "gyro"]
"""Origin of an estimate's angular velocity: the network alone, contrast maximisation of the events, or a gyroscope."""


class Flag(StrEnum):
    """Quality flags of an estimate. Readers ignore flags that they do not know."""

    UNTRAINED = "untrained"  # the model is not trained; its numbers have no meaning
    UNCALIBRATED = "uncalibrated"  # no CameraInfo; the sensor is scaled linearly onto the canonical camera
    UNSCALED = "unscaled"  # no camera height; the linear part is up to scale and assumes 1 m
    SETTLING = "settling"  # the recurrent state is younger than the model's settling time
    RESET = "reset"  # the recurrent state was reset in this window
    SENSOR_CHANGED = "sensor_changed"  # cause of the reset: the stream's geometry or CameraInfo changed
    GAP = "gap"  # packets of this window are missing, whatever the cause
    OVERLOAD = "overload"  # the node dropped packets of this window, or skipped windows before it: it cannot keep up
    LATE = "late"  # published long after the end of the window, see HostTime
    LOW_ACTIVITY = "low_activity"  # fewer events than the model needs to see motion
    SATURATED = "saturated"  # the event count of a cell reached its maximum
    FROZEN = "frozen"  # the camera repeats the same events
    GYRO_DISAGREES = "gyro_disagrees"  # gyroscope and events turn differently; the gyroscope is not used
    UNCERTAIN = "uncertain"  # sigma of the linear or the angular part is above its relative and its absolute bound


class Twist(NamedTuple):
    """A rigid body's velocity in the camera's optical frame (x right, y down, z forward)."""

    vx: float  # [m/s]
    vy: float
    vz: float
    wx: float  # [rad/s]
    wy: float
    wz: float


def _fits_a_covariance(values: tuple[float, ...]) -> tuple[float, ...]:
    """A 6x6 matrix, row by row, that is symmetric and whose variances are not negative."""
    for i in range(_AXES):
        if values[i * _AXES + i] < 0:
            raise PydanticCustomError("covariance", "the variance of an axis must not be negative")
        for j in range(i):
            if values[i * _AXES + j] != values[j * _AXES + i]:
                raise PydanticCustomError("covariance", "a covariance must be symmetric")
    return values


_AXES = len(AXES)
Covariance = Annotated[
    tuple[float, ...],
    Field(strict=False, min_length=_AXES * _AXES, max_length=_AXES * _AXES),
    AfterValidator(_fits_a_covariance),
]
"""6x6 covariance of a twist, row by row, in the layout of geometry_msgs/TwistWithCovariance."""


class Trace(Part):
    """Time stamps of one estimate on the service's monotonic clock [ns]; only differences have a meaning."""

    received_ns: Int64  # the packet that completed the window arrived from the network
    queued_ns: Int64  # the stream's worker took it out of its queue
    computed_ns: Int64  # the network finished
    published_ns: Int64  # the estimate was passed to Zenoh

    @property
    def latency_ms(self) -> float:
        """From receiving the last packet of the window to publishing its estimate [ms]."""
        return (self.published_ns - self.received_ns) / 1e6


class HostTime(Part):
    """When the window ended on the clocks of the node, as far as the node can know.

    The node learns the offset between the clock of the sensor and its own from the packets that arrive quickest. A
    delay that all packets share cannot be seen, so the true end of the window is at `end_ns` or earlier.
    """

    end_ns: Int64  # end of the window on the node's wall clock [ns since 1970-01-01 UTC]
    uncertainty_ns: Count  # typical delay of a packet beyond the quickest one
    age_ns: Count  # from the end of the window to publishing its estimate


class TwistEstimate(Message):
    """The estimate of one window: n twists, one per chronological bin (the paper's [n, 6])."""

    what: ClassVar[str] = "twist estimate"

    stream: Name
    seq: Count  # counts estimates of this stream from 0, without gaps
    start_us: Int64  # window [start_us, end_us), sensor clock
    end_us: Int64
    bin_end_us: Annotated[tuple[Int64, ...], Field(strict=False, min_length=1)]
    twists: Annotated[tuple[Twist, ...], Field(strict=False, min_length=1)]
    frame_id: str = "camera_optical"
    model: str  # name of the model
    digest: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]  # sha256 of its bundle
    epoch: Count  # counts model changes of the node
    events: Count  # events of this window, all of the sensor
    flags: Annotated[tuple[str, ...], Field(strict=False)] = ()
    covariance: Covariance | None = None  # of each twist; None if the model has no calibrated uncertainty
    trace: Trace
    node: Name | None = None  # the node that made the estimate
    host: HostTime | None = None  # None if the driver gives no time to learn from
    source: Source = "network"  # of the angular part
    term: Count | None = None  # of the node that answers, see README; None from a node that has no standby

    @model_validator(mode="after")
    def _one_twist_per_bin(self) -> Self:
        if len(self.twists) != len(self.bin_end_us):
            raise InvalidField(self.what, "twists", len(self.twists), f"one for each of {len(self.bin_end_us)} bins")
        if self.end_us <= self.start_us:
            raise InvalidField(self.what, "end_us", self.end_us, f"must be after start_us={self.start_us}")
        return self

    @property
    def twist(self) -> Twist:
        """The newest twist, of the last bin."""
        return self.twists[-1]

    @property
    def sigma(self) -> Twist | None:
        """Standard deviation of each axis; None without a covariance."""
        if self.covariance is None:
            return None
        return Twist(*(math.sqrt(self.covariance[i * _AXES + i]) for i in range(_AXES)))
