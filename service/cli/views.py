"""Tables for people: live estimates, health, models, recordings; drawn with rich."""

import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from neurove_protocol import Flag, Twist, TwistEstimate
from neurove_protocol.control import HealthReply, ModelsReply, StreamStatus
from neurove_protocol.velocity import AXES
from neurove_service.latency import latency

if TYPE_CHECKING:
    from neurove_core.io.summary import Summary

_VERDICT_STYLE = {
    "ok": "green",
    "lossy": "yellow",
    "stalled": "bold red",
    "idle": "dim",
    "unstable": "bold red",
    "uncertain": "yellow",
}
_RATE_ESTIMATES = 40
_BLOCKS = "▁▂▃▄▅▆▇█"
_PLAIN: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0), "header_style": "dim"}
_HISTORY = 26
_HISTORY_WITH_SIGMA = 19
_WIDTH = 98


@dataclass
class Received:
    """The estimates and the status that a consumer has received of one stream."""

    count: int = 0
    missed: int = 0
    last: TwistEstimate | None = None
    status: StreamStatus | None = None
    arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=_RATE_ESTIMATES))
    twists: deque[Twist] = field(default_factory=lambda: deque(maxlen=_HISTORY))
    latencies_ms: list[float] = field(default_factory=list)
    first_at: float = 0.0
    last_at: float = 0.0

    @property
    def rate_hz(self) -> float:
        """Estimates per second, over the newest estimates."""
        span_s = self.arrivals[-1] - self.arrivals[0] if len(self.arrivals) > 1 else 0.0
        return (len(self.arrivals) - 1) / span_s if span_s > 0 else 0.0

    @property
    def mean_rate_hz(self) -> float:
        """Estimates per second, from the first to the last."""
        span_s = self.last_at - self.first_at
        return (self.count - 1) / span_s if self.count > 1 and span_s > 0 else 0.0


class Board:
    """All streams that a consumer receives; filled on Zenoh's thread, drawn on another."""

    def __init__(self, keep_latencies: int = 100_000) -> None:
        self._lock = threading.Lock()
        self._streams: dict[str, Received] = {}
        self._keep = keep_latencies

    def on_estimate(self, estimate: TwistEstimate) -> None:
        """Add an estimate."""
        now = time.monotonic()
        with self._lock:
            received = self._streams.setdefault(estimate.stream, Received())
            if received.last is not None and estimate.seq > received.last.seq + 1:
                received.missed += estimate.seq - received.last.seq - 1
            received.first_at = received.first_at or now
            received.last_at = now
            received.count += 1
            received.last = estimate
            received.twists.append(estimate.twist)
            received.arrivals.append(now)
            if len(received.latencies_ms) < self._keep:
                received.latencies_ms.append(estimate.trace.latency_ms)

    def on_status(self, status: StreamStatus) -> None:
        """Replace the status of a stream."""
        with self._lock:
            self._streams.setdefault(status.stream, Received()).status = status

    def of(self, stream: str) -> Received:
        """What was received of one stream; empty if nothing was."""
        with self._lock:
            return self._streams.get(stream, Received())

    def streams(self) -> dict[str, Received]:
        """What was received of every stream."""
        with self._lock:
            return dict(sorted(self._streams.items()))

    def __rich__(self) -> RenderableType:
        streams = self.streams()
        if not streams:
            return Text("waiting for estimates ...", style="dim")
        return Group(*(_stream_panel(name, received) for name, received in streams.items()))


def _stream_panel(name: str, received: Received) -> RenderableType:
    grid = Table.grid(padding=(0, 2))
    for left, right in zip(range(3), range(3, 6), strict=True):
        grid.add_row(*_axis(received, left), *_axis(received, right))
    return Panel(
        Group(grid, _footer(received, received.status)), title=_title(name, received), title_align="left", width=_WIDTH
    )


def _axis(received: Received, axis: int) -> tuple[Text, Text, Text]:
    """Name, newest value with its unit, and the newest estimates as a line of blocks."""
    unit = "m/s" if axis < 3 else "rad/s"
    values = [twist[axis] for twist in received.twists]
    sigma = received.last.sigma if received.last is not None else None
    spread = f" ±{_short(sigma[axis])}" if sigma is not None else ""
    newest = f"{values[-1]:+7.3f}{spread} {unit:5}" if values else ""
    shown = values if sigma is None else values[-_HISTORY_WITH_SIGMA:]
    return Text(AXES[axis], style="bold"), Text(newest), Text(_line(shown), style="cyan")


def _short(sigma: float) -> str:
    """A standard deviation in five characters."""
    return f"{sigma:5.3f}" if sigma < 9.9995 else f"{min(sigma, 99999):5.0f}"


def _line(values: list[float]) -> str:
    """Values as a row of blocks, scaled between their minimum and maximum."""
    low, high = min(values, default=0.0), max(values, default=0.0)
    scale = (len(_BLOCKS) - 1) / (high - low) if high > low else 0.0
    return "".join(_BLOCKS[round((value - low) * scale)] for value in values)


def _title(name: str, received: Received) -> Text:
    status, last = received.status, received.last
    title = Text(f"{name}  ", style="bold")
    if status is not None:
        title.append(f"{status.verdict}  ", style=_VERDICT_STYLE[status.verdict])
        title.append(f"{status.width}x{status.height}  ", style="default")
    if last is not None:
        title.append(f"model {last.model}  ", style="default")
        if Flag.UNTRAINED in last.flags:
            title.append("UNTRAINED: the estimates have no meaning", style="bold magenta")
    return title


def _footer(received: Received, status: StreamStatus | None) -> Text:
    text = Text(style="dim")
    numbers = latency(received.latencies_ms[-_RATE_ESTIMATES:])
    if numbers is not None:
        text.append(f"{received.rate_hz:.1f} estimates/s, latency p50 {numbers.p50:.1f} ms p99 {numbers.p99:.1f} ms")
    if status is not None:
        text.append(f", {status.packets_received:,} packets, {status.events_received:,} events")
        lost = status.lost.nonzero()
        causes = ", ".join(f"{key} {value}" for key, value in lost.items()) or "nothing"
        text.append(f"\nlost: {causes}", style="yellow" if lost else "dim")
    if received.last is not None:
        text.append(f"\nflags: {', '.join(received.last.flags) or 'none'}")
    return text


def health_table(replies: list[HealthReply]) -> RenderableType:
    """Nodes and their streams."""
    parts: list[RenderableType] = []
    for reply in replies:
        verdict = Text("ok" if reply.ok else "not ok", style="bold green" if reply.ok else "bold red")
        model = f"{reply.model.name} ({'trained' if reply.model.trained else 'untrained'}, {reply.model.digest[:12]})"
        about = f": {reply.why}. Up {reply.uptime_s:.0f} s, version {reply.version}, model {model}, epoch {reply.epoch}"
        parts.append(Text.assemble((f"{reply.node} ", "bold"), verdict, about))
        if not reply.ready:
            parts.append(Text("not ready: the node shuts down", style="yellow"))
        if reply.change:
            parts.append(Text(f"model change: {reply.change}. Automatic rollbacks: {reply.rollbacks}", style="dim"))
        if reply.streams:
            parts.append(_streams_table(reply.streams))
    return Group(*parts)


def _streams_table(streams: tuple[StreamStatus, ...]) -> Table:
    table = Table("stream", "verdict", "sensor", "packets", "events", "estimates", "p50/p99 ms", "lost", **_PLAIN)
    for status in streams:
        numbers = status.latency_ms
        lost = ", ".join(f"{name} {count}" for name, count in status.lost.nonzero().items())
        table.add_row(
            status.stream,
            Text(status.verdict, style=_VERDICT_STYLE[status.verdict]),
            f"{status.width}x{status.height}{'' if status.calibrated else ' *'}",
            f"{status.packets_received:,}",
            f"{status.events_received:,}",
            f"{status.estimates:,}",
            f"{numbers.p50:.1f}/{numbers.p99:.1f}" if numbers else "-",
            lost or "nothing",
        )
    if not all(status.calibrated for status in streams):
        table.caption = "* uncalibrated: no CameraInfo of this sensor"
        table.caption_justify = "left"
    return table


def survey_table(summary: "Summary") -> RenderableType:
    """The contents of a recording."""
    table = Table(show_header=False, **_PLAIN)
    table.add_row("sensor", str(summary.sensor))
    on = "" if summary.on_fraction is None else f", {100 * summary.on_fraction:.1f} % ON"
    table.add_row("events", f"{summary.events:,}{on}")
    if summary.first_us is not None and summary.last_us is not None:
        span = f"{summary.first_us / 1e6:.6f} to {summary.last_us / 1e6:.6f} s of the sensor's clock"
        table.add_row("duration", f"{summary.duration_s:.6f} s ({span})")
    if summary.mean_rate_hz is not None and summary.peak_rate_hz is not None:
        rates = f"{summary.mean_rate_hz / 1e3:,.1f} k events/s, {summary.peak_rate_hz / 1e3:,.1f} in the busiest 10 ms"
        table.add_row("rate", rates)
    table.add_row("streams", ", ".join(summary.streams))
    for name, count in (("frames", summary.frames), ("triggers", summary.triggers)):
        if count:
            table.add_row(name, f"{count:,}")
    if summary.imu is not None:
        rate = "" if summary.imu.rate_hz is None else f" at {summary.imu.rate_hz:,.1f} Hz"
        table.add_row("imu", f"{summary.imu.samples:,} samples{rate}")
        table.add_row("  gyro", _spread(summary.imu.gyro_mean_rad_s, summary.imu.gyro_std_rad_s, "rad/s"))
        table.add_row("  accelerometer", _spread(summary.imu.accel_mean_m_s2, summary.imu.accel_std_m_s2, "m/s²"))
    if summary.truth is None:
        table.add_row("truth", "none")
    else:
        table.add_row("truth", f"{summary.truth.samples:,} samples, from {summary.truth.source}")
        for what, mean, peak, unit in (
            ("speed", summary.truth.mean_linear_m_s, summary.truth.peak_linear_m_s, "m/s"),
            ("rotation", summary.truth.mean_angular_rad_s, summary.truth.peak_angular_rad_s, "rad/s"),
        ):
            if mean is not None and peak is not None:
                table.add_row(f"  {what}", f"mean {mean:.3f}, peak {peak:.3f} {unit}")
    return Panel(table, title=summary.name, title_align="left", width=_WIDTH)


def _spread(mean: tuple[float, ...], std: tuple[float, ...], unit: str) -> str:
    return "  ".join(f"{axis} {m:+.4f} ± {s:.4f}" for axis, m, s in zip("xyz", mean, std, strict=True)) + f" {unit}"


def models_table(replies: list[ModelsReply]) -> RenderableType:
    """The models of every node; marks the active, the previous and the staged ones."""
    parts: list[RenderableType] = []
    for reply in replies:
        table = Table("", "model", "digest", "release", "signature", "trained", "parameters", **_PLAIN)
        origins: list[RenderableType] = []
        table.title, table.title_justify = f"{reply.node}, epoch {reply.epoch}", "left"
        previous = reply.previous.digest if reply.previous else ""
        for info in reply.available:
            mark = "active" if info.digest == reply.active.digest else "previous" if info.digest == previous else ""
            mark = mark or ("staged" if info in reply.staged else "")
            trained = "yes" if info.trained else "no"
            about = (str(info.release), info.signature, trained, f"{info.parameters:,}")
            table.add_row(mark, info.name, info.digest[:12], *about)
            figures = "".join(f", {name} {value:.3g}" for name, value in info.figures.items())
            origins.append(
                Text(f"{info.name}: {info.provenance}{figures}", style="dim", no_wrap=True, overflow="ellipsis")
            )
        parts += [table, *origins]
        parts.extend(
            Text(f"{digest[:12]}: {have:,} bytes of an incomplete push") for digest, have in reply.partial.items()
        )
        parts.extend(Text(f"{name}: {why}", style="yellow") for name, why in reply.unreadable.items())
    return Group(*parts)
