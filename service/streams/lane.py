"""Lane: one model's state on one stream."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from neurove_core.carried import Carried
from neurove_core.estimator import Estimator
from neurove_core.ingest.windows import Window
from neurove_core.networks.arrays import ArrayState
from neurove_core.stream_state import StreamState, WindowEstimate
from neurove_service.guard import Guard
from neurove_service.streams.comparison import WindowResult
from neurove_service.streams.ring import PackedWindow
from neurove_service.streams.roles import Serving

PRIME_WINDOWS = 64
"""Windows that are replayed if the bundle does not say how many. More windows leave less of the change visible; no
measured number leaves none of it (decision 29)."""

Pace = Callable[[float], object]


class NotFinite(ArithmeticError):
    """A model computed values that are not finite."""


class TimedEstimate(NamedTuple):
    """The network's estimate and its cost."""

    estimate: WindowEstimate
    rate: float  # share of the estimator's cells that fired
    took_ms: float  # processor time

    @property
    def result(self) -> WindowResult:
        """The part of the estimate that is compared."""
        return WindowResult(self.estimate.end_us, self.estimate.twists.mean(axis=0), self.rate)


class OpenWindow(NamedTuple):
    """The window that a lane fills."""

    start_us: int
    duration_us: int
    horizon_us: int  # sensor time up to which all events are known
    events: int

    @property
    def end_us(self) -> int:
        """End of the window [us]."""
        return self.start_us + self.duration_us


class Lane:
    """One model's state on one stream.

    Args:
        serving: the model.
        state: its initial state.
        complete_from_us: windows that begin earlier are incomplete, because this lane did not get their first events.
    """

    def __init__(self, serving: Serving, state: StreamState, complete_from_us: int | None = None) -> None:
        self.serving, self.state = serving, state
        self._complete_from_us = complete_from_us
        self._answers_from_us: int | None = None
        self._adopted: tuple[int, Carried] | None = None
        self.adopted_us: int | None = None  # start of the window with which the state of another node began

    @property
    def estimator(self) -> Estimator:
        """The estimator of the model."""
        return self.serving.estimator

    @property
    def next_us(self) -> int | None:
        """Start of the next window [us]; None before the first packet."""
        return self.state.windows.start_us

    @property
    def open_window(self) -> OpenWindow | None:
        """The window that is filled now; None before the first packet."""
        start_us, horizon_us, _, events, *_ = self.state.windows
        if start_us is None:
            return None
        return OpenWindow(start_us, self.estimator.config.window.duration_us, horizon_us, events)

    def has_all_events(self, window: Window) -> bool:
        """Whether this lane got all events of a window."""
        return self._complete_from_us is None or window.start_us >= self._complete_from_us

    def answer_from(self, start_us: int | None) -> None:
        """Do not answer windows that begin earlier: the previous lane answered them."""
        self._answers_from_us = start_us

    def may_answer(self, start_us: int) -> bool:
        """Whether this lane answers a window that begins here."""
        return self._answers_from_us is None or start_us >= self._answers_from_us

    def adopt(self, start_us: int, state: Carried) -> None:
        """Go on with the state of another node from the window that begins here; dropped if there is no such window."""
        self._adopted = start_us, state

    def _adopt_at(self, start_us: int, state: StreamState) -> StreamState:
        """The state before the window that begins here."""
        if self._adopted is not None and start_us >= self._adopted[0]:
            if start_us == self._adopted[0]:
                state, self.adopted_us = self._adopted[1].into(state), start_us
                self._complete_from_us = None
            self._adopted = None
        return state

    def follow(self, windows: list[Window], *, checked: bool = False) -> list[TimedEstimate]:
        """Answer windows in order; if an error is raised, the state stays as before the call.

        Args:
            windows: with the duration and the grid of this model.
            checked: whether to check the answers and the state for values that are not finite.

        Raises:
            NotFinite: a value is not finite.
        """
        state, answers = self.state, []
        for window in windows:
            state = self._adopt_at(window.start_us, state)
            if not self.has_all_events(window):
                continue
            began = time.thread_time()  # as in admission: time spent waiting for other work is not the model's
            (estimate,), state = self.estimator.follow((window,), state)
            took_ms = 1e3 * (time.thread_time() - began)
            if checked and not (np.isfinite(estimate.twists).all() and state.network.finite()):
                raise NotFinite(f"not finite in the window at {window.start_us} us")
            answers.append(TimedEstimate(estimate, _rate(state), took_ms))
        self.state = state
        return answers

    def refine(
        self, answers: list[TimedEstimate], windows: list[Window], guard: Guard, *, behind: bool
    ) -> tuple[list[WindowEstimate], int]:
        """Refine the angular parts of answers, unless the stream is behind.

        Args:
            answers: of these windows, in order.
            windows: those without a sample are not refined.
            guard: counts errors of the refinement.
            behind: whether to leave the answers as they are.

        Returns:
            the estimates, and the number of windows that were not refined, because the stream is behind or because
            the refinement failed. Then the model's answer stands, and the refinement begins again.
        """
        if behind:
            return [answer.estimate for answer in answers], sum(window.sample is not None for window in windows)
        by_start, found, failed = {window.start_us: window for window in windows}, list[WindowEstimate](), 0
        for answer in answers:
            estimate, window = answer.estimate, by_start[answer.estimate.start_us]
            try:
                estimate, self.state = self.estimator.refine(window, estimate, self.state)
            except Exception as error:  # noqa: BLE001  # it must not cost the answer of the model
                guard.caught("refinement", error)
                self.state = self.state.without_refinement()
                failed += 1
            found.append(estimate)
        return found, failed


def _rate(state: StreamState) -> float:
    """Share of the estimator's cells that fired; 0 in a network without spiking cells."""
    network = state.network
    if isinstance(network, ArrayState):
        return network.rate
    cells = getattr(network, "cells", ())
    return float(np.mean([float(cell.s.mean()) for cell in cells])) if cells else 0.0


def windows_to_prime(estimator: Estimator) -> int:
    """Number of windows that a model should see before it answers a stream: the bundle's value if it has one."""
    wanted = estimator.bundle.metadata.prime_windows
    wanted = max(estimator.config.settle_windows, PRIME_WINDOWS) if wanted is None else wanted
    return max(wanted, sum(estimator.config.network.history))


def replay(lane: Lane, entries: list[PackedWindow], pace: Pace | None = None) -> Lane:
    """Run a lane over past windows.

    Args:
        lane: its model has the duration and the grid of these windows.
        entries: oldest first.
        pace: called after each window with the time that it took [s], to leave processor time to other work.
    """
    for entry in entries:
        for answer in lane.follow([entry.window()]):
            if pace is not None:
                pace(answer.took_ms / 1e3)
    return lane
