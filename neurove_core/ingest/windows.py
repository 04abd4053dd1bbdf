"""push: events to complete windows. Windows are half-open on the sensor's clock and do not depend on packet sizes.

The grid is absolute: a window starts at an integer multiple of its duration on the sensor clock, so a lost first packet
or a late start changes no later window (decision 2). Events are counted into the open window as they arrive, so a
window takes the same memory for any number of events.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.config import CanonicalConfig, WindowConfig
from neurove_core.ingest.counting import count_events
from neurove_core.ingest.sample import Sample, Sampler
from neurove_core.ingest.wire import count_wire
from neurove_protocol import Events
from neurove_protocol.events import WireEvents


class Window(NamedTuple):
    """One complete window, counted on the canonical grid."""

    start_us: int
    counts: NDArray[np.uint8]  # (2n * parts, H, W), saturating at 255: channel 2i is OFF, 2i + 1 is ON of bin i for
    # cells of one part; ingest.channels has the order for cells of four parts
    events: int  # of the whole sensor
    outside: int  # those whose pixel has no cell of the grid
    bridged: bool = False  # windows before it were left out on purpose: the network state goes on over them
    sample: Sample | None = None  # of its events at full resolution; None where no sample is wanted


class WindowsState(NamedTuple):
    """State of a stream between packets: the open window. The next state takes over its counts without a copy."""

    start_us: int | None = None  # None before the first packet
    horizon_us: int = 0  # sensor time up to which all events are known; unused before the first packet
    counts: NDArray[np.uint8] | None = None  # (2n, parts * H, W); None while the open window is empty
    events: int = 0
    outside: int = 0
    bridged: bool = False  # as in Window
    sampler: Sampler | None = None  # None while the open window is empty, or where no sample is wanted


class Pushed(NamedTuple):
    """Result of a push."""

    windows: list[Window]
    state: WindowsState
    late_events: int  # events of windows that were complete before they arrived
    skipped_windows: int  # windows left out because the gap in sensor time was too long


def push(
    events: Events | WireEvents,
    horizon_us: int,
    state: WindowsState,
    lut: NDArray[np.int32],
    config: WindowConfig,
    canonical: CanonicalConfig,
    *,
    sampled: bool = False,
) -> Pushed:
    """Add events to a stream's open window and close every window that is complete.

    Args:
        events: ordered by time, on the sensor of `lut`; as columns or in the layout of a packet, with equal results.
        horizon_us: sensor time that the driver has reached even without events, such as the packet's t0_us.
        state: state of the stream; do not use it again after this call.
        lut: (sensor.height, sensor.width) from geometry.lookup_table.
        config: length and bins of a window.
        canonical: size of the grid.
        sampled: whether to keep a sample of the events of each window.

    Returns:
        the windows that end at or before the newest known time, oldest first, and the next state.
    """
    duration = config.duration_us
    after = _inside(events, horizon_us, state, lut, config)
    if after is not None:
        return Pushed([], after, 0, 0)
    first_us, newest_us = horizon_us, horizon_us
    if events.n:
        first_us, newest_us = min(first_us, events.first_us), max(newest_us, events.last_us)
    if state.start_us is None:
        start_us = first_us // duration * duration
    else:
        start_us, newest_us = state.start_us, max(newest_us, state.horizon_us)
    late = events.before(start_us) if first_us < start_us else 0
    events = events.span(late, events.n) if late else events
    windows: list[Window] = []
    skipped = 0
    open_window = _Open(start_us, state, config, canonical, sampled)
    while newest_us >= open_window.start_us + duration:
        end_us = open_window.start_us + duration
        inside, events = _split(events, end_us)
        open_window.add(inside, lut)
        windows.append(open_window.close())
        next_us = (events.first_us if events.n else newest_us) // duration * duration
        gap = (next_us - end_us) // duration
        if gap > config.max_hole_windows:
            skipped += gap
            end_us = next_us
        if not events.n and newest_us < end_us + duration:
            return Pushed(windows, WindowsState(end_us, newest_us), late, skipped)
        open_window = _Open(end_us, WindowsState(), config, canonical, sampled)
    open_window.add(events, lut)
    return Pushed(windows, open_window.state(newest_us), late, skipped)


def _split(events: Events | WireEvents, t_us: int) -> tuple[Events | WireEvents, Events | WireEvents]:
    """The events before a time and the others; without a search where they are all before it."""
    n = events.n
    inside = n if n and events.last_us < t_us else events.before(t_us)
    return (events if inside == n else events.span(0, inside)), events.span(inside, n)


def _inside(
    events: Events | WireEvents, horizon_us: int, state: WindowsState, lut: NDArray[np.int32], config: WindowConfig
) -> WindowsState | None:
    """The state after events that all belong to the open window, as most small packets do; None for other events."""
    start_us, counts = state.start_us, state.counts
    if counts is None or start_us is None or not events.n:
        return None
    newest_us = max(events.last_us, horizon_us)
    if newest_us >= start_us + config.duration_us or events.first_us < start_us:
        return None
    if state.sampler is not None:
        state.sampler.add(events)
    where = start_us, config.bin_us, lut, counts
    outside = count_wire(events, *where) if isinstance(events, WireEvents) else count_events(events, *where)
    horizon_us = max(newest_us, state.horizon_us)
    counted = state.events + events.n, state.outside + outside
    return WindowsState(start_us, horizon_us, counts, *counted, state.bridged, state.sampler)


class _Open:
    """The window into which events are counted."""

    def __init__(
        self, start_us: int, state: WindowsState, config: WindowConfig, canonical: CanonicalConfig, sampled: bool
    ) -> None:
        self.start_us, self.counts, self.events, self.outside = start_us, state.counts, state.events, state.outside
        self._bridged, self._bin_us = state.bridged, config.bin_us
        self._sampled, self._sampler = sampled and (state.sampler is not None or not state.events), state.sampler
        self._shape = (2 * config.bins, canonical.parts * canonical.height, canonical.width)
        self._window = (-1, canonical.height, canonical.width)

    def add(self, events: Events | WireEvents, lut: NDArray[np.int32]) -> None:
        if not events.n:
            return
        if self._sampled:
            self._sampler = self._sampler or Sampler(self.start_us)
            self._sampler.add(events)
        where = self.start_us, self._bin_us, lut, self._grid()
        self.outside += count_wire(events, *where) if isinstance(events, WireEvents) else count_events(events, *where)
        self.events += events.n

    def _grid(self) -> NDArray[np.uint8]:
        if self.counts is None:
            self.counts = np.zeros(self._shape, np.uint8)
        return self.counts

    def close(self) -> Window:
        sample = self._sampler.sample() if self._sampler is not None else None
        counts = self._grid().reshape(self._window)
        return Window(self.start_us, counts, self.events, self.outside, self._bridged, sample)

    def state(self, horizon_us: int) -> WindowsState:
        return WindowsState(
            self.start_us, horizon_us, self.counts, self.events, self.outside, self._bridged, self._sampler
        )
