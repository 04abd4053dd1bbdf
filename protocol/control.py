"""Requests and replies of a node: health, models, activate; the status of a stream; and the error reply of all."""

from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from protocol.codec import Count, Message, Name, Part
from protocol.errors import NeuroVEError

Verdict = Literal["ok", "lossy", "stalled", "idle"]

STATUS_SCHEMA = "application/msgpack;neurove.status.1"
"""Zenoh Encoding of a StreamStatus."""

CONTROL_SCHEMA = "application/msgpack;neurove.control.1"
"""Zenoh Encoding of control requests, their replies and error replies."""


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
