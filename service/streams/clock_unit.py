"""The unit of a stream's clock: a driver that sends nanoseconds or milliseconds is told so."""

from collections import deque
from typing import Final

_UNITS: Final = ((1e3, "1,000 times as fast as", "nanoseconds"), (1e-3, "1,000 times as slow as", "milliseconds"))
_SPAN_NS: Final = 1_000_000_000
_SPANS: Final = 3  # in a row, so that a clock that is set once is no unit
_WITHIN: Final = 2.0  # factor around the ratio of a unit


class ClockUnit:
    """Compares how fast the clock of a stream runs with the clock of this node, second by second."""

    def __init__(self) -> None:
        self._begin: tuple[int, int] | None = None
        self._ratios: deque[float] = deque(maxlen=_SPANS)
        self.hint = ""  # what is wrong, as a sentence; empty if the clock may count microseconds

    def learn(self, clock_us: int, received_ns: int) -> str:
        """Learn from the newest time of a packet and its arrival; returns the hint."""
        if self._begin is None:
            self._begin = clock_us, received_ns
        first_us, began_ns = self._begin
        elapsed_ns = received_ns - began_ns
        if elapsed_ns >= _SPAN_NS:
            self._begin = clock_us, received_ns
            self._ratios.append((clock_us - first_us) * 1000 / elapsed_ns)
            self.hint = self._hint_now()
        return self.hint

    def _hint_now(self) -> str:
        for factor, pace, unit in _UNITS:
            near = [factor / _WITHIN < ratio < factor * _WITHIN for ratio in self._ratios]
            if len(near) == _SPANS and all(near):
                return (
                    f"the clock of the stream runs {pace} that of this node: t0_us and the times of events count "
                    f"microseconds, and the driver seems to send {unit}"
                )
        return ""
