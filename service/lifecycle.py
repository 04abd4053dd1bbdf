"""End of the process and messages to its supervisor: signals, death of the parent, notify socket of systemd."""

import contextlib
import os
import signal
import socket
import threading

_PARENT_CHECK_S = 0.5


def stop_on_signals(*, with_parent: bool = False) -> threading.Event:
    """An event that SIGINT and SIGTERM set; with `with_parent` also the death of the parent process.

    Call it on the main thread.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if with_parent:
        parent = os.getppid()

        def watch() -> None:
            while not stop.wait(_PARENT_CHECK_S):
                if os.getppid() != parent:
                    stop.set()

        threading.Thread(target=watch, name="parent watch", daemon=True).start()
    return stop


def notify(state: str) -> None:
    """Send a state to systemd, if it set NOTIFY_SOCKET: `READY=1`, `WATCHDOG=1`, `STOPPING=1`, `STATUS=...`."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    address = "\0" + address[1:] if address.startswith("@") else address
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        supervisor.sendto(state.encode(), address)
