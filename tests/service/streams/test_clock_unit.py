"""A driver whose clock does not count microseconds is told so, in the verdict of its stream."""

import pytest

from neurove_protocol import Events
from neurove_protocol.events import EventPacket
from neurove_service.streams.clock_unit import ClockUnit
from neurove_service.streams.intake import Arrival
from neurove_service.streams.stream import Stream
from tests.builders import SENSOR

PACKET_NS = 10_000_000


def run_of(slot, per_us, seconds=5.0, jumps_us=0):
    """A stream after packets every 10 ms, whose clock counts `per_us` units in a microsecond."""
    now = {"ns": 10**9}
    stream = Stream("cam0", slot, lambda: now["ns"])
    for seq in range(int(seconds * 1e9 / PACKET_NS)):
        now["ns"] += PACKET_NS
        t0 = int(seq * (PACKET_NS / 1000) * per_us) + (jumps_us if seq > 100 else 0)
        packet = EventPacket("cam0", seq, SENSOR, t0, Events.empty())
        stream.accept(packet, Arrival(now["ns"], now["ns"]))
    return stream.verdicts.at(now["ns"])


@pytest.mark.parametrize(("per_us", "unit"), [(1000, "nanoseconds"), (0.001, "milliseconds")])
def test_a_clock_in_another_unit_is_named_in_the_verdict(slot, per_us, unit):
    judged = run_of(slot, per_us)
    assert judged.verdict != "ok"
    assert f"count microseconds, and the driver seems to send {unit}" in judged.why


@pytest.mark.parametrize("per_us", [0.2, 1.0, 8.0])
def test_a_clock_in_microseconds_is_not_doubted_at_other_speeds(slot, per_us):
    assert "microseconds" not in run_of(slot, per_us).why


def test_a_clock_that_jumps_once_is_no_unit(slot):
    assert "microseconds" not in run_of(slot, 1.0, jumps_us=1_000_000_000).why


def test_the_hint_ends_when_the_driver_is_corrected():
    unit = ClockUnit()
    for second in range(5):
        unit.learn(second * 10**9, second * 10**9)
    assert "nanoseconds" in unit.hint
    unit.learn(4 * 10**9 + 10**6, 5 * 10**9)
    assert unit.hint == ""
