"""Requests and replies of a node: health, models, push, activate, rollback; the status of a stream; the error reply."""

from typing import Annotated, ClassVar, Literal, cast

import msgpack
from pydantic import ConfigDict, Field

from neurove_protocol.codec import Count, Message, Name, Part
from neurove_protocol.errors import EXIT_CONFLICT, EXIT_FAILURE, Conflict, NeuroVEError

Verdict = Literal["ok", "lossy", "stalled", "idle", "unstable", "uncertain"]

STATUS_SCHEMA = "application/msgpack;neurove.status.1"
"""Zenoh Encoding of a StreamStatus."""

CONTROL_SCHEMA = "application/msgpack;neurove.control.1"
"""Zenoh Encoding of control requests, their replies and error replies."""

PROGRESS_SCHEMA = "application/msgpack;neurove.progress.1"
"""Zenoh Encoding of a ProgressReply, which is never the last reply."""

CHUNK_SCHEMA = "application/octet-stream"
"""Zenoh Encoding of a chunk: bytes of a bundle."""

LATENCY_BOUNDS_MS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
"""Upper bounds of the buckets of a LatencyHistogram [ms], inclusive; the last bucket has none."""

MAX_FLAGS = 64
"""Cap of the flags that a StreamStatus counts."""

MAX_LABELS = 16
"""Cap of the labels of a node."""

MAX_CHUNK_BYTES = 1 << 20
MAX_SIGNATURE_BYTES = 1 << 16
MAX_REQUEST_BYTES = 1 << 17
"""Cap of a request."""

MAX_HEALTH_BYTES = 1 << 22
"""Cap of a HealthReply, which has the status of every stream."""

Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
"""sha256 of a bundle, hexadecimal."""

DigestPrefix = Annotated[str, Field(pattern="^[0-9a-f]{8,64}$")]
"""The first 8 or more digits of a digest."""

Labels = Annotated[dict[Name, Name], Field(max_length=MAX_LABELS)]
"""Labels of a node: name -> value; both follow the rule of names."""

SignatureState = Literal["unsigned", "unchecked", "trusted", "untrusted"]
"""No signature; a signature, but this node trusts no key; signed by a trusted key; refused by the node."""


class Request(Message):
    """A request. Unknown fields are refused, so that a misspelt field is not ignored silently."""

    max_bytes: ClassVar[int] = MAX_REQUEST_BYTES

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class HealthRequest(Request):
    """Query the health of a node."""

    what: ClassVar[str] = "health request"


class ModelsRequest(Request):
    """Query the models of a node."""

    what: ClassVar[str] = "models request"


class ActivateRequest(Request):
    """Make another model of the node the active one."""

    what: ClassVar[str] = "activate request"

    model: Annotated[str, Field(min_length=1, max_length=128)]  # name, or the first 8 or more digits of its digest
    expect: DigestPrefix | None = None  # of the active model: conflict if another one is active
    shadow_s: Annotated[float, Field(ge=0, le=3600)] = 0.0  # time in shadow before activation [s]
    canary: Annotated[tuple[Name, ...], Field(strict=False)] = ()  # streams that change; empty means all
    force: Annotated[str, Field(min_length=1, max_length=200)] | None = None  # why no difference may refuse the model

    def encode(self) -> bytes:
        """This request as a msgpack map; without `force` where it is nil, because older nodes refuse unknown fields."""
        return cast(bytes, msgpack.packb(self.model_dump(exclude={"force"} if self.force is None else None)))


class RollbackRequest(Request):
    """Activate the previous model again."""

    what: ClassVar[str] = "rollback request"

    expect: DigestPrefix | None = None  # of the active model: conflict if another one is active


class PushRequest(Request):
    """Offer a bundle; the node pulls it in chunks from the queryable that the digest names."""

    what: ClassVar[str] = "push request"

    digest: Digest
    size: Annotated[int, Field(ge=1, lt=1 << 63)]  # bytes
    name: Annotated[str, Field(min_length=1, max_length=128)]  # for people: the name of the bundle in messages
    signature: Annotated[bytes, Field(max_length=MAX_SIGNATURE_BYTES)] | None = None


class ChunkRequest(Request):
    """Request a piece of the bundle from the client that pushes; the answer is exactly these bytes."""

    what: ClassVar[str] = "chunk request"

    offset: Count
    length: Annotated[int, Field(ge=1, le=MAX_CHUNK_BYTES)]


class Losses(Part):
    """Data that is not part of an estimate, by cause; counted since the stream began."""

    gap_packets: Count = 0  # missing by sequence number: lost before this node
    overload_packets: Count = 0  # dropped here, oldest first, because the queue was full
    duplicate_packets: Count = 0  # a sequence number that arrived before
    out_of_order_packets: Count = 0  # older than a packet already processed
    foreign_packets: Count = 0  # of a second driver on this stream; the first one is followed
    stale_packets: Count = 0  # older than max_age_s when their turn came
    malformed_packets: Count = 0  # refused: they break a rule of the contract
    failed_packets: Count = 0  # an internal error; the log has the traceback
    late_events: Count = 0  # of a window that is already answered
    skipped_windows: Count = 0  # windows in a gap of the sensor's time that is too long to bridge
    shed_windows: Count = 0  # left out whole by an overloaded node, which goes on with the newest data
    restart_windows: Count = 0  # open when the stream restarted, with the events that they had

    def nonzero(self) -> dict[str, int]:
        """The causes with a count above 0."""
        return {name: value for name, value in self.model_dump().items() if value}


class Latency(Part):
    """Percentiles of the recent estimates' latency [ms]: last packet of a window received to estimate published."""

    p50: float
    p95: float
    p99: float


class LatencyHistogram(Part):
    """Latencies of all estimates since the stream began. Unlike percentiles, histograms of several streams add up."""

    counts: Annotated[
        tuple[Count, ...],
        Field(strict=False, min_length=len(LATENCY_BOUNDS_MS) + 1, max_length=len(LATENCY_BOUNDS_MS) + 1),
    ]  # estimates by bucket, not cumulative
    sum_ms: Annotated[float, Field(ge=0)]  # sum of the latencies [ms]


class ImuStatus(Part):
    """The inertial unit of a stream, as far as its packets reach the node."""

    rate_hz: float  # of its newest samples; 0 if no packet arrives
    samples: Count  # received
    lost_packets: Count  # missing by sequence number
    refused_packets: Count  # they break a rule of the contract
    dropped_packets: Count  # by this node, oldest first, because the queue was full
    late_samples: Count  # earlier than others before
    used: bool  # the newest estimate takes its angular part from the gyroscope
    resting: bool  # the camera does not move
    bias_rad_s: Annotated[tuple[float, float, float], Field(strict=False)] | None  # None before the first rest
    bias_sigma_rad_s: float  # standard deviation of each axis of the bias
    offset_ms: float | None  # by which its times are late; None while no turn shows it
    disagrees: bool  # gyroscope and events have turned differently for a while
    problem: str  # what is wrong, in one sentence; empty if nothing is


class StandbyStatus(Part):
    """The part of a node in a stream that several nodes can answer."""

    role: Literal["answers", "follows", "listens", "absent"]
    leader: Name | None  # the node that answers; None if this node knows none
    term: Count  # of that node
    equal: bool  # the newest estimates of this node were those of the leader, bit for bit; only of a node that follows
    other_model: str = ""  # of the newest other leader, where it is another one than that of this node
    draining: bool = False
    followers: Count = 0  # other nodes that serve the stream, where this one answers


class StreamStatus(Message):
    """The verdict and the counters of one stream on one node, since the stream began."""

    what: ClassVar[str] = "stream status"

    node: Name
    stream: Name
    verdict: Verdict
    why: str  # one sentence
    width: Count
    height: Count
    calibrated: bool
    packets_received: Count
    events_received: Count
    windows: Count
    estimates: Count
    resets: Count
    outside_events: Count  # outside the canonical camera's field of view: cropped, not lost
    lost: Losses
    latency_ms: Latency | None  # None before the first estimate
    last_packet_age_s: float
    recovered_packets: Count = 0  # of gap_packets: they arrived later; too late ones are out_of_order_packets too
    uncounted_packets: Count = 0  # all had the sequence number 0, so losses before this node cannot be counted
    refused_cameras: Count = 0  # CameraInfo messages that were refused or do not belong to the sensor
    refusal: str = ""  # why the newest packet or CameraInfo was refused
    unrefined_windows: Count = 0  # answered by the network alone, because the stream was behind; no loss
    imu: ImuStatus | None = None  # None for a stream without an inertial unit
    latency_histogram: LatencyHistogram | None = None  # None from an older node
    flag_counts: Annotated[dict[str, Count], Field(max_length=MAX_FLAGS)] = Field(default_factory=dict)  # estimates
    sigma: Annotated[tuple[float, ...], Field(strict=False, min_length=6, max_length=6)] | None = None  # of the newest
    standby: StandbyStatus | None = None  # None on a node without standby


class ModelInfo(Part):
    """A model of a node, as its bundle describes it."""

    name: str
    digest: str
    trained: bool
    provenance: str  # one line: how it was made
    parameters: Count
    release: Count = 0  # release counter; 0 if its author does not count
    figures: dict[str, float] = Field(default_factory=dict)  # of its validation, with the author's names
    signature: SignatureState = "unsigned"


class HealthReply(Message):
    """The health of a node: `ok` is the verdict, `why` is the reason if it is not ok."""

    what: ClassVar[str] = "health reply"
    max_bytes: ClassVar[int] = MAX_HEALTH_BYTES

    node: Name
    ok: bool
    why: str
    uptime_s: float
    version: str  # of the package
    model: ModelInfo
    epoch: Count
    refused_streams: Count  # streams refused because max_streams is reached
    streams: Annotated[tuple[StreamStatus, ...], Field(strict=False)]
    ready: bool = True  # the node answers the next packet of a stream; false while it shuts down
    change: str = ""  # one sentence about the newest model change: its progress or its result
    rollbacks: Count = 0  # automatic rollbacks since the start
    internal_errors: dict[str, Count] = Field(default_factory=dict)  # place in the node -> number since the start
    dropped_log_lines: Count = 0  # not read in time
    missing_streams: Annotated[tuple[Name, ...], Field(strict=False)] = ()  # expected, and without packets now
    namesakes: Count = 0  # other nodes of this name on the network
    labels: Labels = Field(default_factory=dict)  # of its configuration, such as its site
    form: str = ""  # of the engine that serves the active model, and why


class ModelsReply(Message):
    """The models of a node."""

    what: ClassVar[str] = "models reply"

    node: Name
    active: ModelInfo
    previous: ModelInfo | None
    epoch: Count
    available: Annotated[tuple[ModelInfo, ...], Field(strict=False)]
    unreadable: dict[str, str]  # file name -> why the file is not a model
    staged: Annotated[
        tuple[ModelInfo, ...], Field(strict=False)
    ] = ()  # pushed and verified, neither active nor previous
    partial: dict[str, Count] = Field(default_factory=dict)  # digest of an incomplete push -> bytes stored


class ProgressReply(Message):
    """A step of a running push, activation or rollback; the last reply of the query is its result."""

    what: ClassVar[str] = "progress reply"

    node: Name
    step: str
    text: str


class PushReply(Message):
    """The bundle is on the node, complete and verified."""

    what: ClassVar[str] = "push reply"

    node: Name
    model: ModelInfo
    fetched: Count  # bytes that this push transferred; 0 if the node already had the bundle


class ActivateReply(Message):
    """The change is done: streams use the new model from their next window on."""

    what: ClassVar[str] = "activate reply"

    node: Name
    active: ModelInfo
    previous: ModelInfo  # that it replaced; the active model itself if nothing changed
    epoch: Count
    changed: bool = True  # false: the model was active before, and nothing changed


class ErrorReply(Message):
    """The reason why a request was refused."""

    what: ClassVar[str] = "error reply"

    code: str
    message: str
    details: dict[str, str | int | float | bool | None] = Field(default_factory=dict)

    @classmethod
    def of(cls, error: NeuroVEError) -> "ErrorReply":
        """The reply that reports an error to a peer."""
        return cls(code=error.code, message=error.message, details=error.details)


class PeerError(NeuroVEError):
    """A peer refused our request; `code` and `details` are those of the peer."""

    def __init__(self, reply: ErrorReply) -> None:
        super().__init__(reply.message, **reply.details)
        self.code = reply.code  # type: ignore[misc]  # this class represents any error of a peer
        self.exit_code = EXIT_CONFLICT if reply.code == Conflict.code else EXIT_FAILURE  # type: ignore[misc]
