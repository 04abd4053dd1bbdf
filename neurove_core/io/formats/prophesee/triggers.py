"""Edges on the trigger inputs in Prophesee words. A separate pass keeps the decoders in `evt` fast."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.io.formats.prophesee.evt import (
    EVT2_BACK_US,
    EVT3_BACK_US,
    TIME_HIGH,
    TIME_LOW,
    not_before,
    signed,
    step_of,
    unwrapped,
)

Columns = tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.uint8]]
"""Time [us], channel and level (1 rising, 0 falling) of trigger edges, each (N,): the fields of `io.Triggers`."""

_TRIGGER = 0xA


class TriggerState(NamedTuple):
    """State of the search for triggers between words. The default is for the start of a recording."""

    timed: int = 0  # 1 after the first TIME_HIGH; before it triggers have no time and are ignored
    high: int = 0  # TIME_HIGH, unwrapped [4096 us in EVT3, 64 us in EVT2]
    low: int = 0  # TIME_LOW [us], only EVT3
    last_us: int = 0  # time of the last trigger [us]


def evt3_triggers(words: NDArray[np.uint16], state: TriggerState) -> tuple[TriggerState, Columns]:
    """Edges on the trigger inputs in EVT3 words. Times are unwrapped, as in `evt3_decode`.

    Source: docs.prophesee.ai, EVT 3.0 format, EXT_TRIGGER: channel in bits 8 to 11, level in bit 0.

    Args:
        words: (N,) words from the camera. Others than those of time and of triggers are skipped.
        state: state after the words before these.

    Returns:
        The state after the words, and the triggers.
    """
    return _triggers(words, state, 12)


def evt2_triggers(words: NDArray[np.uint32], state: TriggerState) -> tuple[TriggerState, Columns]:
    """Edges on the trigger inputs in EVT2 words; see `evt3_triggers`.

    Source: docs.prophesee.ai, EVT 2.0 format, EXT_TRIGGER: time in bits 22 to 27, channel in 8 to 12, level in bit 0.
    """
    return _triggers(words, state, 28)


def _triggers(words: NDArray[Any], state: TriggerState, shift: int) -> tuple[TriggerState, Columns]:
    n_max = np.count_nonzero(words >> shift == _TRIGGER)
    out = np.empty(n_max, np.int64), np.empty(n_max, np.uint8), np.empty(n_max, np.uint8)
    state, n = (_evt3_triggers if shift == 12 else _evt2_triggers)(words, state, out)
    return state, (out[0][:n], out[1][:n], out[2][:n])


@compiled
def _evt3_triggers(
    words: NDArray[Any], state: TriggerState, out: Columns
) -> tuple[TriggerState, int]:  # pragma: no cover (machine code)
    timed, high, low, last_us = state
    n = 0
    for i in range(words.size):
        word = signed(words[i])
        kind, value = word >> 12, word & 0xFFF
        if kind == TIME_LOW:
            low = value
        elif kind == TIME_HIGH:
            if not timed:
                timed, high, low, last_us = 1, value, 0, value << 12
            elif value != high & 0xFFF:
                high, low = unwrapped(high, value, 1 << 12), 0
        elif kind == _TRIGGER and timed:
            last_us = not_before(last_us, (high << 12) + low, EVT3_BACK_US)
            out[0][n], out[1][n], out[2][n] = last_us, value >> 8, value & 1
            n += 1
    return TriggerState(timed, high, low, last_us), n


@compiled
def _evt2_triggers(
    words: NDArray[Any], state: TriggerState, out: Columns
) -> tuple[TriggerState, int]:  # pragma: no cover (machine code)
    timed, high, low, last_us = state
    n = 0
    for i in range(words.size):
        word = signed(words[i])
        kind = word >> 28
        if kind == TIME_HIGH:
            value = word & 0xFFF_FFFF
            high = unwrapped(high, value, 1 << 28) if timed else value
            if not timed:
                timed, last_us = 1, high << 6
        elif kind == _TRIGGER and timed:
            last_us = not_before(last_us, (high << 6) + ((word >> 22) & 0x3F), EVT2_BACK_US)
            out[0][n], out[1][n], out[2][n] = last_us, (word >> 8) & 0x1F, word & 1
            n += 1
    return TriggerState(timed, high, low, last_us), n


def evt3_triggers_reference(words: NDArray[np.uint16], state: TriggerState) -> tuple[TriggerState, Columns]:
    """Reference implementation of `evt3_triggers`."""
    s, rows = state._asdict(), []
    for word in words.tolist():
        kind, value = word >> 12, word & 0xFFF
        if kind == TIME_LOW:
            s["low"] = value
        elif kind == TIME_HIGH:
            _apply_time_high(s, value, 1 << 12, 1 << 12)
        elif kind == _TRIGGER and s["timed"]:
            _apply_time(s, (s["high"] << 12) + s["low"], EVT3_BACK_US)
            rows.append((s["last_us"], value >> 8, value & 1))
    return TriggerState(**s), _columns(rows)


def evt2_triggers_reference(words: NDArray[np.uint32], state: TriggerState) -> tuple[TriggerState, Columns]:
    """Reference implementation of `evt2_triggers`."""
    s, rows = state._asdict(), []
    for word in words.tolist():
        if word >> 28 == TIME_HIGH:
            _apply_time_high(s, word & 0xFFF_FFFF, 1 << 28, 1 << 6)
        elif word >> 28 == _TRIGGER and s["timed"]:
            _apply_time(s, (s["high"] << 6) + (word >> 22 & 0x3F), EVT2_BACK_US)
            rows.append((s["last_us"], word >> 8 & 0x1F, word & 1))
    return TriggerState(**s), _columns(rows)


def _apply_time_high(s: dict[str, int], value: int, period: int, tick_us: int) -> None:
    """Update the state with a TIME_HIGH that wraps after `period` ticks."""
    if not s["timed"]:
        s.update(timed=1, high=value, low=0, last_us=value * tick_us)
        return
    step = step_of(s["high"] % period, value, period)
    s.update(high=s["high"] + step, low=0 if step else s["low"])


def _apply_time(s: dict[str, int], t_us: int, back_us: int) -> None:
    """Update the state with the time of a trigger."""
    s["last_us"] = s["last_us"] if 0 < s["last_us"] - t_us < back_us else t_us


def _columns(rows: list[tuple[int, int, int]]) -> Columns:
    t, channel, level = zip(*rows, strict=True) if rows else ((), (), ())
    return np.array(t, np.int64), np.array(channel, np.uint8), np.array(level, np.uint8)
