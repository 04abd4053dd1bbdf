"""Flags of an estimate: which conditions limit how far a consumer may trust it."""

from typing import NamedTuple

from neurove_core.stream_state import WindowEstimate
from neurove_protocol import CameraInfo, Flag
from neurove_service.streams.lane import OpenWindow


class _Gap(NamedTuple):
    start_us: int
    end_us: int
    flags: frozenset[Flag]
    recoverable: bool  # its packets may still arrive


class Flags:
    """What happened on a stream since the last estimate, as flags of the next ones."""

    def __init__(self) -> None:
        self._gaps: list[_Gap] = []
        self._pending: set[Flag] = set()
        self._missing = self._recoverable = False

    def set_next(self, flag: Flag) -> None:
        """Set a flag on the next estimate; OVERLOAD belongs to the windows of a gap if there is one."""
        self._pending.add(flag)

    def missing(self, *, recoverable: bool = False) -> None:
        """Packets are missing between the newest one and the next one.

        Args:
            recoverable: whether they may still arrive; then `recovered` says so.
        """
        self._recoverable = recoverable and not self._missing
        self._missing = True

    def close_gap(self, window: OpenWindow | None, end_us: int) -> None:
        """The next packet arrived: flag the windows of the gap before it, if packets were missing.

        Args:
            window: the open one; None before the first packet.
            end_us: start of the packet [us].
        """
        if not self._missing:
            return
        flags = {Flag.GAP}
        if Flag.OVERLOAD in self._pending:
            flags.add(Flag.OVERLOAD)
            self._pending.discard(Flag.OVERLOAD)
        start_us = end_us if window is None else window.horizon_us
        self._gaps.append(_Gap(start_us, max(end_us, start_us + 1), frozenset(flags), self._recoverable))
        self._missing = self._recoverable = False

    def recovered(self) -> None:
        """The packets of the newest gap have arrived after all."""
        if self._gaps and self._gaps[-1].recoverable:
            self._gaps.pop()

    def forget_gaps(self) -> None:
        """Forget all gaps: the stream restarts."""
        self._gaps.clear()
        self._missing = self._recoverable = False

    def of(
        self, window: WindowEstimate, camera: CameraInfo | None, *, trained: bool, late: bool, frozen: bool
    ) -> tuple[str, ...]:
        """The flags of an estimate.

        Args:
            window: the estimate.
            camera: the calibration of the sensor, if it is known.
            trained: whether the model is trained.
            late: whether it is published long after the end of the window.
            frozen: whether the camera repeats the same events.
        """
        conditions = {
            Flag.UNTRAINED: not trained,
            Flag.UNCALIBRATED: camera is None,
            Flag.UNSCALED: camera is None or camera.height_m is None,
            Flag.RESET: window.first,
            Flag.SETTLING: not window.settled,
            Flag.LOW_ACTIVITY: window.low_activity,
            Flag.SATURATED: window.saturated,
            Flag.GYRO_DISAGREES: window.gyro_disagrees,
            Flag.UNCERTAIN: window.uncertain,
            Flag.LATE: late,
            Flag.FROZEN: frozen,
        }
        flags = {flag for flag, holds in conditions.items() if holds} | self._pending
        self._pending.clear()
        for gap in self._gaps:
            if gap.start_us < window.end_us and gap.end_us > window.start_us:
                flags |= gap.flags
        self._gaps = [gap for gap in self._gaps if gap.end_us > window.end_us]
        return tuple(flag.value for flag in Flag if flag in flags)
