"""How far a driver is behind real time: a source that is slower than its own clock cannot be played live."""

import math
import time
from collections.abc import Callable
from typing import Final

BEHIND_S: Final = 1.0
"""A driver that is further behind cannot keep up; a shorter pause of the machine is no news."""

OnBehind = Callable[[float, float], None]
"""Receives how far the driver is behind [s], and the time of the source until there [s]; called once."""


def ignore_behind(_: float, __: float) -> None:
    """Ignore that the driver is behind."""


class Lag:
    """Measures how late packets are published.

    Args:
        speed: sensor seconds per second; with infinity no packet is due, so none is late.
        on_behind: called when the driver is first further behind than BEHIND_S.
        clock: monotonic clock [s].
    """

    def __init__(
        self, speed: float, on_behind: OnBehind = ignore_behind, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._counts, self._on_behind, self._clock = math.isfinite(speed), on_behind, clock
        self._said = False
        self.most_s = 0.0

    def sent(self, due: float, elapsed_s: float) -> None:
        """A packet was published that was due at this time of the clock, after this time of the source."""
        behind_s = self._clock() - due
        if not self._counts or behind_s <= self.most_s:
            return
        self.most_s = behind_s
        if behind_s > BEHIND_S and not self._said:
            self._said = True
            self._on_behind(behind_s, elapsed_s)
