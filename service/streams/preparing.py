"""Preparing: the look-up table of a large sensor with a lens takes seconds, so it is built away from the packets."""

import threading
from collections.abc import Callable
from typing import Final, NamedTuple

from neurove_protocol import CameraInfo
from neurove_protocol.errors import InternalError, NeuroVEError
from neurove_service.guard import Guard

QUICK_PX: Final = 1 << 20
"""A sensor with at most so many pixels is no large one: its table takes a fraction of a second."""

ONE_AT_A_TIME: Final = threading.Lock()
"""Held while a table of this process is built: the other processors are for packets."""


class Prepared(NamedTuple):
    """A CameraInfo whose table is there, or the reason why not."""

    camera: CameraInfo
    error: NeuroVEError | None


class Preparing:
    """Builds the tables of one stream on a thread, one at once; a newer CameraInfo replaces one that waits.

    Args:
        build: returns the table of a camera.
        done: called on the thread when a result can be taken.
        guard: counts internal errors.
    """

    def __init__(self, build: Callable[[CameraInfo], object], done: Callable[[], None], guard: Guard) -> None:
        self._build, self._done, self._guard = build, done, guard
        self._wanted: CameraInfo | None = None
        self._running = False
        self._prepared: Prepared | None = None
        self._table: object = None  # the newest one, so that it lives until its stream uses it
        self._lock = threading.Lock()

    def start(self, camera: CameraInfo) -> None:
        """Prepare this camera; return at once."""
        with self._lock:
            self._wanted = camera
            if not self._running:
                threading.Thread(target=self._run, name=f"table {camera.stream}", daemon=True).start()
                self._running = (
                    True  # the thread waits for the lock; if the system gives no thread, the next call tries
                )

    def stop(self) -> None:
        """Start no further table, and let go of the present one."""
        with self._lock:
            self._wanted = self._table = self._prepared = None

    def take(self) -> Prepared | None:
        """The newest result, once."""
        with self._lock:
            prepared, self._prepared = self._prepared, None
            return prepared

    def _run(self) -> None:
        while True:
            with ONE_AT_A_TIME:
                with self._lock:
                    camera, self._wanted = self._wanted, None
                    if camera is None:
                        self._running = False
                        return
                table: object = None
                error: NeuroVEError | None = InternalError()
                with self._guard.at("look-up table", stream=camera.stream):
                    try:
                        table, error = self._build(camera), None
                    except NeuroVEError as refused:
                        error = refused
                with self._lock:
                    self._table, self._prepared = table, Prepared(camera, error)
            with self._guard.at("look-up table", stream=camera.stream):
                self._done()
