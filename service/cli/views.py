"""What people see: tables of live estimates, health, models; drawn with rich."""

import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from neurove_core.io.summary import Summary
from neurove_protocol import Flag, Twist, TwistEstimate
from neurove_protocol.control import HealthReply, ModelsReply, StreamStatus
from neurove_protocol.velocity import AXES
from neurove_service.latency import latency

_VERDICT_STYLE = {"ok": "green", "lossy": "yellow", "stalled": "bold red", "idle": "dim"}
_RATE_ESTIMATES = 40
_BLOCKS = "▁▂▃▄▅▆▇█"
_PLAIN: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0), "header_style": "dim"}
_HISTORY = 26
_HISTORY_BESIDE_SIGMA = 19
_WIDTH = 98


@dataclass
class Heard:
    """What a consumer has heard of one stream."""

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
            heard.twists.append(estimate.twist)
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
    grid = Table.grid(padding=(0, 2))
    for left, right in zip(range(3), range(3, 6), strict=True):
        grid.add_row(*_axis(heard, left), *_axis(heard, right))
    return Panel(Group(grid, _footer(heard, heard.status)), title=_title(name, heard), title_align="left", width=_WIDTH)


def _axis(heard: Heard, axis: int) -> tuple[Text, Text, Text]:
    """Name, newest value with its unit, and the newest estimates as a line."""
    unit = "m/s" if axis < 3 else "rad/s"
    values = [twist[axis] for twist in heard.twists]
    sigma = heard.last.sigma if heard.last is not None else None
    spread = f" ±{_short(sigma[axis])}" if sigma is not None else ""
    newest = f"{values[-1]:+7.3f}{spread} {unit:5}" if values else ""
    shown = values if sigma is None else values[-_HISTORY_BESIDE_SIGMA:]
    return Text(AXES[axis], style="bold"), Text(newest), Text(_line(shown), style="cyan")


def _short(sigma: float) -> str:
    """A standard deviation in five characters."""
    return f"{sigma:5.3f}" if sigma < 9.9995 else f"{min(sigma, 99999):5.0f}"


def _line(values: list[float]) -> str:
    """Values as a row of blocks between their least and greatest."""
    low, high = min(values, default=0.0), max(values, default=0.0)
    scale = (len(_BLOCKS) - 1) / (high - low) if high > low else 0.0
    return "".join(_BLOCKS[round((value - low) * scale)] for value in values)


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


def health_table(replies: list[HealthReply]) -> RenderableType:
    """Nodes and their streams."""
    parts: list[RenderableType] = []
    for reply in replies:
        verdict = Text("ok" if reply.ok else "not ok", style="bold green" if reply.ok else "bold red")
        model = f"{reply.model.name} ({'trained' if reply.model.trained else 'untrained'}, {reply.model.digest[:12]})"
        about = f": {reply.why}. Up {reply.uptime_s:.0f} s, version {reply.version}, model {model}, epoch {reply.epoch}"
        parts.append(Text.assemble((f"{reply.node} ", "bold"), verdict, about))
        if not reply.ready:
            parts.append(Text("not ready: the node ends", style="yellow"))
        if reply.change:
            parts.append(Text(f"model change: {reply.change}. Rolled back by itself: {reply.rollbacks}", style="dim"))
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


def survey_table(told: Summary) -> RenderableType:
    """What a recording holds."""
    table = Table(show_header=False, **_PLAIN)
    table.add_row("sensor", str(told.sensor))
    on = "" if told.on_fraction is None else f", {100 * told.on_fraction:.1f} % ON"
    table.add_row("events", f"{told.events:,}{on}")
    if told.first_us is not None and told.last_us is not None:
        span = f"{told.first_us / 1e6:.6f} to {told.last_us / 1e6:.6f} s of the sensor's clock"
        table.add_row("duration", f"{told.duration_s:.6f} s ({span})")
    if told.mean_rate_hz is not None and told.peak_rate_hz is not None:
        rates = f"{told.mean_rate_hz / 1e3:,.1f} k events/s, {told.peak_rate_hz / 1e3:,.1f} in the busiest 10 ms"
        table.add_row("rate", rates)
    table.add_row("streams", ", ".join(told.streams))
    for name, count in (("frames", told.frames), ("triggers", told.triggers)):
        if count:
            table.add_row(name, f"{count:,}")
    if told.imu is not None:
        rate = "" if told.imu.rate_hz is None else f" at {told.imu.rate_hz:,.1f} Hz"
        table.add_row("imu", f"{told.imu.samples:,} samples{rate}")
        table.add_row("  gyro", _spread(told.imu.gyro_mean_rad_s, told.imu.gyro_std_rad_s, "rad/s"))
        table.add_row("  accelerometer", _spread(told.imu.accel_mean_m_s2, told.imu.accel_std_m_s2, "m/s²"))
    if told.truth is None:
        table.add_row("truth", "none")
    else:
        table.add_row("truth", f"{told.truth.samples:,} samples, from {told.truth.source}")
        for what, mean, peak, unit in (
            ("speed", told.truth.mean_linear_m_s, told.truth.peak_linear_m_s, "m/s"),
            ("rotation", told.truth.mean_angular_rad_s, told.truth.peak_angular_rad_s, "rad/s"),
        ):
            if mean is not None and peak is not None:
                table.add_row(f"  {what}", f"mean {mean:.3f}, peak {peak:.3f} {unit}")
    return Panel(table, title=told.name, title_align="left", width=_WIDTH)


def _spread(mean: tuple[float, ...], std: tuple[float, ...], unit: str) -> str:
    return "  ".join(f"{axis} {m:+.4f} ± {s:.4f}" for axis, m, s in zip("xyz", mean, std, strict=True)) + f" {unit}"


def models_table(replies: list[ModelsReply]) -> RenderableType:
    """Models of every node, the active one marked."""
    parts: list[RenderableType] = []
    for reply in replies:
        table = Table("", "model", "digest", "release", "signature", "trained", "parameters", **_PLAIN)
        made: list[RenderableType] = []
        table.title, table.title_justify = f"{reply.node}, epoch {reply.epoch}", "left"
        previous = reply.previous.digest if reply.previous else ""
        for info in reply.available:
            mark = "active" if info.digest == reply.active.digest else "previous" if info.digest == previous else ""
            mark = mark or ("staged" if info in reply.staged else "")
            trained = "yes" if info.trained else "no"
            about = (str(info.release), info.signature, trained, f"{info.parameters:,}")
            table.add_row(mark, info.name, info.digest[:12], *about)
            figures = "".join(f", {name} {value:.3g}" for name, value in info.figures.items())
            made.append(
                Text(f"{info.name}: {info.provenance}{figures}", style="dim", no_wrap=True, overflow="ellipsis")
            )
        parts += [table, *made]
        parts.extend(Text(f"{digest[:12]}: {have:,} bytes of a push so far") for digest, have in reply.partial.items())
        parts.extend(Text(f"{name}: {why}", style="yellow") for name, why in reply.unreadable.items())
    return Group(*parts)
