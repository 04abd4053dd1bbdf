"""Pull a bundle in chunks: the node requests each chunk, so it sets the pace and can resume an interrupted push."""

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from neurove_protocol.control import MAX_CHUNK_BYTES, ChunkRequest, PushRequest
from neurove_protocol.errors import NeuroVEError, TransferInterrupted
from neurove_service.models.progress import OnProgress, Progress

Pull = Callable[[str, ChunkRequest], bytes | None]
"""Requests a piece of the bundle with a digest; returns None if no client answers. May raise NeuroVEError."""

PATIENCE_S = 15.0
"""A push without a chunk for this time is interrupted [s]."""

_RETRY_S = 0.25
_REPORT_S = 0.5
MIN_CHUNK_BYTES = 4 << 10
SLOWER_S = 0.001
FAST_CHUNKS = 8


class ChunkLength:
    """Length of the next chunk. Events of other streams wait on the link while a chunk passes.

    The length is halved after a chunk that took longer than the fastest one by more than SLOWER_S, or by more than half
    on a link with a long delay. It is doubled after FAST_CHUNKS chunks in a row that took about as long as the fastest.
    """

    def __init__(self) -> None:
        self.bytes = MIN_CHUNK_BYTES
        self._fastest_s, self._fast = math.inf, 0

    def took(self, seconds: float) -> None:
        """Adapt the length to the time that a chunk took [s]."""
        self._fastest_s = min(self._fastest_s, seconds)
        more_s, long_s = seconds - self._fastest_s, max(SLOWER_S, self._fastest_s / 2)
        self._fast = self._fast + 1 if more_s < long_s / 2 else 0
        if more_s > long_s:
            self.bytes = max(self.bytes // 2, MIN_CHUNK_BYTES)
        elif self._fast >= FAST_CHUNKS:
            self.bytes, self._fast = min(self.bytes * 2, MAX_CHUNK_BYTES), 0


def pull_into(
    path: Path,
    wanted: PushRequest,
    pull: Pull,
    stop: threading.Event,
    on_progress: OnProgress,
    patience_s: float = PATIENCE_S,
) -> int:
    """Append to a file until it has the size of the bundle.

    Args:
        path: the file, which may contain the beginning of the bundle.
        wanted: digest and size.
        pull: requests a chunk.
        stop: ends the wait for chunks.
        on_progress: called about twice a second.
        patience_s: a push without a chunk for this time is interrupted [s].

    Returns:
        number of bytes that were transferred.

    Raises:
        TransferInterrupted: no chunk arrived for that time.
        OSError: the disk is full or not writable.
    """
    with path.open("ab") as file:
        if file.tell() > wanted.size:
            file.truncate(0)  # left by a push with a wrong size
        begin = file.tell()
        _pull_rest(file, wanted, pull, stop, on_progress, patience_s)
        return wanted.size - begin


def _pull_rest(
    file: BinaryIO,
    wanted: PushRequest,
    pull: Pull,
    stop: threading.Event,
    on_progress: OnProgress,
    patience_s: float,
) -> None:
    have, length = file.seek(0, 2), ChunkLength()
    heard = reported = time.monotonic()
    on_progress(Progress("fetching", _so_far(have, wanted.size)))
    while have < wanted.size:
        began = time.monotonic()
        request = ChunkRequest(offset=have, length=min(length.bytes, wanted.size - have))
        chunk, why = _chunk(wanted.digest, request, pull)
        now = time.monotonic()
        if chunk is None:
            if now - heard > patience_s or stop.wait(_RETRY_S):
                raise TransferInterrupted(
                    wanted.name, have, wanted.size, "this node is stopping" if stop.is_set() else why
                )
            continue
        file.write(chunk)
        file.flush()  # so that the bytes survive a killed process
        have += len(chunk)
        length.took(now - began)
        heard = now
        if now - reported > _REPORT_S:
            reported = now
            on_progress(Progress("fetching", _so_far(have, wanted.size)))


def _chunk(digest: str, request: ChunkRequest, pull: Pull) -> tuple[bytes | None, str]:
    """The chunk; or None and the reason."""
    try:
        data = pull(digest, request)
    except NeuroVEError as error:
        return None, error.message
    if data is None:
        return None, "the client that pushed it does not answer"
    if len(data) != request.length:
        return None, f"a chunk has {len(data)} bytes instead of {request.length}"
    return data, ""


def _so_far(have: int, size: int) -> str:
    return f"{have / (1 << 20):.1f} of {size / (1 << 20):.1f} MiB"
