"""Tables for people: health, models, recordings; drawn with rich. The live table is in `board`."""

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from neurove_protocol import CameraInfo
from neurove_protocol.control import HealthReply, ModelsReply, StreamStatus
from neurove_service.cli.board import OLD, VERDICT_STYLE, WIDTH, age_text, status_notes

if TYPE_CHECKING:
    from neurove_core.io.summary import Summary

_PLAIN: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0), "header_style": "dim"}
_OLD_S = 0.1  # two windows: a stream whose newest packet is older is grey


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
        if reply.internal_errors:
            errors = ", ".join(f"{place} {count}" for place, count in reply.internal_errors.items())
            parts.append(
                Text(f"internal errors since the start: {errors}; the log has the tracebacks", style="bold red")
            )
        if reply.refused_streams:
            parts.append(
                Text(f"streams refused, because max_streams is reached: {reply.refused_streams}", style="yellow")
            )
        if reply.dropped_log_lines:
            parts.append(
                Text(f"lines of the log that were not read in time: {reply.dropped_log_lines}", style="yellow")
            )
        if reply.streams:
            parts.append(_streams_table(reply.streams))
            parts.extend(Text(note, style="yellow") for status in reply.streams for note in status_notes(status))
            parts.extend(Text(duty, style="dim") for duty in map(_duty_text, reply.streams) if duty)
    return Group(*parts)


def _duty_text(status: StreamStatus) -> str:
    """What a node does on a stream that several nodes can answer; empty where it alone serves it."""
    standby = status.standby
    if standby is None:
        return ""
    drained = ", is drained" if standby.draining else ""
    if standby.role == "answers":
        nodes = "1 other node serves" if standby.followers == 1 else f"{standby.followers} other nodes serve"
        return f"{status.stream}: this node answers, {nodes} it{drained}"
    if standby.role == "follows":
        state = "with equal state" if standby.equal else "its state is not equal yet"
        return f"{status.stream}: follows {standby.leader}, {state}{drained}"
    return f"{status.stream}: hears no node that answers{drained}"


def _streams_table(streams: tuple[StreamStatus, ...]) -> Table:
    """The streams of a node, live ones first; those without a packet in the last two windows are grey."""
    columns = ("stream", "verdict", "sensor", "packets", "events", "estimates", "p50/p99 ms", "newest packet", "lost")
    table = Table(*columns, **_PLAIN)
    for status in sorted(streams, key=lambda one: (one.last_packet_age_s > _OLD_S, one.stream)):
        numbers, old = status.latency_ms, status.last_packet_age_s > _OLD_S
        lost = ", ".join(f"{name} {count}" for name, count in status.lost.nonzero().items())
        table.add_row(
            status.stream,
            Text(status.verdict, style=OLD if old and status.verdict == "ok" else VERDICT_STYLE[status.verdict]),
            f"{status.width}x{status.height}{'' if status.calibrated else ' *'}",
            f"{status.packets_received:,}",
            f"{status.events_received:,}",
            f"{status.estimates:,}",
            f"{numbers.p50:.1f}/{numbers.p99:.1f}" if numbers else "-",
            age_text(status.last_packet_age_s),
            lost or "nothing",
            style=OLD if old else None,
        )
    if not all(status.calibrated for status in streams):
        table.caption = "* uncalibrated: no CameraInfo of this sensor"
        table.caption_justify = "left"
    return table


def survey_table(summary: "Summary") -> RenderableType:
    """The contents of a recording."""
    table = Table(show_header=False, **_PLAIN)
    table.add_row("sensor", str(summary.sensor))
    table.add_row("lens", _lens_text(summary.lens))
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
        peaks = f"{summary.imu.gyro_peak_rad_s:.3f} rad/s, {summary.imu.accel_peak_m_s2:.1f} m/s²"
        table.add_row("  greatest", peaks)
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
    return Panel(table, title=summary.name, title_align="left", width=WIDTH)


def _lens_text(lens: CameraInfo | None) -> str:
    from neurove_core.geometry.camera import field_of_view_deg

    if lens is None:
        return "unknown: --calibration FILE gives it"
    text = f"{lens.lens}, fx {lens.fx:.2f} fy {lens.fy:.2f} cx {lens.cx:.2f} cy {lens.cy:.2f} px"
    bent = any(lens.distortion)
    text += f", distortion {' '.join(f'{one:.4g}' for one in lens.distortion)}" if bent else ", no distortion"
    x, y = field_of_view_deg(lens)
    text += "" if math.isnan(x + y) else f"\nfield of view {x:.0f} x {y:.0f} deg"
    height = f"{lens.height_m:g} m above the ground" if lens.height_m else "height unknown: --height M gives it"
    return f"{text}\n{height}"


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


def fleet_table(rows: Sequence[Mapping[str, Any]], now: datetime) -> RenderableType:
    """The nodes of a fleet, one a line, in fixed columns; rows as `neurove fleet list --json` prints them."""
    columns = ("node", "labels", "version", "model", "digest", "release", "verdict", "last seen", "why")
    table = Table(*columns, **_PLAIN)
    for column in table.columns[:-1]:
        column.no_wrap = True
    for row in rows:
        verdict = "silent" if not row["answered"] else "ok" if row["ok"] else "not-ok"
        table.add_row(
            row["node"],
            ",".join(f"{name}={value}" for name, value in row["labels"].items()) or "-",
            *(
                ("-",) * 4
                if not row["answered"]
                else (row["version"], row["model"], row["digest"][:12], str(row["release"]))
            ),
            Text(verdict, style="bold green" if verdict == "ok" else "bold red"),
            _seen_text(row, now),
            row["why"],
        )
    return table


def _seen_text(row: Mapping[str, Any], now: datetime) -> str:
    if row["answered"]:
        return "now"
    if row["last_seen"] is None:
        return "-"
    seen = datetime.fromisoformat(row["last_seen"])
    age_s = (now - seen).total_seconds()
    return age_text(max(0.0, age_s)) if age_s < 3 * 86_400 else f"{seen:%Y-%m-%d}"
