"""Estimates as lines of text or JSON, and the notices that belong to them: legend, missing lens, silence."""

import json
import time
from collections.abc import Callable, Iterator
from typing import Final

from neurove_protocol import TwistEstimate
from neurove_service.cli.board import Received, legend, notes, since

_LEAST_SILENCE_S: Final = 1.0  # a notice for each shorter pause of a busy machine would hide the estimates


def as_json(estimate: TwistEstimate) -> str:
    """The message as JSON, with the newest twist and its sigma by axis; sigma is null without a covariance."""
    sigma = estimate.sigma
    newest = {"twist": estimate.twist._asdict(), "sigma": None if sigma is None else sigma._asdict()}
    return json.dumps(estimate.model_dump(mode="json") | newest)


def as_text(estimate: TwistEstimate) -> str:
    """Stream, end of the window, newest twist with its sigma [m/s, rad/s], model and flags."""
    sigmas = estimate.sigma or (None,) * 6
    spreads = ("" if sigma is None else f"±{sigma:.3f}" for sigma in sigmas)
    numbers = " ".join(
        f"{name}={value:+.3f}{spread}"
        for (name, value), spread in zip(estimate.twist._asdict().items(), spreads, strict=True)
    )
    return (
        f"{estimate.stream} {estimate.end_us / 1e6:.3f} s {numbers} model={estimate.model} [{' '.join(estimate.flags)}]"
    )


def of_stream(name: str, received: Received, *, json_wanted: bool) -> str:
    """A line about a stream that has an estimate or, if it has none, its verdict."""
    if received.last is not None:
        return as_json(received.last) if json_wanted else as_text(received.last)
    status = received.status
    verdict, why = (status.verdict, status.why) if status is not None else ("idle", "no estimate")
    if json_wanted:
        return json.dumps({"stream": name, "twist": None, "sigma": None, "verdict": verdict, "why": why})
    return f"{name} no estimate: {verdict}: {why}"


class Notices:
    """What a reader of the lines should know, each once.

    Args:
        clock: monotonic clock [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._streams: dict[str, Received] = {}
        self._silent: set[str] = set()

    def arrived(self, estimate: TwistEstimate) -> Iterator[str]:
        """The legend before the first estimate, advice for each new stream, and the end of a silence."""
        first, name = not self._streams, estimate.stream
        received = self._streams.setdefault(name, Received())
        known = received.last
        received.last, received.last_at, received.last_wall = estimate, self._clock(), time.time()
        if first:
            yield legend(self._streams)
        if known is None or known.flags != estimate.flags:
            before = set(notes(name, Received(last=known))) if known else set()
            yield from (note for note in notes(name, received) if note not in before)
        if name in self._silent:
            self._silent.discard(name)
            yield f"{name}: estimates again"

    def silent(self) -> Iterator[str]:
        """Each stream that has become silent: nothing came for two windows, and at least a second."""
        now = self._clock()
        for name, received in self._streams.items():
            silent_s = received.silent_s(now)
            if silent_s is not None and silent_s > _LEAST_SILENCE_S and name not in self._silent:
                self._silent.add(name)
                yield f"{name}: {since(received, silent_s)}"
