"""Requests and replies of a node: health, models, push, activate, rollback; the status of a stream; the error reply."""

from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from neurove_protocol.codec import Count, Message, Name, Part
from neurove_protocol.errors import EXIT_CONFLICT, EXIT_FAILURE, Conflict, NeuroVEError

Verdict = Literal["ok", "lossy", "stalled", "idle"]

STATUS_SCHEMA = "application/msgpack;neurove.status.1"
"""Zenoh Encoding of a StreamStatus."""

CONTROL_SCHEMA = "application/msgpack;neurove.control.1"
"""Zenoh Encoding of control requests, their replies and error replies."""

PROGRESS_SCHEMA = "application/msgpack;neurove.progress.1"
"""Zenoh Encoding of a ProgressReply: a reply that is not the last one."""

CHUNK_SCHEMA = "application/octet-stream"
"""Zenoh Encoding of a chunk: bytes of a bundle, as they are."""

MAX_CHUNK_BYTES = 1 << 20
MAX_SIGNATURE_BYTES = 1 << 16

Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
"""sha256 of a bundle, hexadecimal."""

DigestPrefix = Annotated[str, Field(pattern="^[0-9a-f]{8,64}$")]
"""The first 8 or more digits of a digest."""

SignatureState = Literal["unsigned", "unchecked", "trusted", "untrusted"]
"""None came; one came and this node trusts no key; of a key that it trusts; refused by the node."""


class Request(Message):
    """A request: an unknown field is refused, for a misspelt one would be ignored in silence."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class HealthRequest(Request):
    """Ask a node how it is."""

    what: ClassVar[str] = "health request"


class ModelsRequest(Request):
    """Ask a node for its models."""

    what: ClassVar[str] = "models request"


class ActivateRequest(Request):
    """Make another model of the node the active one."""

    what: ClassVar[str] = "activate request"

    model: Annotated[str, Field(min_length=1, max_length=128)]  # name, or the first 8 or more digits of its digest
    expect: DigestPrefix | None = None  # of the active model: refused with conflict where it is another
    shadow_s: Annotated[float, Field(ge=0, le=3600)] = 0.0  # runs beside the active model for so long first
    canary: Annotated[tuple[Name, ...], Field(strict=False)] = ()  # streams that change; none means all


class RollbackRequest(Request):
    """Make the model before the active one again."""

    what: ClassVar[str] = "rollback request"

    expect: DigestPrefix | None = None  # of the active model: refused with conflict where it is another


class PushRequest(Request):
    """There is a bundle to be pulled, in chunks, from the queryable that its digest names."""

    what: ClassVar[str] = "push request"

    digest: Digest
    size: Annotated[int, Field(ge=1, lt=1 << 63)]  # bytes
    name: Annotated[str, Field(min_length=1, max_length=128)]  # for people: what errors call it
    signature: Annotated[bytes, Field(max_length=MAX_SIGNATURE_BYTES)] | None = None


class ChunkRequest(Request):
    """Ask who pushes for a piece of the bundle; the answer is that many bytes of it, as they are."""

    what: ClassVar[str] = "chunk request"

    offset: Count
    length: Annotated[int, Field(ge=1, le=MAX_CHUNK_BYTES)]


class Losses(Part):
    """Everything that did not become part of an estimate, by cause; counted since the stream began."""

    gap_packets: Count = 0  # missing by sequence number: lost on the way
    overload_packets: Count = 0  # dropped here, oldest first, because the queue was full
    duplicate_packets: Count = 0  # a sequence number that came before
    out_of_order_packets: Count = 0  # older than one already taken
    malformed_packets: Count = 0  # refused: not what the contract says
    failed_packets: Count = 0  # a fault of ours while working on it; the log has the trace back
    late_events: Count = 0  # of a window that was already answered
    skipped_windows: Count = 0  # windows in a hole of the sensor's time too long to bridge

    def nonzero(self) -> dict[str, int]:
        """The causes that happened, with their counts."""
        return {name: value for name, value in self.model_dump().items() if value}


class Latency(Part):
    """Percentiles of the recent estimates' latency [ms]: last packet of a window received to estimate published."""

    p50: float
    p95: float
    p99: float


class StreamStatus(Message):
    """One stream on one node: its verdict and its counters since the stream began."""

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
    outside_events: Count  # seen by pixels that look past the canonical camera's field of view: no loss, a crop
    lost: Losses
    latency_ms: Latency | None  # none before the first estimate
    last_packet_age_s: float


class ModelInfo(Part):
    """A model that a node has, as its bundle describes it."""

    name: str
    digest: str
    trained: bool
    provenance: str  # one line: where it comes from
    parameters: Count
    release: Count = 0  # counts up; 0 where its maker does not count
    figures: dict[str, float] = Field(default_factory=dict)  # of its validation, as its maker names them
    signature: SignatureState = "unsigned"


class HealthReply(Message):
    """How a node is: `ok` is the verdict, `why` gives the reason where it is not."""

    what: ClassVar[str] = "health reply"

    node: Name
    ok: bool
    why: str
    uptime_s: float
    version: str  # of the package
    model: ModelInfo
    epoch: Count
    refused_streams: Count  # streams not served, because the node serves as many as it is configured to
    streams: Annotated[tuple[StreamStatus, ...], Field(strict=False)]
    ready: bool = True  # the next packet of a stream gets its estimate: false while the node ends
    change: str = ""  # one sentence on the newest change of model: what is under way, or how it ended
    rollbacks: Count = 0  # models that were taken back by themselves since the start


class ModelsReply(Message):
    """The models of a node."""

    what: ClassVar[str] = "models reply"

    node: Name
    active: ModelInfo
    previous: ModelInfo | None
    epoch: Count
    available: Annotated[tuple[ModelInfo, ...], Field(strict=False)]
    unreadable: dict[str, str]  # file name -> why it is no model
    staged: Annotated[
        tuple[ModelInfo, ...], Field(strict=False)
    ] = ()  # pushed and verified, neither active nor previous
    partial: dict[str, Count] = Field(default_factory=dict)  # digest of a push that was cut -> bytes that are here


class ProgressReply(Message):
    """A step of a push, an activation or a rollback that still goes on; the last reply of the query is its result."""

    what: ClassVar[str] = "progress reply"

    node: Name
    step: str
    text: str


class PushReply(Message):
    """The bundle is on the node, whole and verified."""

    what: ClassVar[str] = "push reply"

    node: Name
    model: ModelInfo
    fetched: Count  # bytes that this push moved; 0 where the node had it


class ActivateReply(Message):
    """The change was made: streams answer with the new model from their next window on."""

    what: ClassVar[str] = "activate reply"

    node: Name
    active: ModelInfo
    previous: ModelInfo
    epoch: Count


class ErrorReply(Message):
    """Why a request was refused."""

    what: ClassVar[str] = "error reply"

    code: str
    message: str
    details: dict[str, str | int | float | bool | None] = Field(default_factory=dict)

    @classmethod
    def of(cls, error: NeuroVEError) -> "ErrorReply":
        """The reply that tells a peer about an error."""
        return cls(code=error.code, message=error.message, details=error.details)


class PeerError(NeuroVEError):
    """A peer refused our request; `code` and details are the peer's."""

    def __init__(self, reply: ErrorReply) -> None:
        super().__init__(reply.message, **reply.details)
        self.code = reply.code  # type: ignore[misc]  # this class stands for any peer's error
        self.exit_code = EXIT_CONFLICT if reply.code == Conflict.code else EXIT_FAILURE  # type: ignore[misc]
