"""Lanes: the models at work on one stream. One answers; another may run in standby."""

from typing import NamedTuple

from neurove_core.ingest.windows import Pushed, WindowsState
from neurove_core.stream_state import WindowEstimate
from neurove_protocol.events import Packet
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.streams.comparison import Comparison
from neurove_service.streams.history import History, Optics, Primed, RingSize, prime, zero_lane
from neurove_service.streams.lane import Lane, OpenWindow, Pace, TimedEstimate, replay
from neurove_service.streams.ring import PackedWindow, pack
from neurove_service.streams.roles import Roles, Serving
from neurove_service.streams.standby import Standby

log = logs.get(__name__)


class ServingModelFailed(Exception):
    """The model on probation failed on a window; the standby model can answer it."""


class Pushing(NamedTuple):
    """The result of one packet."""

    estimates: list[WindowEstimate]
    serving: Serving
    late_events: int
    outside_events: int
    skipped_windows: int
    unrefined_windows: int = 0  # not refined, because the node is behind


class Lanes:
    """The models at work on one stream, and the history that primes another one.

    Only the worker of the stream uses it. Other threads may call `prime` and `history.offer`, and read the comparison.

    Args:
        stream: its name, for the log.
        size: bounds of the history.
        guard: counts errors of the refinement.
    """

    def __init__(self, stream: str, size: RingSize, guard: Guard) -> None:
        self._stream, self._guard = stream, guard
        self.comparison: Comparison | None = None
        self.serving_lane: Lane | None = None
        self.standby: Standby | None = None
        self.history = History(size)
        self._optics: Optics | None = None
        self._roles: Roles | None = None
        self._unanswered: Pushed | None = None  # windows on which the serving model failed

    @property
    def open_window(self) -> OpenWindow | None:
        """The open window of the serving lane; None before the first packet."""
        return self.serving_lane.open_window if self.serving_lane else None

    @property
    def has_backlog(self) -> bool:
        """Whether the standby model has a backlog."""
        return self.standby is not None and self.standby.has_backlog

    def leave_out_until(self, start_us: int) -> None:
        """Leave out all windows before `start_us`, the open one included; the network state goes on over them."""
        lane = self.serving_lane
        assert lane is not None, "call assign first"
        lane.state = lane.state._replace(windows=WindowsState(start_us, start_us, bridged=True))
        self._unanswered = None

    def restart(self) -> None:
        """Forget all state of every model; the next packet begins a new sequence."""
        self.serving_lane = self.standby = self._unanswered = self._roles = None
        self.history.clear()

    def prime(self, serving: Serving, pace: Pace, before: Primed | None = None) -> Primed | None:
        """Prime a lane on the thread of the caller, see `history.prime`.

        Returns:
            the lane; None if the stream has no state yet, or if the windows of the model differ.
        """
        lane, optics = self.serving_lane, self._optics
        if lane is None or optics is None or not lane.estimator.has_same_windows(serving.estimator):
            return None
        return prime(self.history, serving, optics, pace, before)

    def assign(self, roles: Roles, optics: Optics, packet: Packet) -> int:
        """Set the models that work from this packet on.

        Returns:
            number of windows that no model answers, because the windows of both models differ.
        """
        if self.serving_lane is None:
            self._optics = optics
            self.serving_lane = zero_lane(roles.serving, optics)
        if roles == self._roles:
            return 0
        skipped = 0
        old = self.serving_lane
        if old.estimator is not roles.serving.estimator:
            skipped = self._hand_over(old, roles, packet)
        self.serving_lane.serving = roles.serving
        self._set_standby(old, roles, packet)
        self._roles = roles
        return skipped

    def push(self, packet: Packet, *, behind: bool = False) -> Pushing:
        """Answer every window that a packet completes; without refinement if the stream is behind.

        The comparison gets the network's answers: the refinement makes two models more alike than they are.
        After ServingModelFailed, assign the roles again and push the same packet: the standby model answers it.

        Raises:
            ServingModelFailed: the model on probation failed; no window is lost.
        """
        lane, standby = self.serving_lane, self.standby
        assert lane is not None, "call assign first"
        pushed = self._unanswered or lane.estimator.to_windows(packet.events, lane.state, packet.t0_us)
        lane.state = lane.state._replace(windows=pushed.state)
        if standby is None and not pushed.windows:
            return Pushing([], lane.serving, pushed.late_events, 0, pushed.skipped_windows)
        try:
            answers = lane.follow(pushed.windows, checked=standby is not None)
        except Exception as error:
            if standby is None or self.comparison is None or not self.comparison.serving_is_tried:
                raise
            self._unanswered = pushed
            raise ServingModelFailed(f"{type(error).__name__}: {error}") from error
        self._unanswered = None
        entries = [pack(window) for window in pushed.windows if lane.has_all_events(window)]
        for entry in entries:
            self.history.ring.append(entry)
        if standby is not None:
            self._add_to_trial(answers, standby, packet, entries)
        outside = sum(window.outside for window in pushed.windows)
        refined, unrefined = lane.refine(answers, pushed.windows, self._guard, behind=behind)
        refined = [one for one in refined if lane.may_answer(one.start_us)]
        return Pushing(refined, lane.serving, pushed.late_events, outside, pushed.skipped_windows, unrefined)

    def run_standby(self) -> None:
        """Process the oldest entry of the standby model's backlog."""
        standby, comparison = self.standby, self.comparison
        if standby is None or comparison is None or not standby.has_backlog:
            return
        try:
            answers = standby.step()
        except Exception as error:  # noqa: BLE001  # the serving model goes on, whatever a standby model does
            standby.fault = f"{type(error).__name__}: {error}"
            self._stop_standby(standby, standby.fault)
            return
        for answer in answers:
            comparison.add_standby(answer.result, answer.took_ms)

    def _add_to_trial(
        self, answers: list[TimedEstimate], standby: Standby, packet: Packet, entries: list[PackedWindow]
    ) -> None:
        if self.comparison is not None:
            for answer in answers:
                self.comparison.add_serving(answer.result, answer.took_ms)
        was_stopped = standby.stopped
        standby.add(packet, entries)
        if standby.stopped and not was_stopped:
            self._stop_standby(standby, "it fell behind: the node cannot run both models")

    def _stop_standby(self, standby: Standby, why: str) -> None:
        standby.stop()
        if self.comparison is not None and not self.comparison.serving_is_tried:
            self.comparison.fault = why
        log.warning("standby model stopped", stream=self._stream, model=standby.lane.estimator.bundle.name, why=why)

    def _hand_over(self, old: Lane, roles: Roles, packet: Packet) -> int:
        """Let another model serve from here on; the old model has answered all earlier windows."""
        new = self._lane(roles.serving, packet)
        self.serving_lane = new
        if new.estimator.has_same_windows(old.estimator):
            new.state = new.state._replace(windows=old.state.windows, stages=old.state.stages, ground=old.state.ground)
            return 0
        open_us = old.state.windows.start_us
        new.answer_from(old.state.end_us)
        self.history.clear()  # its windows differ from the new model's
        self._unanswered = None
        return int(open_us is not None and new.next_us != open_us)

    def _lane(self, serving: Serving, packet: Packet) -> Lane:
        """The lane of a model, as far as the serving lane: the standby lane, an offered lane, or a new lane."""
        standby, optics = self.standby, self._optics
        assert optics is not None
        assert self.serving_lane is not None
        if standby is not None and standby.lane.estimator is serving.estimator and not standby.stopped:
            while standby.has_backlog:
                self.run_standby()
            if not standby.stopped:
                return standby.lane
        if not self.serving_lane.estimator.has_same_windows(serving.estimator):
            return (
                _cold_lane(serving, packet, optics)
                if self.serving_lane.next_us is not None
                else zero_lane(serving, optics)
            )
        offered = self.history.take_offered(serving)
        if offered is not None:
            return replay(offered, self.history.ring.after(offered.state.end_us))
        return self.history.primed(serving, optics)

    def _set_standby(self, old: Lane, roles: Roles, packet: Packet) -> None:
        wanted = roles.standby
        if wanted is None:
            self.standby = self.comparison = None
            return
        if self.standby is None or self.standby.lane.estimator is not wanted.estimator:
            self.standby = self._new_standby(old, wanted, packet)
            self.comparison = None
        self.standby.lane.serving = wanted
        if self.comparison is None or self.comparison.serving_is_tried != roles.probation:
            self.comparison = _comparison(roles.serving, wanted, self.standby, probation=roles.probation)

    def _new_standby(self, old: Lane, wanted: Serving, packet: Packet) -> Standby:
        """A standby lane; the windows that it must replay go into its backlog, because the data feed does not wait."""
        assert self.serving_lane is not None
        assert self._optics is not None
        if old.estimator is wanted.estimator:
            lane, replayed = old, list[PackedWindow]()
        elif not self.serving_lane.estimator.has_same_windows(wanted.estimator):
            return Standby(self._lane(wanted, packet), same_windows=False)
        elif (offered := self.history.take_offered(wanted)) is not None:
            lane, replayed = offered, self.history.ring.after(offered.state.end_us)
        else:
            lane, replayed = zero_lane(wanted, self._optics), self.history.newest_for(wanted)
        same_windows = lane.estimator.has_same_windows(self.serving_lane.estimator)
        if same_windows:
            lane.state = lane.state._replace(windows=WindowsState())
        return Standby(lane, same_windows=same_windows, replayed=replayed)


def _cold_lane(serving: Serving, packet: Packet, optics: Optics) -> Lane:
    """A lane in the zero state that begins at this packet: the window that is open now is incomplete for it."""
    duration_us = serving.estimator.config.window.duration_us
    return Lane(serving, serving.estimator.initial_state(*optics), -(-packet.t0_us // duration_us) * duration_us)


def _comparison(serving: Serving, other: Serving, standby: Standby, *, probation: bool) -> Comparison:
    tried = serving if probation else other
    windows = [one.estimator.config.window.duration_us for one in (serving, other)]
    reach_us = max(windows) // 2 if not standby.same_windows else 0
    window_ms = tried.estimator.config.window.duration_us / 1e3
    return Comparison(serving_is_tried=probation, window_ms=window_ms, reach_us=reach_us)
