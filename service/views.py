"""What people see: tables of live estimates, health, models; drawn with rich."""

import threading
import time
from collections import deque
from dataclasses import dataclass, field

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from protocol import Flag, TwistEstimate
from protocol.control import HealthReply, ModelsReply, StreamStatus
from protocol.velocity import AXES
from service.latency import latency

_VERDICT_STYLE = {"ok": "green", "lossy": "yellow", "stalled": "bold red", "idle": "dim"}
_RATE_ESTIMATES = 40
_BAR = 9


@dataclass
class Heard:
    """What a consumer has heard of one stream."""

    count: int = 0
    missed: int = 0
    last: TwistEstimate | None = None
    status: StreamStatus | None = None
    arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=_RATE_ESTIMATES))
    latencies_ms: list[float] = field(default_factory=list)
    first_at: float = 0.0
    last_at: float = 0.0
    epoch_changes: int = 0

    @property
    def rate_hz(self) -> float:
        """Estimates per second, over the newest ones."""
        span_s = self.arrivals[-1] - self.arrivals[0] if len(self.arrivals) > 1 else 0.0
        return (len(self.arrivals) - 1) / span_s if span_s > 0 else 0.0

    @property
    def mean_rate_hz(self) -> float:
        """Estimates per second, from the first to the last."""
        span_s = self.last_at - self.first_at
        return (self.count - 1) / span_s if self.count > 1 and span_s > 0 else 0.0


class Board:
    """What a consumer has heard of all streams; fed on Zenoh's thread, drawn on another."""

    def __init__(self, keep_latencies: int = 100_000) -> None:
        self._lock = threading.Lock()
        self._heard: dict[str, Heard] = {}
        self._keep = keep_latencies

    def on_estimate(self, estimate: TwistEstimate) -> None:
        """Take an estimate in."""
        now = time.monotonic()
        with self._lock:
            heard = self._heard.setdefault(estimate.stream, Heard())
            if heard.last is not None and estimate.seq > heard.last.seq + 1:
                heard.missed += estimate.seq - heard.last.seq - 1
            heard.first_at = heard.first_at or now
            heard.last_at = now
            heard.count += 1
            heard.last = estimate
            heard.arrivals.append(now)
            if len(heard.latencies_ms) < self._keep:
                heard.latencies_ms.append(estimate.trace.latency_ms)

    def on_status(self, status: StreamStatus) -> None:
        """Take a status in."""
        with self._lock:
            self._heard.setdefault(status.stream, Heard()).status = status

    def of(self, stream: str) -> Heard:
        """What was heard of one stream; empty where nothing was."""
        with self._lock:
            return self._heard.get(stream, Heard())

    def streams(self) -> dict[str, Heard]:
        """What was heard of every stream."""
        with self._lock:
            return dict(sorted(self._heard.items()))

    def __rich__(self) -> RenderableType:
        streams = self.streams()
        if not streams:
            return Text("waiting for estimates ...", style="dim")
        return Group(*(_stream_panel(name, heard) for name, heard in streams.items()))


def _stream_panel(name: str, heard: Heard) -> RenderableType:
    status, last = heard.status, heard.last
    table = Table(title=_title(name, heard), title_justify="left", expand=False, pad_edge=False)
    for axis in ("", *AXES):
        table.add_column(axis, justify="right", min_width=_BAR)
    if last is not None:
        linear, angular = last.twist[:3], last.twist[3:]
        values = [f"{value:+.3f}" for value in (*linear, *angular)]
        table.add_row("", *values, style="bold")
        table.add_row("", *("m/s",) * 3, *("rad/s",) * 3, style="dim")
        bars = [*(_bar(value, 2.0) for value in linear), *(_bar(value, 2.0) for value in angular)]
        table.add_row("", *bars)
    return Group(table, _footer(heard, status))


def _title(name: str, heard: Heard) -> Text:
    status, last = heard.status, heard.last
    title = Text(f"{name}  ", style="bold")
    if status is not None:
        title.append(f"{status.verdict}  ", style=_VERDICT_STYLE[status.verdict])
        title.append(f"{status.width}x{status.height}  ", style="default")
    if last is not None:
        title.append(f"model {last.model}  ", style="default")
        if Flag.UNTRAINED in last.flags:
            title.append("UNTRAINED: the numbers mean nothing", style="bold magenta")
    return title


def _footer(heard: Heard, status: StreamStatus | None) -> Text:
    text = Text(style="dim")
    numbers = latency(heard.latencies_ms[-_RATE_ESTIMATES:])
    if numbers is not None:
        text.append(f"{heard.rate_hz:.1f} estimates/s, latency p50 {numbers.p50:.1f} ms p99 {numbers.p99:.1f} ms")
    if status is not None:
        text.append(f", {status.packets_received:,} packets, {status.events_received:,} events")
        lost = status.lost.nonzero()
        told = ", ".join(f"{key} {value}" for key, value in lost.items()) or "nothing"
        text.append(f"\nlost: {told}", style="yellow" if lost else "dim")
    if heard.last is not None:
        text.append(f"\nflags: {', '.join(heard.last.flags) or 'none'}")
    return text


def _bar(value: float, full: float) -> str:
    """A signed bar around the middle of a cell."""
    half = _BAR // 2
    length = min(half, round(abs(value) / full * half))
    left = "━" * length if value < 0 else ""
    right = "━" * length if value > 0 else ""
    return f"{left:>{half}}│{right:<{half}}"


def health_table(replies: list[HealthReply]) -> RenderableType:
    """Nodes and their streams."""
    parts: list[RenderableType] = []
    for reply in replies:
        verdict = Text("ok" if reply.ok else "not ok", style="bold green" if reply.ok else "bold red")
        model = f"{reply.model.name} ({'trained' if reply.model.trained else 'untrained'}, {reply.model.digest[:12]})"
        about = f": {reply.why}. Up {reply.uptime_s:.0f} s, version {reply.version}, model {model}, epoch {reply.epoch}"
        parts.append(Text.assemble((f"{reply.node} ", "bold"), verdict, about))
        if reply.refused_streams:
            parts.append(Text(f"{reply.refused_streams} streams refused: the node serves all it may", style="yellow"))
        if reply.streams:
            parts.append(_streams_table(reply.streams))
    return Group(*parts)


def _streams_table(streams: tuple[StreamStatus, ...]) -> Table:
    table = Table("stream", "verdict", "sensor", "packets", "events", "estimates", "p50 ms", "p99 ms", "lost")
    for status in streams:
        numbers = status.latency_ms
        lost = ", ".join(f"{name} {count}" for name, count in status.lost.nonzero().items())
        table.add_row(
            status.stream,
            Text(status.verdict, style=_VERDICT_STYLE[status.verdict]),
            f"{status.width}x{status.height}{'' if status.calibrated else ' uncalibrated'}",
            f"{status.packets_received:,}",
            f"{status.events_received:,}",
            f"{status.estimates:,}",
            f"{numbers.p50:.1f}" if numbers else "-",
            f"{numbers.p99:.1f}" if numbers else "-",
            lost or "nothing",
        )
    return table


def models_table(replies: list[ModelsReply]) -> RenderableType:
    """Models of every node, the active one marked."""
    parts: list[RenderableType] = []
    for reply in replies:
        table = Table(
            "", "model", "digest", "trained", "parameters", "made by", title=f"{reply.node}, epoch {reply.epoch}"
        )
        previous = reply.previous.digest if reply.previous else ""
        for info in reply.available:
            mark = "active" if info.digest == reply.active.digest else "previous" if info.digest == previous else ""
            trained = "yes" if info.trained else "no"
            table.add_row(mark, info.name, info.digest[:12], trained, f"{info.parameters:,}", info.provenance)
        parts.append(table)
        parts.extend(Text(f"{name}: {why}", style="yellow") for name, why in reply.unreadable.items())
    return Group(*parts)
