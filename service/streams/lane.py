"""Lane: one model's way along one stream; and the one that runs beside the lane that answers."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from neurove_core.estimator import Estimator, StreamState, WindowEstimate
from neurove_core.ingest.windows import Window
from neurove_core.networks.neurove import NetworkState
from neurove_protocol.events import Packet
from neurove_service.streams.comparison import Outcome
from neurove_service.streams.ring import Packed, Ring

MOST_OWED_WINDOWS, MOST_OWED_PACKETS, MOST_OWED_EVENTS = 128, 4096, 4_000_000
"""A lane beside that owes more than this is given up: the node can not run two models."""


PRIME_WINDOWS = 64
"""Windows that are replayed where the bundle does not say: more leave less of the change, none of those tried nothing
(decision 29)."""

Pace = Callable[[float], object]


class Serving(NamedTuple):
    """A model that streams answer with, and the number of model changes up to it."""

    estimator: Estimator
    epoch: int


class NotFinite(ArithmeticError):
    """A model computed numbers that are not finite."""


class Answer(NamedTuple):
    """An estimate, and what it took."""

    estimate: WindowEstimate
    rate: float  # share of the estimator cells that fired
    took_ms: float  # processor time

    @property
    def compared(self) -> Outcome:
        """The part of it that is compared."""
        return Outcome(self.estimate.end_us, self.estimate.twists.mean(axis=0), self.rate)


class Lane:
    """One model's state on one stream.

    Args:
        serving: the model.
        state: where it begins.
        whole_from_us: windows that begin earlier are not whole, for their first events went to another lane.
    """

    def __init__(self, serving: Serving, state: StreamState, whole_from_us: int | None = None) -> None:
        self.serving, self.state = serving, state
        self._whole_from_us = whole_from_us
        self._answers_from_us: int | None = None

    @property
    def estimator(self) -> Estimator:
        """Its model."""
        return self.serving.estimator

    @property
    def next_us(self) -> int | None:
        """Where its next window begins; None before the first packet."""
        return self.state.windows.start_us

    def whole(self, window: Window) -> bool:
        """Whether all events of a window came to this lane."""
        return self._whole_from_us is None or window.start_us >= self._whole_from_us

    def answer_from(self, start_us: int | None) -> None:
        """Leave windows that begin earlier to the lane before: it has answered up to here."""
        self._answers_from_us = start_us

    def may_answer(self, start_us: int) -> bool:
        """Whether a window that begins there is this lane's to answer."""
        return self._answers_from_us is None or start_us >= self._answers_from_us

    def follow(self, windows: list[Window], *, checked: bool = False) -> list[Answer]:
        """Answer windows one after the other; where it raises, the state is as before.

        Args:
            windows: cut as this model cuts.
            checked: whether to look for numbers that are not finite, in the answers and in the state.

        Raises:
            NotFinite: there are some.
        """
        state, answers = self.state, []
        for window in windows:
            if not self.whole(window):
                continue
            began = time.thread_time()  # as at admission: waiting for other work says nothing about the model
            (estimate,), state = self.estimator.follow((window,), state)
            took_ms = 1e3 * (time.thread_time() - began)
            if checked and not (np.isfinite(estimate.twists).all() and state.network.finite()):
                raise NotFinite(f"not finite in the window at {window.start_us} us")
            answers.append(Answer(estimate, _rate(state), took_ms))
        self.state = state
        return answers


def _rate(state: StreamState) -> float:
    """Share of the estimator's cells that fired; 0 in a network without spiking cells."""
    if not isinstance(state.network, NetworkState):
        return 0.0
    return float(torch.stack([cell.s.mean() for cell in state.network.cells]).mean())


class Primed(NamedTuple):
    """A lane that was brought up to date outside of its stream's worker."""

    lane: Lane
    ring: Ring  # of the windows that it has seen: where the stream has another by now, it began anew meanwhile


def windows_to_prime(estimator: Estimator) -> int:
    """Windows that a model should have seen before it answers a stream: as its bundle says, where it does."""
    told = estimator.bundle.about.prime_windows
    return max(estimator.config.settle_windows, PRIME_WINDOWS) if told is None else told


def replay(lane: Lane, entries: list[Packed], pace: Pace | None = None) -> Lane:
    """Let a lane see these windows.

    Args:
        lane: of a model that cuts as they were cut.
        entries: oldest first.
        pace: called after each with the time that it took [s], to leave the machine to others.
    """
    for entry in entries:
        for answer in lane.follow([entry.window()]):
            if pace is not None:
                pace(answer.took_ms / 1e3)
    return lane


class Beside:
    """A lane that answers nobody: the candidate in shadow, or the proven model that is kept fed on probation.

    It owes its windows until its stream has time for them.

    Args:
        lane: the model.
        alike: whether it takes the windows of the lane that answers; else it cuts the packets itself.
        replayed: windows of the past that it is primed with first.
    """

    def __init__(self, lane: Lane, *, alike: bool, replayed: Sequence[Packed] = ()) -> None:
        self.lane, self.alike = lane, alike
        self._owed: deque[Packed | Packet] = deque(replayed)
        self._most_windows = MOST_OWED_WINDOWS + len(replayed)
        self._owed_events = 0  # of packets, which are kept as they came
        self.fault = ""  # what it failed with; empty where it did not
        self.lost = False  # it owed too much and stands still since

    @property
    def owes(self) -> bool:
        """Whether there is something to catch up on."""
        return bool(self._owed)

    @property
    def behind(self) -> int:
        """How many windows, or packets, it is behind."""
        return len(self._owed)

    def owe(self, packet: Packet, windows: list[Packed]) -> None:
        """Note what is to be done for it."""
        if self.lost:
            return
        self._owed.extend(windows if self.alike else [packet])
        self._owed_events += 0 if self.alike else packet.events.n
        most = self._most_windows if self.alike else MOST_OWED_PACKETS
        if len(self._owed) > most or self._owed_events > MOST_OWED_EVENTS:
            self.give_up()

    def give_up(self) -> None:
        """Stand still: where the model is needed again, it is primed anew."""
        self._owed.clear()
        self.lost = True

    def step(self) -> list[Answer]:
        """Work on the oldest that it owes.

        Raises:
            NotFinite: the model computed numbers that are not finite.
        """
        owed = self._owed.popleft()
        if isinstance(owed, Packed):
            return self.lane.follow([owed.window()], checked=True)
        self._owed_events -= owed.events.n
        state = self.lane.state
        pushed = self.lane.estimator.to_windows(owed.events, state, owed.t0_us)
        self.lane.state = state._replace(windows=pushed.state)
        return self.lane.follow(pushed.windows, checked=True)
