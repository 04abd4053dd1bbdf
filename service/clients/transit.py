"""Transit: how long estimates were on their way to this process, so that one that waited is not taken for a new one."""

from typing import Final

from neurove_protocol import Flag, TwistEstimate
from neurove_service.clock_offset import ClockOffset

LATE_WINDOWS: Final = 2
"""An estimate that was longer on its way than this number of its windows is late."""

_RESTARTED_NS: Final = 1_000_000_000
"""A node whose clock goes back by more than this has another clock: its machine was started again."""


class Transit:
    """Learns the delay of the estimates of every node, from those that arrive quickest.

    A delay that all estimates share is not seen.
    """

    def __init__(self) -> None:
        self._offsets: dict[str, ClockOffset] = {}
        self._newest_ns: dict[str, int] = {}

    def arrived(self, estimate: TwistEstimate, received_ns: int) -> TwistEstimate:
        """The estimate on arrival: `host.age_ns` includes its transit, and the flag `late` is set if it waited.

        Args:
            estimate: as it was published.
            received_ns: when it arrived, on the monotonic clock of this process [ns].
        """
        clock, published_ns = estimate.node or estimate.stream, estimate.trace.published_ns
        offset, newest_ns = self._offsets.setdefault(clock, ClockOffset()), self._newest_ns.get(clock, published_ns)
        if published_ns < newest_ns - _RESTARTED_NS:
            offset.forget()
            newest_ns = published_ns
        self._newest_ns[clock] = max(newest_ns, published_ns)
        delay_ns = offset.learn(published_ns, received_ns)
        host, flags = estimate.host, estimate.flags
        if host is not None:
            host = host.model_copy(update={"age_ns": host.age_ns + delay_ns})
        if delay_ns > LATE_WINDOWS * 1000 * (estimate.end_us - estimate.start_us) and Flag.LATE not in flags:
            flags = (*flags, Flag.LATE)
        return estimate.model_copy(update={"host": host, "flags": flags})
