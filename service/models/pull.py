"""Pulling a bundle in chunks: the node asks, so it goes at the node's pace and on from where it was cut."""

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
"""Digest and what piece of it, to that piece; None where nobody answers. May raise NeuroVEError."""

PATIENCE_S = 15.0
"""A push without a chunk for so long was cut."""

_RETRY_S = 0.25
_TELL_S = 0.5
LEAST_BYTES = 4 << 10
LONG_S = 0.001
QUICK_ONES = 8


class ChunkLength:
    """How long the next chunk is to be: others' events wait on the link while it passes.

    It is halved where one took longer than the quickest did by over LONG_S, or by half where the link takes its time
    for anything, and doubled after QUICK_ONES in a row that took about as long as the quickest.
    """

    def __init__(self) -> None:
        self.bytes = LEAST_BYTES
        self._quickest_s, self._quick = math.inf, 0

    def took(self, seconds: float) -> None:
        """Learn how long the last one took [s]."""
        self._quickest_s = min(self._quickest_s, seconds)
        more_s, long_s = seconds - self._quickest_s, max(LONG_S, self._quickest_s / 2)
        self._quick = self._quick + 1 if more_s < long_s / 2 else 0
        if more_s > long_s:
            self.bytes = max(self.bytes // 2, LEAST_BYTES)
        elif self._quick >= QUICK_ONES:
            self.bytes, self._quick = min(self.bytes * 2, MAX_CHUNK_BYTES), 0


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
        path: the file, which may hold the beginning already.
        wanted: digest and size.
        pull: asks for a chunk.
        stop: ends the waiting for chunks.
        on_progress: hears how far it is, about twice a second.
        patience_s: without a chunk for so long it was cut.

    Returns:
        bytes that were moved.

    Raises:
        Cut: no chunk came for that long. OSError: the disk is full, or can not be written to.
    """
    with path.open("ab") as file:
        if file.tell() > wanted.size:
            file.truncate(0)  # of a push that lied about the size
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
    heard = told = time.monotonic()
    on_progress(Progress("fetching", _so_far(have, wanted.size)))
    while have < wanted.size:
        began = time.monotonic()
        request = ChunkRequest(offset=have, length=min(length.bytes, wanted.size - have))
        chunk, why = _chunk(wanted.digest, request, pull)
        now = time.monotonic()
        if chunk is None:
            if now - heard > patience_s or stop.wait(_RETRY_S):
                raise TransferInterrupted(wanted.name, have, wanted.size, "this node stops" if stop.is_set() else why)
            continue
        file.write(chunk)
        file.flush()  # to where a killed process leaves it
        have += len(chunk)
        length.took(now - began)
        heard = now
        if now - told > _TELL_S:
            told = now
            on_progress(Progress("fetching", _so_far(have, wanted.size)))


def _chunk(digest: str, request: ChunkRequest, pull: Pull) -> tuple[bytes | None, str]:
    """The chunk; or none, and why."""
    try:
        data = pull(digest, request)
    except NeuroVEError as error:
        return None, error.message
    if data is None:
        return None, "whoever pushed it does not answer"
    if len(data) != request.length:
        return None, f"a chunk of {len(data)} bytes came, asked for were {request.length}"
    return data, ""


def _so_far(have: int, size: int) -> str:
    return f"{have / (1 << 20):.1f} of {size / (1 << 20):.1f} MiB"
