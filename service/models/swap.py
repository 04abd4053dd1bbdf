"""The steps of a model change that involve streams: priming, the shadow comparison, and the figures of a trial."""

import time
from collections.abc import Callable, Iterable

from neurove_protocol.errors import Diverged
from neurove_service.streams.comparison import MIN_WINDOWS, TrialFigures, TrialLimits, Violation, violation
from neurove_service.streams.history import Primed
from neurove_service.streams.lane import windows_to_prime
from neurove_service.streams.model_source import StreamView
from neurove_service.streams.roles import Serving

POLL_S = 0.05
"""How often streams are polled."""

PROBATION_WINDOWS = 16
"""Number of newest windows that are evaluated on probation, so that a fault shows within a second."""

_MAX_PAUSE_S = 0.02
_ROUNDS = 3
_MAX_BEHIND = 1  # windows that may wait at the switch
_MAX_SETTLING_S = 30.0


def _pause(took_s: float) -> None:
    """Leave the processor to the streams for as long as a window took: priming uses at most half of one core."""
    time.sleep(min(took_s, _MAX_PAUSE_S))


def prime(
    serving: Serving, streams: Callable[[], list[StreamView]], max_wait_s: float, wait: Callable[[float], bool]
) -> tuple[int, int]:
    """Bring a model to the state that it would have if it had always served, on each stream that can be replayed.

    If packets arrive on a stream, its worker primes the model in standby, in spare time, and this function waits.
    Otherwise this function replays the stream.

    Args:
        serving: the model; the plan has it in standby on all its streams.
        streams: the streams to prime.
        max_wait_s: maximum wait for windows that the bundle needs beyond those that are kept [s].
        wait: sleeps; returns True to give up.

    Returns:
        number of streams that are primed, and of those that are not: without windows, or with other windows.

    Raises:
        Diverged: the model failed on a window.
    """
    began, deadline = time.monotonic(), time.monotonic() + max_wait_s + _MAX_SETTLING_S
    while time.monotonic() < deadline:
        late = time.monotonic() - began > max_wait_s
        if all(_is_primed(serving, stream, late=late) for stream in streams() if _worker_primes(serving, stream)):
            break
        if wait(POLL_S):
            break
    done = left = 0
    for stream in streams():
        lane: Primed | None = None
        by_worker = _worker_primes(serving, stream)
        if not by_worker:
            for _ in range(_ROUNDS):  # windows arrive during a replay: each round leaves fewer of them
                lane = stream.lanes.prime(serving, _pause, lane)
            stream.lanes.history.offer(lane)
        primed = by_worker or lane is not None
        done, left = done + primed, left + (not primed)
    return done, left


def _worker_primes(serving: Serving, stream: StreamView) -> bool:
    lane = stream.lanes.serving_lane
    return stream.flowing and lane is not None and lane.estimator.has_same_windows(serving.estimator)


def _is_primed(serving: Serving, stream: StreamView, *, late: bool) -> bool:
    """Whether a standby model has seen the windows that it needs, or all there are, up to the newest one."""
    lane, standby = stream.lanes.serving_lane, stream.lanes.standby
    if lane is None or standby is None or standby.lane.estimator is not serving.estimator:
        return lane is not None and lane.estimator is serving.estimator
    if standby.fault:
        raise Diverged(serving.estimator.bundle.name, f"fault on stream {stream.name}", standby.fault, "none")
    wanted = min(windows_to_prime(serving.estimator), lane.state.age)
    seen = standby.lane.state.age + _MAX_BEHIND >= wanted
    return standby.stopped or (standby.behind <= _MAX_BEHIND and (late or seen))


def settled(serving: Serving, streams: Iterable[StreamView]) -> bool:
    """Whether a model that could not be replayed has run in standby on every stream until it has settled."""
    wanted = serving.estimator.config.settle_windows + 1
    standbys = [stream.lanes.standby for stream in streams if stream.lanes.serving_lane is not None]
    return all(one is not None and (one.stopped or one.lane.state.age >= wanted) for one in standbys)


def max_settling_s(serving: Serving) -> float:
    """Maximum wait for `settled` [s]: packets may stop."""
    windows = serving.estimator.config.settle_windows + 2
    return min(_MAX_SETTLING_S, 1.0 + 2 * windows * serving.estimator.config.window.duration_us / 1e6)


def figures(serving: Serving, streams: Iterable[StreamView], *, serving_is_tried: bool) -> dict[str, TrialFigures]:
    """The figures of a model's trial, by stream."""
    found = {}
    for stream in streams:
        lanes, comparison = stream.lanes, stream.lanes.comparison
        lane = lanes.serving_lane if serving_is_tried else lanes.standby.lane if lanes.standby else None
        same = lane is not None and lane.estimator is serving.estimator
        if same and comparison is not None and comparison.serving_is_tried == serving_is_tried:
            found[stream.name] = comparison.figures()
    return found


def first_violation(found: dict[str, TrialFigures], limits: TrialLimits, newest: int) -> tuple[str, Violation] | None:
    """The first stream on which a model broke a limit, and the limit."""
    for name, one in found.items():
        wrong = violation(one, limits, newest)
        if wrong is not None:
            return name, wrong
    return None


def compare_in_shadow(
    serving: Serving,
    streams: Callable[[], list[StreamView]],
    seconds: float,
    limits: TrialLimits,
    wait: Callable[[float], bool],
) -> dict[str, TrialFigures]:
    """Compare a standby model with the serving model for some time.

    Args:
        serving: the standby model.
        streams: the streams on which it runs.
        seconds: duration [s].
        limits: the limits of the model.
        wait: sleeps; returns True to give up.

    Raises:
        Diverged: it broke a limit, or too few windows arrived.
    """
    name, deadline = serving.estimator.bundle.name, time.monotonic() + seconds
    while True:
        found = figures(serving, streams(), serving_is_tried=False)
        for stream, one in found.items():
            if one.fault:
                raise Diverged(name, f"fault on stream {stream}", one.fault, "none")
        if time.monotonic() >= deadline or wait(POLL_S):
            break
    compared = sum(len(one.pairs) for one in found.values())
    if compared < MIN_WINDOWS:
        raise Diverged(name, "compared windows", compared, f"at least {MIN_WINDOWS}")
    wrong = first_violation(found, limits, newest=1 << 30)
    if wrong is not None:
        stream, broken = wrong
        raise Diverged(name, f"{broken.field} on stream {stream}", broken.value, broken.bound)
    return found
