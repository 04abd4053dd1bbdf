"""The parts of a model change that look at streams: priming them, running beside them, watching a new model."""

import time
from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple, Protocol

from neurove_protocol.errors import Diverged
from neurove_service.streams.comparison import LEAST_WINDOWS, Finding, Measured, TrialLimits, finding
from neurove_service.streams.lane import Primed, Serving, windows_to_prime
from neurove_service.streams.lanes import Lanes, Roles

POLL_S = 0.05
"""How often streams are looked at."""

JUDGED_WINDOWS = 16
"""On probation the newest so many windows are judged, so that a model that turns bad is seen within a second."""

_MOST_PAUSE_S = 0.02
_ROUNDS = 3
_MOST_BEHIND = 1  # windows that are left to do at the switch
_MOST_SETTLING_S = 30.0

Phase = Literal["steady", "priming", "shadow", "canary", "probation"]


class Subject(Protocol):
    """A stream, as far as a model change sees it."""

    name: str
    lanes: Lanes

    @property
    def flowing(self) -> bool:
        """Whether packets come."""


class Plan(NamedTuple):
    """Which models are at work; streams read it once per packet."""

    active: Serving
    other: Serving | None = None  # priming, shadow, canary: the candidate; probation: the proven one
    only: frozenset[str] = frozenset()  # streams that are concerned; empty: all
    phase: Phase = "steady"
    promoting: bool = False  # a canary: all other streams prime its model

    def concerns(self, stream: str) -> bool:
        """Whether the other model is at work on this stream."""
        return self.other is not None and (not self.only or stream in self.only)

    def roles(self, stream: str) -> Roles:
        """What a stream answers with, and what runs beside."""
        if self.other is None:
            return Roles(self.active)
        if not self.concerns(stream):
            return Roles(self.active, self.other if self.promoting else None)
        if self.phase == "canary":
            return Roles(self.other, self.active, probation=True)
        return Roles(self.active, self.other, probation=self.phase == "probation")

    @property
    def tried(self) -> Serving | None:
        """The model that answers and may still be taken back."""
        return self.active if self.phase == "probation" else self.other if self.phase == "canary" else None

    @property
    def proven(self) -> Serving | None:
        """The model that takes over if it is."""
        return self.other if self.phase == "probation" else self.active if self.phase == "canary" else None


def gently(took_s: float) -> None:
    """Leave the machine to the streams for as long as a window took: half of one core at most is used."""
    time.sleep(min(took_s, _MOST_PAUSE_S))


def prime(
    serving: Serving, streams: Callable[[], list[Subject]], most_s: float, wait: Callable[[float], bool]
) -> tuple[int, int]:
    """Bring a model to where it would be had it always served, for each stream that can be replayed.

    On a stream with packets its own worker does it, in the time that these leave: the plan has the model run beside,
    and this waits. A stream where none come is replayed here.

    Args:
        serving: the model; it runs beside all streams that it is for.
        streams: those of them that are to be primed.
        most_s: how long a model waits for windows that its bundle wants it to have seen beyond those that are kept.
        wait: sleeps, and says whether to give up.

    Returns:
        how many streams are primed, and how many are not: they are at rest, or cut otherwise than the model.

    Raises:
        Diverged: the model failed on a window.
    """
    began, deadline = time.monotonic(), time.monotonic() + most_s + _MOST_SETTLING_S
    while time.monotonic() < deadline:
        late = time.monotonic() - began > most_s
        if all(_at_its_end(serving, stream, late=late) for stream in streams() if _worker_primes(serving, stream)):
            break
        if wait(POLL_S):
            break
    done = left = 0
    for stream in streams():
        lane: Primed | None = None
        beside = _worker_primes(serving, stream)
        if not beside:
            for _ in range(_ROUNDS):  # while it replayed, windows came: each round leaves fewer of them
                lane = stream.lanes.prime(serving, gently, lane)
            stream.lanes.offer(lane)
        primed = beside or lane is not None
        done, left = done + primed, left + (not primed)
    return done, left


def _worker_primes(serving: Serving, stream: Subject) -> bool:
    front = stream.lanes.front
    return stream.flowing and front is not None and front.estimator.has_same_windows(serving.estimator)


def _at_its_end(serving: Serving, stream: Subject, *, late: bool) -> bool:
    """Whether a model beside has seen what it should, or all that there is, and the stream's newest window."""
    front, beside = stream.lanes.front, stream.lanes.beside
    if front is None or beside is None or beside.lane.estimator is not serving.estimator:
        return front is not None and front.estimator is serving.estimator
    if beside.fault:
        raise Diverged(serving.estimator.bundle.name, f"fault on stream {stream.name}", beside.fault, "none")
    wanted = min(windows_to_prime(serving.estimator), front.state.age)
    return beside.lost or (beside.behind <= _MOST_BEHIND and (late or beside.lane.state.age + _MOST_BEHIND >= wanted))


def settled(serving: Serving, streams: Iterable[Subject]) -> bool:
    """Whether a model that could not be replayed has run beside every stream for as long as it needs to settle."""
    wanted = serving.estimator.config.settle_windows + 1
    besides = [stream.lanes.beside for stream in streams if stream.lanes.front is not None]
    return all(one is not None and (one.lost or one.lane.state.age >= wanted) for one in besides)


def settling_s(serving: Serving) -> float:
    """How long to wait for `settled` at most: a stream may stand still."""
    windows = serving.estimator.config.settle_windows + 2
    return min(_MOST_SETTLING_S, 1.0 + 2 * windows * serving.estimator.config.window.duration_us / 1e6)


def measured(serving: Serving, streams: Iterable[Subject], *, front_is_tried: bool) -> dict[str, Measured]:
    """What the trial of a model has come to, by stream."""
    found = {}
    for stream in streams:
        lanes, comparison = stream.lanes, stream.lanes.comparison
        lane = lanes.front if front_is_tried else lanes.beside.lane if lanes.beside else None
        same = lane is not None and lane.estimator is serving.estimator
        if same and comparison is not None and comparison.front_is_tried == front_is_tried:
            found[stream.name] = comparison.measured()
    return found


def worst(found: dict[str, Measured], limits: TrialLimits, newest: int) -> tuple[str, Finding] | None:
    """The first stream on which a model broke a limit, and which."""
    for name, one in found.items():
        wrong = finding(one, limits, newest)
        if wrong is not None:
            return name, wrong
    return None


def shadow(
    serving: Serving,
    streams: Callable[[], list[Subject]],
    seconds: float,
    limits: TrialLimits,
    wait: Callable[[float], bool],
) -> dict[str, Measured]:
    """Look at a model that runs beside another for so long.

    Args:
        serving: the model.
        streams: those it runs beside.
        seconds: how long.
        limits: what it must keep to.
        wait: sleeps, and says whether to give up.

    Raises:
        Diverged: it broke a limit, or too few windows came to tell.
    """
    name, deadline = serving.estimator.bundle.name, time.monotonic() + seconds
    while True:
        found = measured(serving, streams(), front_is_tried=False)
        for stream, one in found.items():
            if one.fault:
                raise Diverged(name, f"fault on stream {stream}", one.fault, "none")
        if time.monotonic() >= deadline or wait(POLL_S):
            break
    compared = sum(len(one.pairs) for one in found.values())
    if compared < LEAST_WINDOWS:
        raise Diverged(name, "compared windows", compared, f"at least {LEAST_WINDOWS}")
    wrong = worst(found, limits, newest=1 << 30)
    if wrong is not None:
        stream, broken = wrong
        raise Diverged(name, f"{broken.field} on stream {stream}", broken.value, broken.bound)
    return found
