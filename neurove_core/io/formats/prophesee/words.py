"""The word formats of Prophesee cameras: EVT2, EVT2.1, EVT3 and EVT4."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.formats.prophesee import evt, triggers, vectors
from neurove_protocol.events import Events

Decode = Callable[[NDArray[Any], Any, Events, NDArray[np.int64]], tuple[Any, int, int]]
FindTriggers = Callable[[NDArray[Any], Any], tuple[Any, triggers.Columns]]


class Words(NamedTuple):
    """A word format: its word type and its decoders."""

    dtype: np.dtype[Any]
    decode: Decode
    start: Any  # state of `decode` before the first word
    triggers: FindTriggers
    first: Any  # state of `triggers` before the first word
    period_us: int  # of the camera's clock
    events: int  # largest number of events that one word completes


FORMATS: Final = {
    "EVT2": Words(
        np.dtype("<u4"), evt.evt2_decode, evt.Evt2State(), triggers.evt2_triggers, triggers.TriggerState(), 1 << 34, 1
    ),
    "EVT21": Words(
        np.dtype("<u8"),
        vectors.evt21_decode,
        evt.Evt2State(),
        vectors.evt21_triggers,
        triggers.TriggerState(),
        1 << 34,
        vectors.VECTOR_EVENTS,
    ),
    "EVT3": Words(
        np.dtype("<u2"),
        evt.evt3_decode,
        evt.Evt3State(),
        triggers.evt3_triggers,
        triggers.TriggerState(),
        1 << 24,
        evt.VECTOR_EVENTS,
    ),
    "EVT4": Words(
        np.dtype("<u4"),
        vectors.evt4_decode,
        vectors.Evt4State(),
        vectors.evt4_triggers,
        vectors.Evt4TriggerState(),
        1 << 34,
        vectors.VECTOR_EVENTS,
    ),
}
"""Word formats by their name in the header of a RAW file."""

ENDIANNESS: Final = ("little", "big", "legacy")
"""Orders of the bytes of a word. `legacy` is that of EVT2.1 of an IMX636: two little-endian halves, the upper first."""


def words_in(data: bytes | memoryview, words: Words, endianness: str) -> NDArray[Any]:
    """The complete words in these bytes, in the byte order of the machine."""
    found = np.frombuffer(data, words.dtype, len(data) // words.dtype.itemsize)
    if endianness == "big":
        return found.byteswap()
    return vectors.swapped(found) if endianness == "legacy" else found


def endianness_of(name: str, data: bytes | memoryview) -> str | None:
    """The order of the bytes of these words where nothing says it: `little`, but EVT2.1 shows it by its words.

    Returns:
        `little` or `legacy`; None if these words do not show it.
    """
    if name != "EVT21":
        return "little"
    legacy = vectors.is_legacy(words_in(data, FORMATS[name], "little"))
    return None if legacy is None else "legacy" if legacy else "little"
