"""The newest samples of an inertial unit, bounded in time and number."""

from typing import Final, NamedTuple

import numpy as np

from neurove_protocol.imu import Imu

KEPT_US: Final = 1_500_000
"""Samples that are older than the newest one by more than this are dropped."""

KEPT_SAMPLES: Final = 8192
"""Maximum number of samples."""

CLOCK_RESET_US: Final = 1_000_000
"""If the time goes back by more than this, the clock was reset; otherwise the samples are late."""


class Pushed(NamedTuple):
    """The buffer after some samples."""

    samples: Imu
    late: int  # samples that were left out, because they are earlier than others before
    restarted: bool  # the clock was reset, and the earlier samples were dropped


def push(samples: Imu, more: Imu) -> Pushed:
    """Append samples.

    Args:
        samples: the buffer.
        more: of one packet, ordered by time.
    """
    if not more.n:
        return Pushed(samples, 0, restarted=False)
    late, restarted = 0, False
    if samples.n and more.t[0] < samples.t[-1]:
        restarted = bool(more.t[-1] < samples.t[-1] - CLOCK_RESET_US)
        if restarted:
            samples = Imu.empty()
        else:
            late = int(more.t.searchsorted(samples.t[-1]))
            more = more.span(late, more.n)
    if samples.n:
        more = Imu(*(np.concatenate(columns) for columns in zip(samples, more, strict=True)))
    first = int(more.t.searchsorted(more.t[-1] - KEPT_US)) if more.n else 0
    return Pushed(more.span(max(first, more.n - KEPT_SAMPLES), more.n), late, restarted)
