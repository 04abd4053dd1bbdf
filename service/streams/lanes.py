"""Lanes: the models at work on one stream. One answers; another may run beside it, tried or kept fed."""

from typing import NamedTuple

from neurove_core.estimator import WindowEstimate
from neurove_core.ingest.windows import Pushed, WindowsState
from neurove_protocol import CameraInfo, Sensor
from neurove_protocol.events import Packet
from neurove_service import logs
from neurove_service.streams.comparison import Comparison
from neurove_service.streams.lane import Answer, Beside, Lane, Pace, Primed, Serving, replay, windows_to_prime
from neurove_service.streams.ring import Packed, Ring, packed

log = logs.get(__name__)

About = tuple[Sensor, CameraInfo | None]


class RingSize(NamedTuple):
    """What a stream keeps of its newest windows, to prime another model with."""

    windows: int = 64
    max_bytes: int = 16 << 20


class Roles(NamedTuple):
    """Which models are at work on a stream."""

    answers: Serving
    beside: Serving | None = None
    probation: bool = False  # the one beside is the proven one, and takes over where the one that answers fails


class Unfit(Exception):  # it says what the model is
    """The model on probation failed on a window; the one beside it can answer."""


class Pushing(NamedTuple):
    """What came of one packet."""

    estimates: list[WindowEstimate]
    serving: Serving
    late_events: int
    outside_events: int
    skipped_windows: int


class Lanes:
    """The models at work on one stream, and the ring that brings another one up to date.

    The stream's worker alone uses it, but for `prime`, `offer`, and the comparison, which any thread may read.

    Args:
        stream: its name, for the log.
        size: of the ring.
    """

    def __init__(self, stream: str, size: RingSize) -> None:
        self._stream, self._size = stream, size
        self.comparison: Comparison | None = None
        self.beside: Beside | None = None
        self.front: Lane | None = None
        self._ring = Ring(*size)
        self._about: About | None = None
        self._roles: Roles | None = None
        self._cut: Pushed | None = None  # windows that the front could not answer
        self._offered: Primed | None = None

    @property
    def horizon_us(self) -> int | None:
        """Sensor time up to which all events are known; None at rest."""
        return self.front.state.windows.horizon_us if self.front else None

    @property
    def owes(self) -> bool:
        """Whether the model beside has something to catch up on."""
        return self.beside is not None and self.beside.owes

    def restart(self) -> None:
        """Forget all state: the next packet begins anew, for every model."""
        self.front = self.beside = self._cut = self._roles = None
        self._ring = Ring(*self._size)

    # --- another thread

    def prime(self, serving: Serving, pace: Pace, before: Primed | None = None) -> Primed | None:
        """Prime a lane: from rest with the newest windows, or `before` with those that came since.

        Args:
            serving: the model.
            pace: as of replay.
            before: what an earlier call returned.

        Returns:
            the lane, or None where the stream is at rest or cuts otherwise than the model.
        """
        front, about, ring = self.front, self._about, self._ring
        if front is None or about is None or not front.estimator.has_same_windows(serving.estimator):
            return None
        if before is None or before.ring is not ring:
            return Primed(
                replay(_at_rest(serving, about), ring.newest(windows_to_prime(serving.estimator)), pace), ring
            )
        replay(before.lane, ring.after(before.lane.state.end_us), pace)
        return before

    def offer(self, lane: Primed | None) -> None:
        """Have a primed lane ready for when its model is to be at work here."""
        self._offered = lane

    # --- the stream's worker

    def arrange(self, roles: Roles, about: About, packet: Packet) -> int:
        """Put the models to work that are to be from this packet on.

        Returns:
            windows that are given up, for the models cut differently.
        """
        if self.front is None:
            self._about = about
            self.front = _at_rest(roles.answers, about)
        if roles == self._roles:
            return 0
        skipped = 0
        old = self.front
        if old.estimator is not roles.answers.estimator:
            skipped = self._hand_over(old, roles, packet)
        self.front.serving = roles.answers
        self._place_beside(old, roles, packet)
        self._roles = roles
        return skipped

    def push(self, packet: Packet) -> Pushing:
        """Answer every window that a packet completes; after Unfit, the same packet by the model that took over.

        Raises:
            Unfit: the model on probation failed; nothing is lost.
        """
        front, beside = self.front, self.beside
        assert front is not None, "arrange comes first"
        cut = self._cut or front.estimator.to_windows(packet.events, front.state, packet.t0_us)
        front.state = front.state._replace(windows=cut.state)
        try:
            answers = front.follow(cut.windows, checked=beside is not None)
        except Exception as error:
            if beside is None or self.comparison is None or not self.comparison.front_is_tried:
                raise
            self._cut = cut
            raise Unfit(f"{type(error).__name__}: {error}") from error
        self._cut = None
        entries = [packed(window) for window in cut.windows if front.whole(window)]
        for entry in entries:
            self._ring.append(entry)
        if beside is not None:
            self._note(answers, beside, packet, entries)
        outside = sum(window.outside for window in cut.windows)
        estimates = [one.estimate for one in answers if front.may_answer(one.estimate.start_us)]
        return Pushing(estimates, front.serving, cut.late_events, outside, cut.skipped_windows)

    def attend(self) -> None:
        """Let the model beside do one piece of what it owes."""
        beside, comparison = self.beside, self.comparison
        if beside is None or comparison is None or not beside.owes:
            return
        try:
            answers = beside.step()
        except Exception as error:  # noqa: BLE001  # whatever a model on trial does, the one that answers goes on
            beside.fault = f"{type(error).__name__}: {error}"
            self._lose(beside, beside.fault)
            return
        for answer in answers:
            comparison.beside(answer.compared, answer.took_ms)

    def _note(self, answers: list[Answer], beside: Beside, packet: Packet, entries: list[Packed]) -> None:
        if self.comparison is not None:
            for answer in answers:
                self.comparison.front(answer.compared, answer.took_ms)
        stood_still = beside.lost
        beside.owe(packet, entries)
        if beside.lost and not stood_still:
            self._lose(beside, "it fell behind: the node can not run both models")

    def _lose(self, beside: Beside, why: str) -> None:
        beside.give_up()
        if self.comparison is not None and not self.comparison.front_is_tried:
            self.comparison.fault = why
        log.warning("model beside given up", stream=self._stream, model=beside.lane.estimator.bundle.name, why=why)

    def _hand_over(self, old: Lane, roles: Roles, packet: Packet) -> int:
        """Another model answers from here on: windows up to here are the old one's, all later ones the new one's."""
        new = self._lane(roles.answers, packet)
        self.front = new
        if new.estimator.has_same_windows(old.estimator):
            new.state = new.state._replace(windows=old.state.windows)
            return 0
        open_us = old.state.windows.start_us
        new.answer_from(old.state.end_us)
        self._ring = Ring(*self._size)  # its windows are cut otherwise
        self._cut = None
        return int(open_us is not None and new.next_us != open_us)

    def _lane(self, serving: Serving, packet: Packet) -> Lane:
        """The lane of a model, as far along as the front: the one beside, one that was offered, or a new one."""
        beside, about = self.beside, self._about
        assert about is not None
        assert self.front is not None
        if beside is not None and beside.lane.estimator is serving.estimator and not beside.lost:
            while beside.owes:
                self.attend()
            if not beside.lost:
                return beside.lane
        if not self.front.estimator.has_same_windows(serving.estimator):
            return _from_here(serving, packet, about) if self.front.next_us is not None else _at_rest(serving, about)
        offered = self._taken(serving)
        if offered is not None:
            return replay(offered, self._ring.after(offered.state.end_us))
        return replay(_at_rest(serving, about), self._ring.newest(windows_to_prime(serving.estimator)))

    def _place_beside(self, old: Lane, roles: Roles, packet: Packet) -> None:
        wanted = roles.beside
        if wanted is None:
            self.beside = self.comparison = None
            return
        assert self.front is not None
        if self.beside is None or self.beside.lane.estimator is not wanted.estimator:
            self.beside = self._beside(old, wanted, packet)
            self.comparison = None
        self.beside.lane.serving = wanted
        tried = roles.answers if roles.probation else wanted
        if self.comparison is None or self.comparison.front_is_tried != roles.probation:
            windows = [one.estimator.config.window.duration_us for one in (roles.answers, wanted)]
            reach_us = max(windows) // 2 if not self.beside.alike else 0
            window_ms = tried.estimator.config.window.duration_us / 1e3
            self.comparison = Comparison(front_is_tried=roles.probation, window_ms=window_ms, reach_us=reach_us)

    def _beside(self, old: Lane, wanted: Serving, packet: Packet) -> Beside:
        """A lane that runs beside; what it has to replay it owes, for the feed does not wait for it."""
        assert self.front is not None
        assert self._about is not None
        if old.estimator is wanted.estimator:
            lane, replayed = old, list[Packed]()
        elif not self.front.estimator.has_same_windows(wanted.estimator):
            return Beside(self._lane(wanted, packet), alike=False)
        elif (offered := self._taken(wanted)) is not None:
            lane, replayed = offered, self._ring.after(offered.state.end_us)
        else:
            lane, replayed = (
                _at_rest(wanted, self._about),
                self._ring.newest(windows_to_prime(wanted.estimator)),
            )
        alike = lane.estimator.has_same_windows(self.front.estimator)
        if alike:
            lane.state = lane.state._replace(windows=WindowsState())
        return Beside(lane, alike=alike, replayed=replayed)

    def _taken(self, serving: Serving) -> Lane | None:
        """The lane that was offered, where it is of this model and of what the stream sees now."""
        offered = self._offered
        if offered is None or offered.lane.estimator is not serving.estimator or offered.ring is not self._ring:
            return None
        self._offered = None
        return offered.lane


def _at_rest(serving: Serving, about: About) -> Lane:
    return Lane(serving, serving.estimator.initial_state(*about))


def _from_here(serving: Serving, packet: Packet, about: About) -> Lane:
    """A lane at rest that cuts from this packet on: the window that is open now is not whole for it."""
    duration_us = serving.estimator.config.window.duration_us
    return Lane(serving, serving.estimator.initial_state(*about), -(-packet.t0_us // duration_us) * duration_us)
