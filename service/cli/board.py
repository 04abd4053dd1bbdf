"""The live table of `neurove watch` and `neurove demo`: the newest velocity of each stream, its sigma and its age.

What is older than two windows is grey, and says since when: a table never shows an old value as a present one.
"""

import itertools
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from neurove_protocol import Flag, Twist, TwistEstimate
from neurove_protocol.control import StreamStatus
from neurove_protocol.velocity import AXES
from neurove_service.cli.inertial_text import imu_text
from neurove_service.latency import latency

VERDICT_STYLE = {
    "ok": "green",
    "lossy": "yellow",
    "stalled": "bold red",
    "idle": "dim",
    "unstable": "bold red",
    "uncertain": "yellow",
}
OLD = "bright_black"
"""Style of what is older than two windows."""

WIDTH = 98
"""Columns of a panel; a terminal with fewer columns shows one line per stream."""

_RATE_ESTIMATES = 40
_BLOCKS = "▁▂▃▄▅▆▇█"
_HISTORY = 26
_HISTORY_WITH_SIGMA = 19
_PANEL_LINES = 10
_LEAST_NAME, _MOST_NAME = 8, 30
_NUMBERS = 52  # columns of a line after the name: six numbers and the state
_STATUS_OLD_S = 3.0  # a node publishes the status of a stream every second, unless it is configured otherwise
_NODES = 8  # that are remembered per stream
_NO_LENS = "no lens: `drive --calibration FILE`, or a CameraInfo"
_NO_HEIGHT = "no height, 1 m assumed: `drive --height M`, or in CameraInfo"

TruthOf = Callable[[TwistEstimate], Twist | None]
"""The true twist at the end of a window; None where it is unknown."""


@dataclass
class Received:
    """The estimates and the status that a consumer has received of one stream."""

    count: int = 0
    missed: int = 0
    last: TwistEstimate | None = None
    status: StreamStatus | None = None
    nodes: tuple[str, ...] = ()
    arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=_RATE_ESTIMATES))
    twists: deque[Twist] = field(default_factory=lambda: deque(maxlen=_HISTORY))
    latencies_ms: list[float] = field(default_factory=list)
    first_at: float = 0.0
    last_at: float = 0.0  # monotonic clock [s]
    last_wall: float = 0.0  # the same on the wall clock, to say since when
    status_at: float = 0.0
    status_wall: float = 0.0

    def copied(self) -> "Received":
        """A copy that does not change while it is drawn, with the newest latencies only."""
        newest_ms = self.latencies_ms[-_RATE_ESTIMATES:]
        return replace(self, arrivals=self.arrivals.copy(), twists=self.twists.copy(), latencies_ms=newest_ms)

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

    @property
    def period_s(self) -> float:
        """Time between two estimates [s]: the length of a window, or longer where a source is played slowly."""
        if self.last is None:
            return 0.0
        steps = [after - before for before, after in itertools.pairwise(self.arrivals)]
        window_s = (self.last.end_us - self.last.start_us) / 1e6
        return max(window_s, statistics.median(steps) if steps else 0.0)

    def silent_s(self, now: float) -> float | None:
        """Time since the newest estimate [s], if it is longer than two windows; None for a stream that is live."""
        if self.last is None:
            return None
        silent_s = now - self.last_at
        return silent_s if silent_s > 2 * self.period_s else None

    def status_silent_s(self, now: float) -> float | None:
        """Time since the newest status [s], if the node has left out several; None otherwise."""
        silent_s = now - self.status_at
        return silent_s if self.status is not None and silent_s > _STATUS_OLD_S else None

    def is_live(self, now: float) -> bool:
        """Whether an estimate arrived within the last two windows."""
        return self.last is not None and self.silent_s(now) is None

    @property
    def late_s(self) -> float | None:
        """Age of the newest estimate when it arrived [s], if it was older than two windows."""
        if self.last is None or self.last.host is None:
            return None
        age_s = self.last.host.age_ns / 1e9
        return age_s if age_s > 2 * self.period_s else None


class Board:
    """All streams that a consumer receives; filled on Zenoh's thread, drawn on another.

    Args:
        keep_latencies: longest list of latencies of a stream.
        truth: the true twist of an estimate, where it is known; it is shown next to the estimate.
        clock: monotonic clock [s].
    """

    def __init__(
        self,
        keep_latencies: int = 100_000,
        truth: TruthOf | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._lock = threading.Lock()
        self._streams: dict[str, Received] = {}
        self._keep, self._truth, self._clock = keep_latencies, truth, clock

    def on_estimate(self, estimate: TwistEstimate) -> None:
        """Add an estimate."""
        now = self._clock()
        with self._lock:
            received = self._streams.setdefault(estimate.stream, Received())
            if received.last is not None and estimate.seq > received.last.seq + 1:
                received.missed += estimate.seq - received.last.seq - 1
            received.first_at = received.first_at or now
            received.last_at, received.last_wall = now, time.time()
            received.count += 1
            received.last = estimate
            received.twists.append(estimate.twist)
            received.arrivals.append(now)
            if estimate.node is not None and estimate.node not in received.nodes:
                received.nodes = (*received.nodes, estimate.node)[-_NODES:]
            if len(received.latencies_ms) < self._keep:
                received.latencies_ms.append(estimate.trace.latency_ms)

    def on_status(self, status: StreamStatus) -> None:
        """Replace the status of a stream."""
        now = self._clock()
        with self._lock:
            received = self._streams.setdefault(status.stream, Received())
            received.status, received.status_at, received.status_wall = status, now, time.time()

    def at_newest(self) -> "Board":
        """A board that shows what this one showed when the newest estimate arrived."""
        shown = Board(self._keep, self._truth, clock=lambda: now)
        shown._streams = self.streams()
        now = max((one.last_at for one in shown._streams.values()), default=0.0)
        return shown

    def of(self, stream: str) -> Received:
        """What was received of one stream; empty if nothing was."""
        with self._lock:
            return self._streams.get(stream, Received())

    def streams(self) -> dict[str, Received]:
        """Copies of what was received of every stream: live ones first, then by name."""
        now = self._clock()
        with self._lock:
            found = {name: one.copied() for name, one in self._streams.items()}
        return dict(sorted(found.items(), key=lambda item: (not item[1].is_live(now), item[0])))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        streams, now = self.streams(), self._clock()
        if not streams:
            yield Text("waiting for estimates ...", style="dim")
            return
        width = options.max_width
        fits = width >= WIDTH and (len(streams) == 1 or len(streams) * _PANEL_LINES < console.size.height)
        if fits:
            yield from (_panel(name, one, now, self._truth) for name, one in streams.items())
        else:
            room = min(_MOST_NAME, max(_LEAST_NAME, width - _NUMBERS))
            heads = "".join(f"{axis:>7}" for axis in AXES)
            yield Text(f"{'stream':{room}}{heads} state", style="dim", no_wrap=True, overflow="crop")
            yield from (_one_line(name, one, now, room) for name, one in streams.items())
        yield _legend(streams, lines=not fits)
        for name, one in streams.items():
            style = "yellow" if one.status_silent_s(now) is None else OLD
            yield from (Text(note, style=style) for note in notes(name, one))


def age_text(age_s: float) -> str:
    """An age in at most nine characters.

    >>> age_text(8.31), age_text(75), age_text(400000)
    ('8.3 s ago', '75 s ago', '99+ h ago')
    """
    if age_s < 9.95:
        return f"{max(age_s, 0.0):.1f} s ago"
    if age_s < 99.5:
        return f"{age_s:.0f} s ago"
    minutes = age_s / 60
    if minutes < 99.5:
        return f"{minutes:.0f}min ago"
    return f"{minutes / 60:.0f} h ago" if minutes / 60 < 99.5 else "99+ h ago"


def since(received: Received, silent_s: float) -> str:
    """Since when a stream is silent, by the clock of this machine."""
    at = time.strftime("%H:%M:%S", time.localtime(received.last_wall))
    return f"no estimate since {at}, {age_text(silent_s)}"


def legend(streams: dict[str, Received]) -> str:
    """The frame and the units of the numbers, and what sigma is."""
    frames = sorted({one.last.frame_id for one in streams.values() if one.last is not None})
    frame = f"frame {', '.join(frames)}: " if frames else ""
    return f"vx vy vz in m/s, wx wy wz in rad/s; {frame}x right, y down, z forward. {SIGMA}"


SIGMA = "±: sigma, one standard deviation; on simulated scenes 90 % of the errors are within 1.64 sigma."


def notes(name: str, received: Received) -> Iterator[str]:
    """One line for each thing to know or to do about a stream."""
    last, status = received.last, received.status
    flags = last.flags if last is not None else ()
    if Flag.UNCALIBRATED in flags:
        yield f"{name}: {_NO_LENS}"
    elif Flag.UNSCALED in flags:
        yield f"{name}: {_NO_HEIGHT}"
    if status is not None:
        yield from status_notes(status)
    if len(received.nodes) > 1:
        yield f"{name}: {len(received.nodes)} nodes answer this stream: {', '.join(received.nodes)}"


def status_notes(status: StreamStatus) -> Iterator[str]:
    """One line for each thing that is not as usual on a stream: the reason of its verdict, and what was refused."""
    if status.verdict != "ok":
        yield f"{status.stream}: {status.verdict}: {status.why}"
    if status.refusal and status.refusal not in status.why:
        yield f"{status.stream}: refused: {status.refusal}"
    if status.unrefined_windows:
        yield f"{status.stream}: {status.unrefined_windows:,} windows not refined, because the node was behind"
    if status.imu is not None:
        yield f"{status.stream}: {imu_text(status.imu)}"
    if status.uncounted_packets:
        count = f"{status.uncounted_packets:,} packets have the sequence number 0"
        yield f"{status.stream}: {count}, so losses on the way to the node are not counted"


def _legend(streams: dict[str, Received], *, lines: bool) -> Text:
    state = "; the state says since when" if lines else ""
    return Text(f"{legend(streams)} Grey: older than two windows{state}.", style="dim")


def _one_line(name: str, received: Received, now: float, room: int) -> Text:
    """A stream in one line: name, newest twist, and its verdict, or since when it is silent."""
    silent_s = received.silent_s(now)
    kept = room - 2  # of a long name the begin and the end: cameras often differ in the last word
    shown = name if len(name) < room else f"{name[: kept // 2]}…{name[-(kept - kept // 2) :]}"
    numbers = "".join(_six(value) for value in received.last.twist) if received.last is not None else f"{'-':>42}"
    grey = not received.is_live(now)
    line = Text(f"{shown:{room}}{numbers} ", style=OLD if grey else "default", no_wrap=True, overflow="crop")
    if silent_s is not None:
        return line.append(age_text(silent_s), style=OLD)
    if received.late_s is not None:
        return line.append(age_text(received.late_s), style="yellow")
    status_s = received.status_silent_s(now)
    if received.last is None and status_s is not None:
        return line.append(age_text(status_s), style=OLD)
    verdict = received.status.verdict if received.status is not None else "-"
    return line.append(verdict, style=VERDICT_STYLE.get(verdict, "default"))


def _six(value: float) -> str:
    """A number in seven columns, the first one empty."""
    for digits in (3, 2, 1, 0):
        text = f"{value:+.{digits}f}"
        if len(text) <= 6:
            return f"{text:>7}"
    return f"{value:+7.0e}"[:7].rjust(7)


def _panel(name: str, received: Received, now: float, truth_of: TruthOf | None) -> RenderableType:
    grid = Table.grid(padding=(0, 2))
    true = truth_of(received.last) if truth_of is not None and received.last is not None else None
    if true is not None:
        grid.add_row(*(Text(word, style="dim") for word in ("", "estimate", "truth", "error") * 2))
    cells = [_axis(received, axis) if true is None else _compared(received, axis, true[axis]) for axis in range(6)]
    for left, right in zip(cells[:3], cells[3:], strict=True):
        grid.add_row(*left, *right)
    parts = Table.grid()
    parts.add_row(grid)
    parts.add_row(_footer(received, received.status, now))
    live = received.is_live(now)
    return Panel(
        parts,
        title=_title(name, received, now),
        title_align="left",
        width=WIDTH,
        style="none" if live else OLD,
        border_style="none" if live else OLD,
    )


def _axis(received: Received, axis: int) -> tuple[Text, ...]:
    """Name, newest value with its sigma and unit, and the newest estimates as a line of blocks."""
    values = [twist[axis] for twist in received.twists]
    shown = values if _sigma(received, axis) is None else values[-_HISTORY_WITH_SIGMA:]
    return Text(AXES[axis], style="bold"), Text(_newest(received, axis)), Text(_line(shown), style="cyan")


def _compared(received: Received, axis: int, true: float) -> tuple[Text, ...]:
    """Name, newest value with its sigma and unit, the truth, and the error."""
    newest = received.twists[-1][axis]
    texts = (Text(f"{true:+7.3f}"), Text(f"{newest - true:+7.3f}", style="cyan"))
    return Text(AXES[axis], style="bold"), Text(_newest(received, axis)), *texts


def _newest(received: Received, axis: int) -> str:
    if not received.twists:
        return ""
    sigma = _sigma(received, axis)
    spread = f" ±{_short(sigma)}" if sigma is not None else ""
    return f"{received.twists[-1][axis]:+7.3f}{spread} {'m/s' if axis < 3 else 'rad/s':5}"


def _sigma(received: Received, axis: int) -> float | None:
    sigma = received.last.sigma if received.last is not None else None
    return None if sigma is None else sigma[axis]


def _short(sigma: float) -> str:
    """A standard deviation in five characters."""
    return f"{sigma:5.3f}" if sigma < 9.9995 else f"{min(sigma, 99999):5.0f}"


def _line(values: list[float]) -> str:
    """Values as a row of blocks, scaled between their minimum and maximum."""
    low, high = min(values, default=0.0), max(values, default=0.0)
    scale = (len(_BLOCKS) - 1) / (high - low) if high > low else 0.0
    return "".join(_BLOCKS[round((value - low) * scale)] for value in values)


def _title(name: str, received: Received, now: float) -> Text:
    status, last = received.status, received.last
    live = received.is_live(now)
    title = Text(f"{name}  ", style="bold" if live else OLD)
    silent_s = received.silent_s(now)
    if silent_s is not None:
        title.append(f"{since(received, silent_s)}  ", style="bold yellow")
    elif status is not None and received.status_silent_s(now) is not None:
        at = time.strftime("%H:%M:%S", time.localtime(received.status_wall))
        title.append(f"no status since {at}  ", style="bold yellow")
    elif status is not None:
        title.append(f"{status.verdict}  ", style=VERDICT_STYLE[status.verdict])
    if status is not None:
        title.append(f"{status.width}x{status.height}  ", style="default")
    if last is not None:
        title.append(f"model {last.model}  ", style="default")
        if Flag.UNTRAINED in last.flags:
            title.append("UNTRAINED: the estimates have no meaning", style="bold magenta")
    return title


def _footer(received: Received, status: StreamStatus | None, now: float) -> Text:
    text = Text(style="dim")
    numbers = latency(received.latencies_ms[-_RATE_ESTIMATES:])
    if received.silent_s(now) is not None:
        text.append(f"{received.count:,} estimates before")
    elif numbers is not None:
        rate = f"{received.rate_hz:.1f} estimates/s, " if len(received.arrivals) > 1 else ""  # one has no rate
        text.append(f"{rate}latency p50 {numbers.p50:.1f} ms p99 {numbers.p99:.1f} ms")
    if received.late_s is not None:
        text.append(f", {received.late_s:.1f} s old on arrival", style="yellow")
    if status is not None:
        text.append(f", {status.packets_received:,} packets, {status.events_received:,} events")
        lost = status.lost.nonzero()
        causes = ", ".join(f"{key} {value}" for key, value in lost.items()) or "nothing"
        text.append(f"\nlost: {causes}", style="yellow" if lost else "dim")
    if received.last is not None:
        text.append(f"\nflags: {', '.join(received.last.flags) or 'none'}; angular part: {received.last.source}")
    return text
