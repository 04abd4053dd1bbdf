"""Time scales: the same network on longer windows, for motion too slow to see in one.

Events depend on changes of brightness, not on the time that these take. A stream in windows that are s times as long is
therefore that of a camera that is s times as fast. The network runs again on the newest s windows, summed to n bins s
times as long, and its twist is divided by s. This happens in every window, with s states in turn, each of which sees
long windows that follow each other. The search begins at the shortest scale: while an estimate, sped up to the next
scale, stays within `scale_bounds`, the next scale answers instead. A fast motion thus never reaches a scale at which it
aliases.

The noise of a stationary camera adds up in a long window, where it looks like motion. In one window the network tells
both apart. A camera in a hand turns without much speed, and its rates change within a long window. So a long window
answers only if the network sees a linear speed of `scale_floor` in each window that is part of it.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.config import ModelConfig
from neurove_core.ingest.channels import Counts, Recent, add_saturating, with_history
from neurove_core.networks.arrays import Begins, Runner, State

STEPS: Final = 3
"""Long windows that a state must have seen before its scale answers."""


class Longer(NamedTuple):
    """What a stream carries for its longer windows."""

    windows: int = 0  # since it began
    recent: tuple[Counts, ...] = ()  # the newest windows before the next one, the newest first
    states: tuple[
        tuple[State, ...], ...
    ] = ()  # of each scale, one for each of its turns; empty before the first window
    moving: int = 0  # newest windows in a row in which the network sees a linear speed


class Answer(NamedTuple):
    """Twists and next state of a network for one window."""

    twists: NDArray[np.float64]  # (n, 6), in the model's linear unit and rad/s
    network: State
    scale: int = 1  # windows that it is from


class Turn(NamedTuple):
    """The newest window of one stream, and what the network needs to answer it."""

    window: Counts  # (2n * parts, H, W)
    recent: Recent
    network: State
    longer: Longer


class Answered(NamedTuple):
    """The answer to the newest window of one stream, and what the stream carries to its next window."""

    answer: Answer
    network: State
    longer: Longer


def answered(
    turns: Sequence[Turn],
    runner: Runner,
    config: ModelConfig,
    offset: NDArray[np.float64],
    scale: NDArray[np.float64],
) -> list[Answered]:
    """Answer the newest window of each of B streams: one batch for these windows, a second one for the longer windows.

    Args:
        turns: one for each stream.
        runner: of the network.
        config: of the model.
        offset: (6) of the bundle; twists are `twists * scale + offset`.
        scale: (6) of the bundle.
    """
    counts = [with_history(turn.window, turn.recent, config) for turn in turns]
    steps = runner.run(counts, [turn.network for turn in turns])
    first = [Answer(twists * scale + offset, network) for twists, network in steps]
    if not config.scales:
        return [Answered(one, one.network, turn.longer) for one, turn in zip(first, turns, strict=True)]
    asked = [jobs(turn.window, turn.longer, runner, config) for turn in turns]
    every = [job for wanted, _ in asked for job in wanted]
    runs = iter(runner.run([job.counts for job in every], [job.state for job in every]) if every else [])
    found = []
    for one, (wanted, begun) in zip(first, asked, strict=True):
        done = [(job, *next(runs)) for job in wanted]
        longer = followed(begun, [(job, state) for job, _, state in done], config)
        longer = watched(longer, one.twists, config)
        more = [Answer(slowed(twists * scale + offset, job.scale), state, job.scale) for job, twists, state in done]
        found.append(Answered(chosen([one, *more], longer, config.scale_bounds), one.network, longer))
    return found


class Job(NamedTuple):
    """One run of the network."""

    counts: Counts
    state: State
    scale: int
    turn: int  # which state of its scale


def jobs(window: Counts, longer: Longer, network: Begins, config: ModelConfig) -> tuple[list[Job], Longer]:
    """The runs that a new window of a stream asks for, and the stream's state with that window.

    Args:
        window: (2n * parts, H, W), the newest.
        longer: state of the stream.
        network: of the model, or its runner.
        config: of the model.
    """
    scales = config.scales
    states = longer.states or tuple(tuple(network.initial_state() for _ in range(scale)) for scale in scales)
    seen = (window, *longer.recent)
    wanted = [
        Job(merged(seen[:scale], config), states[at][longer.windows % scale], scale, longer.windows % scale)
        for at, scale in enumerate(scales)
        if len(seen) >= scale
    ]
    return wanted, Longer(longer.windows + 1, seen[: max(scales) - 1], states, longer.moving)


def merged(newest: Sequence[Counts], config: ModelConfig) -> Counts:
    """The counts of consecutive windows as those of one window that lasts as long as all of them.

    Args:
        newest: s windows (2n * parts, H, W), the newest first.
        config: of the model.

    Returns:
        (2n * parts, H, W), saturating at 255.
    """
    bins, scale = config.window.bins, len(newest)
    found = np.zeros(config.window_shape, np.uint8)
    into = found.reshape(bins, -1)
    for number, window in enumerate(reversed(newest)):
        for at, one in enumerate(window.reshape(bins, -1)):
            add_saturating(into[(number * bins + at) // scale], one)
    return found


def followed(longer: Longer, done: Sequence[tuple[Job, State]], config: ModelConfig) -> Longer:
    """The state of a stream after its jobs."""
    states = [list(turns) for turns in longer.states]
    for job, state in done:
        states[config.scales.index(job.scale)][job.turn] = state
    return longer._replace(states=tuple(tuple(turns) for turns in states))


def slowed(twists: NDArray[np.float64], scale: int) -> NDArray[np.float64]:
    """Twists (n, 6) of the newest window from those of a long window: the mean of its share of the bins, over scale."""
    bins = len(twists)
    newest = twists[bins - max(1, bins // scale) :].mean(axis=0) / scale
    return np.tile(newest, (bins, 1))


def watched(longer: Longer, twists: NDArray[np.float64], config: ModelConfig) -> Longer:
    """The state of a stream after the answer (n, 6) of the network to its newest window alone."""
    speed = float(np.linalg.norm(twists.mean(axis=0)[:3]))
    return longer._replace(moving=longer.moving + 1 if speed > config.scale_floor else 0)


def chosen(answers: Sequence[Answer], longer: Longer, bounds: tuple[float, float]) -> Answer:
    """The answer of the longest scale that the motion allows.

    Args:
        answers: by scale, the shortest first.
        longer: state of the stream with its newest window.
        bounds: greatest linear and angular speed of a sped-up estimate.
    """
    best = answers[0]
    for answer in answers[1:]:
        mean = best.twists.mean(axis=0) * answer.scale
        within = all(np.linalg.norm(part) <= bound for part, bound in zip((mean[:3], mean[3:]), bounds, strict=True))
        known = longer.windows >= STEPS * answer.scale and longer.moving >= answer.scale
        if not known or not within:
            break
        best = answer
    return best
