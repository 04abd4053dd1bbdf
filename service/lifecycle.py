"""End of the process and messages to its supervisor: signals, death of the parent, notify socket of systemd."""

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable
from types import FrameType
from typing import Final

_PARENT_CHECK_S = 0.5
_ORPHAN_S: Final = 10.0  # for a clean end
_ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_AGAIN_S = 0.001
_OF_TUPLES: Final = ("namedtuple_", "numba.core.serialize")
"""Modules of the functions that numba calls to make a named tuple: its own, and the one that finds its class."""


class Terminated(KeyboardInterrupt):
    """A signal ends the command, which cleans up as after Ctrl-C."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(signal.Signals(number).name)


def interrupt_on_signals() -> None:
    """Let SIGTERM and SIGHUP end a command as Ctrl-C does, so that each `finally` runs.

    A second one is ignored, because the cleanup is under way; a second Ctrl-C is not. SIGHUP stays ignored where it
    was, as under nohup. Does nothing outside the main thread, which alone can set handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        return

    def end(number: int, frame: FrameType | None) -> None:
        if _makes_tuple(frame):
            signal.signal(signal.SIGALRM, lambda _, later: end(number, later))
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
            return
        for one in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(one, signal.SIG_IGN)
        raise Terminated(number)

    for one in _ENDING:
        if signal.getsignal(one) is not signal.SIG_IGN:
            signal.signal(one, end)


def _makes_tuple(frame: FrameType | None) -> bool:
    """Whether a named tuple is being made, as at the end of a compiled function that returns one.

    There numba calls Python and does not expect an exception: one ends the process with a segmentation fault. It is the
    first Python code after a long compiled loop, so most signals meet it.
    """
    while frame is not None:
        if str(frame.f_globals.get("__name__")).startswith(_OF_TUPLES):
            return True
        frame = frame.f_back
    return False


def stop_on_signals(*, with_parent: bool = False, on_hangup: Callable[[], object] | None = None) -> threading.Event:
    """An event that SIGINT, SIGTERM and SIGHUP set; with `with_parent` also the death of the parent process.

    Call it on the main thread.

    Args:
        with_parent: set the event also when the parent process ends.
        on_hangup: what SIGHUP does instead, on a thread of its own; several calls do not overlap.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if on_hangup is not None:
        _call_on_hangup(on_hangup)
    elif signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: stop.set())
    if with_parent:
        parent = os.getppid()

        def watch() -> None:
            while not stop.wait(_PARENT_CHECK_S):
                if os.getppid() != parent:
                    stop.set()

        threading.Thread(target=watch, name="parent watch", daemon=True).start()
    return stop


def end_with_parent() -> None:
    """End this process when its parent ends, as SIGTERM does, and after 10 s without a clean end at once.

    A process may be deep in a library then, where no handler of Python runs.
    """
    parent = os.getppid()

    def watch() -> None:
        never = threading.Event()
        while os.getppid() == parent:
            never.wait(_PARENT_CHECK_S)
        os.kill(os.getpid(), signal.SIGTERM)
        never.wait(_ORPHAN_S)
        os._exit(128 + signal.SIGTERM)

    threading.Thread(target=watch, name="parent watch", daemon=True).start()


def _call_on_hangup(on_hangup: Callable[[], object]) -> None:
    one_at_once = threading.Lock()

    def call() -> None:
        with one_at_once:
            on_hangup()

    # a handler interrupts any line of the main thread, such as one that holds a lock of the log
    signal.signal(signal.SIGHUP, lambda *_: threading.Thread(target=call, name="hangup", daemon=True).start())


def notify(state: str) -> None:
    """Send a state to systemd, if it set NOTIFY_SOCKET: `READY=1`, `WATCHDOG=1`, `STOPPING=1`, `STATUS=...`."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    address = "\0" + address[1:] if address.startswith("@") else address
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        supervisor.sendto(state.encode(), address)
