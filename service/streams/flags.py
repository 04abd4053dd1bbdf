"""Flags of an estimate: which conditions limit how far a consumer may trust it."""

from typing import NamedTuple

from neurove_core.estimator import WindowEstimate
from neurove_protocol import CameraInfo, Flag


class _Gap(NamedTuple):
    start_us: int
    end_us: int
    flags: frozenset[Flag]


class Flags:
    """What happened on a stream since the last estimate, as flags of the next ones."""

    def __init__(self) -> None:
        self._gaps: list[_Gap] = []
        self._pending: set[Flag] = set()

    def set_next(self, flag: Flag) -> None:
        """Set a flag on the next estimate; OVERLOAD waits until the gap that it caused is known."""
        self._pending.add(flag)

    def add_gap(self, start_us: int | None, end_us: int, lost: int) -> None:
        """Flag the windows of a gap.

        Args:
            start_us: sensor time up to which all events are known [us]; None before the first packet.
            end_us: start of the first packet after the gap [us].
            lost: packets lost before this node.
        """
        flags = {Flag.GAP} if lost else set()
        if Flag.OVERLOAD in self._pending:
            flags |= {Flag.OVERLOAD, Flag.GAP}
            self._pending.discard(Flag.OVERLOAD)
        if start_us is not None and flags:
            self._gaps.append(_Gap(start_us, end_us, frozenset(flags)))

    def forget_gaps(self) -> None:
        """Forget all gaps: the stream restarts."""
        self._gaps.clear()

    def of(self, window: WindowEstimate, camera: CameraInfo | None, *, trained: bool) -> tuple[str, ...]:
        """The flags of an estimate.

        Args:
            window: the estimate.
            camera: the calibration of the sensor, if it is known.
            trained: whether the model is trained.
        """
        conditions = {
            Flag.UNTRAINED: not trained,
            Flag.UNCALIBRATED: camera is None,
            Flag.UNSCALED: camera is None or camera.height_m is None,
            Flag.RESET: window.first,
            Flag.SETTLING: not window.settled,
            Flag.LOW_ACTIVITY: window.low_activity,
            Flag.SATURATED: window.saturated,
            Flag.UNCERTAIN: window.uncertain,
        }
        flags = {flag for flag, holds in conditions.items() if holds} | self._pending
        self._pending.clear()
        for gap in self._gaps:
            if gap.start_us < window.end_us and gap.end_us > window.start_us:
                flags |= gap.flags
        self._gaps = [gap for gap in self._gaps if gap.end_us > window.end_us]
        return tuple(flag.value for flag in Flag if flag in flags)
