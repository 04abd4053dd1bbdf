"""Waiting for a service: clients that start before it, or together with it, wait and say so once."""

import argparse
import math
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Final, TypeVar

from neurove_service.config import ClientConfig

WAIT_S: Final = 30.0
"""Default of `--wait`: the first start of a service compiles its kernels, which takes up to half a minute."""

_RETRY_S: Final = 0.2

T = TypeVar("T")


class Wait:
    """The time that a client waits for a service.

    Args:
        config: where the service is.
        wait_s: longest wait [s]; 0: one attempt.
        stop: ends the wait.
    """

    def __init__(self, config: ClientConfig, wait_s: float, stop: threading.Event | None = None) -> None:
        self._where, self._wait_s = ", ".join(config.connect) or "the endpoints of --zenoh-config", wait_s
        self._stop = stop or threading.Event()
        self._deadline = time.monotonic() + wait_s
        self._said = False

    @property
    def left_s(self) -> float:
        """What is left of the wait [s]."""
        return max(0.0, self._deadline - time.monotonic())

    def say(self) -> None:
        """Print what the client waits for, the first time."""
        if not self._said:
            self._said = True
            about = f"waiting up to {self._wait_s:g} s (--wait) for a service at {self._where}"
            print(f"neurove: {about}", file=sys.stderr, flush=True)

    def until(self, attempt: Callable[[], T]) -> T:
        """The result of an attempt, repeated while no service answers.

        Raises:
            NoService: none answered within the wait, or until the stop event.
        """
        from neurove_service.clients import ask

        while True:
            try:
                return attempt()
            except ask.NoService:
                if not self.left_s or self._stop.is_set():
                    raise
                self.say()
                self._stop.wait(min(_RETRY_S, self.left_s))

    def connect(self, config: ClientConfig) -> Any:
        """A session with a service or a router.

        Raises:
            NoService: nothing listened there within the wait.
        """
        from neurove_service.clients import ask

        return self.until(lambda: ask.connect(config, stop=self._stop))


def add_wait(parser: argparse.ArgumentParser) -> None:
    """Add how long to wait for a service."""
    about = f"longest wait for a service; 0: none; default {WAIT_S:g}"
    parser.add_argument("--wait", type=wait_seconds, default=WAIT_S, metavar="S", help=about)


def wait_seconds(text: str) -> float:
    """A number of seconds, 0 or more."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: give seconds, 0 or more")
    return value
