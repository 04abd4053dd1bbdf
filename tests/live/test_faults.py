"""The fault matrix: what each fault of a camera or of its driver leaves behind on a real service.

All cameras run at once, each with its own fault from second 2 to second 4, beside a neighbour without a fault. The
tests compare what the service reports with what the drivers sent.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import pytest

from neurove_protocol import EventPacket, Flag, Sensor, TwistEstimate
from neurove_protocol.control import StreamStatus
from neurove_protocol.events import encode_packet
from tests.builders import make_packets
from tests.live.conftest import AT_FULL_SPEED, Source, client, free_endpoint, listen, service, wait_until

pytestmark = pytest.mark.live

PACKET_US, WINDOW_US = 10_000, 50_000
BEGIN_US, END_US, LENGTH_US = 2_000_000, 4_000_000, 6_000_000
N = LENGTH_US // PACKET_US
IN_FAULT = range(BEGIN_US // PACKET_US, END_US // PACKET_US)


class Sent(NamedTuple):
    """One put of a driver."""

    due_s: float
    what: EventPacket | bytes

    def payload(self, stream: str) -> bytes:
        """The bytes on the key of a stream."""
        return self.what if isinstance(self.what, bytes) else encode_packet(replace(self.what, stream=stream))


def good() -> list[EventPacket]:
    return make_packets(N, n=60, step_us=PACKET_US)


def sent(packet: EventPacket, due_us: float | None = None) -> Sent:
    """A packet that leaves at its end, or at another time."""
    due_us = packet.t0_us + PACKET_US if due_us is None else due_us
    return Sent(due_us / 1e6, packet)


def each(change: Callable[[EventPacket], Iterator[Sent]]) -> list[Sent]:
    """The packets of a camera; `change` makes what is sent instead of each packet during the fault."""
    found: list[Sent] = []
    for packet in good():
        found += change(packet) if packet.seq in IN_FAULT else [sent(packet)]
    return found


def in_order(all_sent: list[Sent]) -> list[Sent]:
    """A packet leaves no earlier than the packet before it."""
    found, due_s = [], 0.0
    for one in all_sent:
        due_s = max(due_s, one.due_s)
        found.append(Sent(due_s, one.what))
    return found


def moved(packet: EventPacket, by_us: int) -> EventPacket:
    return replace(packet, t0_us=packet.t0_us + by_us, events=packet.events._replace(t=packet.events.t + by_us))


def _off() -> list[Sent]:
    """The camera sends nothing during the fault, and its driver goes on to count where it was."""
    return [
        sent(replace(packet, seq=packet.seq - len(IN_FAULT) * (packet.t0_us >= END_US)))
        for packet in good()
        if packet.seq not in IN_FAULT
    ]


def _stuck(packet):
    shown = good()[IN_FAULT.start - 1]
    yield sent(replace(moved(shown, packet.t0_us - shown.t0_us), seq=packet.seq))


def _garbage(packet):
    yield Sent((packet.t0_us + PACKET_US) / 1e6, b"\x81garbage" + bytes([packet.seq % 256]))


def _wrong_size(packet):
    yield sent(replace(packet, sensor=Sensor(80, 60)))


def _flapping(packet):
    yield sent(replace(packet, sensor=Sensor(80 + packet.seq % 2, 60)))


def _delayed(packet):
    yield sent(packet, packet.t0_us + PACKET_US + 400_000)


def _stale(packet):
    yield sent(packet, packet.t0_us + PACKET_US + 1_500_000)


def _intermittent(packet):
    if packet.seq % 40 < 20:
        yield sent(packet)


def _duplicates(packet):
    yield sent(packet)
    yield sent(packet)


def _burst_of_repeats(packet):
    yield sent(packet)
    if packet.seq == IN_FAULT.start + 50:
        before = good()
        yield from (sent(before[packet.seq - back], packet.t0_us + PACKET_US) for back in (2, 1, 0))


def _bursts(packet):
    yield sent(packet, (packet.t0_us // 200_000 + 1) * 200_000)


def _reorder(packet):
    partner = good()[packet.seq ^ 1]
    yield sent(partner, packet.t0_us + PACKET_US)


def _huge_numbers(packet):
    yield sent(packet)
    if packet.seq % 10 == 0:
        yield sent(replace(packet, seq=(1 << 63) - 1), packet.t0_us + PACKET_US)


def _second_driver(packet):
    yield sent(packet)
    yield sent(replace(moved(packet, 123), seq=packet.seq + 700_000), packet.t0_us + PACKET_US + 3_000)


def _clock(by_us: int) -> list[Sent]:
    """The clock of the sensor jumps at the begin of the fault and stays there."""
    return [
        sent(moved(packet, by_us), packet.t0_us + PACKET_US) if packet.t0_us >= BEGIN_US else sent(packet)
        for packet in good()
    ]


def _restart() -> list[Sent]:
    """The driver ends at the begin of the fault; a new one begins at its end."""
    return [
        sent(replace(packet, seq=packet.seq - IN_FAULT.stop * (packet.t0_us >= END_US)))
        for packet in good()
        if packet.seq not in IN_FAULT
    ]


CAMERAS: dict[str, list[Sent]] = {
    "neighbour": each(lambda packet: iter([sent(packet)])),
    "off": _off(),
    "stuck": each(_stuck),
    "garbage": each(_garbage),
    "wrong-size": each(_wrong_size),
    "flapping": each(_flapping),
    "delayed": in_order(each(_delayed)),
    "stale": in_order(each(_stale)),
    "intermittent": each(_intermittent),
    "duplicates": each(_duplicates),
    "repeats": each(_burst_of_repeats),
    "bursts": in_order(each(_bursts)),
    "reorder": each(_reorder),
    "huge-numbers": each(_huge_numbers),
    "uncounted": [sent(replace(packet, seq=0)) for packet in good()],
    "two-drivers": each(_second_driver),
    "clock-forward": _clock(60_000_000),
    "clock-back": _clock(-1_500_000),
    "wrap": _clock(-(1 << 32)),
    "restart": _restart(),
}


OLD = ["delayed", "stale"]
ALL = [name for name in CAMERAS if name not in OLD]


class Ran(NamedTuple):
    """What a consumer heard of one stream."""

    status: StreamStatus
    verdicts: set[str]
    reasons: str
    estimates: list[TwistEstimate]

    def flagged(self, flag: Flag) -> list[int]:
        """Numbers of the windows with this flag."""
        return [one.start_us // WINDOW_US for one in self.estimates if flag in one.flags]

    @property
    def lost(self) -> dict[str, int]:
        return self.status.lost.nonzero()


def run(names: list[str], *settings: str) -> dict[str, Ran]:
    """Run cameras side by side against one service."""
    endpoint = free_endpoint()
    told: dict[str, list[StreamStatus]] = {name: [] for name in names}
    estimates: dict[str, list[TwistEstimate]] = {name: [] for name in names}
    always = ("--model", "untrained", "--max-streams", "64", "--queue-s", "60")
    with (
        service(endpoint, *always, *settings, **AT_FULL_SPEED) as (process, _, config),
        client(endpoint) as listener,
        client(endpoint) as driver,
    ):
        listen(
            listener,
            config,
            lambda one: estimates[one.stream].append(one),
            lambda status: told[status.stream].append(status),
        )
        sources = {name: Source(driver, config, name) for name in names}
        puts = [(one.due_s, name, one.payload(name)) for name in names for one in CAMERAS[name]]
        began = time.monotonic()
        for due_s, name, payload in sorted(puts, key=lambda put: put[0]):
            time.sleep(max(0.0, began + due_s - time.monotonic()))
            sources[name].put(payload, live=True)
        wait_until(lambda: all(told[name] and arrived(told[name][-1]) == len(CAMERAS[name]) for name in names), 90)
        assert process.child.poll() is None
    return {
        name: Ran(
            told[name][-1],
            {status.verdict for status in told[name]},
            "; ".join(dict.fromkeys(status.why for status in told[name])),
            estimates[name],
        )
        for name in names
    }


@pytest.fixture(scope="module")
def ran() -> dict[str, Ran]:
    """All cameras whose fault is not one of age: a machine that is too slow for all at once answers them later."""
    return run(ALL, "--max-age-s", "60")


@pytest.fixture(scope="module")
def old() -> dict[str, Ran]:
    return run(OLD)


def arrived(status: StreamStatus) -> int:
    """All packets that the node says it has got."""
    return status.packets_received + status.lost.malformed_packets + status.lost.overload_packets


@pytest.mark.parametrize("name", ALL)
def test_every_camera_is_answered_with_finite_numbers_and_without_a_missing_number(ran, name):
    estimates = ran[name].estimates
    assert [one.seq for one in estimates] == list(range(len(estimates)))
    assert all(math.isfinite(value) for one in estimates for twist in one.twists for value in twist)
    starts = [one.start_us for one in estimates]
    if not name.startswith(("clock-back", "wrap")):
        assert starts == sorted(set(starts))
    assert ran[name].status.estimates == len(estimates)


@pytest.mark.parametrize("name", ALL)
def test_a_second_after_the_fault_the_estimates_have_no_flag_of_it(ran, name):
    if name == "uncounted":  # it has no end
        return
    shift_us = {"clock-forward": 60_000_000, "clock-back": -1_500_000, "wrap": -(1 << 32)}.get(name, 0)
    later = [one for one in ran[name].estimates if END_US + 1_000_000 <= one.start_us - shift_us <= LENGTH_US]
    assert len(later) >= 18
    of_a_fault = {Flag.GAP, Flag.RESET, Flag.FROZEN, Flag.SENSOR_CHANGED, Flag.OVERLOAD}
    assert not of_a_fault.intersection(flag for one in later for flag in one.flags)


def test_the_neighbour_loses_nothing(ran):
    neighbour = ran["neighbour"]
    assert neighbour.lost == {}
    assert len(neighbour.estimates) == LENGTH_US // WINDOW_US - 1
    assert neighbour.flagged(Flag.RESET) == [0]
    assert not neighbour.flagged(Flag.GAP)
    assert not neighbour.verdicts.intersection(("lossy", "unstable"))


def test_a_camera_that_is_off_is_idle_and_the_gap_is_counted_in_windows(ran):
    off = ran["off"]
    assert off.lost == {"skipped_windows": 40}
    assert off.flagged(Flag.RESET) == [0, 80]
    assert "idle" in off.verdicts


def test_a_camera_that_repeats_its_events_is_frozen_and_unstable(ran):
    stuck = ran["stuck"]
    assert stuck.lost == {}
    frozen = stuck.flagged(Flag.FROZEN)
    assert frozen == list(range(frozen[0], 80))
    assert 40 <= frozen[0] <= 43
    assert "the camera repeats the same events" in stuck.reasons


def test_garbage_is_counted_and_the_newest_reason_is_told(ran):
    garbage = ran["garbage"]
    assert garbage.lost == {"malformed_packets": len(IN_FAULT), "skipped_windows": 40}
    assert "packets are refused: event packet" in garbage.reasons
    assert garbage.status.refusal.startswith("event packet")
    assert garbage.flagged(Flag.RESET) == [0, 80]


def test_another_size_resets_twice(ran):
    other = ran["wrong-size"]
    assert (other.status.resets, other.lost) == (2, {"restart_windows": 2})
    assert other.flagged(Flag.SENSOR_CHANGED) == [40, 80]


def test_a_size_that_changes_with_every_packet_is_unstable(ran):
    flapping = ran["flapping"]
    resets = len(IN_FAULT) + 1
    assert (flapping.status.resets, flapping.lost) == (resets, {"restart_windows": resets})
    assert "unstable" in flapping.verdicts
    assert "resets in the last 60 s" in flapping.reasons


def test_delayed_packets_are_used_and_flagged_late(old):
    delayed = old["delayed"]
    assert delayed.lost == {}
    assert {*range(40, 80)} <= {*delayed.flagged(Flag.LATE)}
    ages_s = [one.host.age_ns / 1e9 for one in delayed.estimates if 40 <= one.start_us // WINDOW_US < 80]
    assert min(ages_s) > 0.35


def test_packets_beyond_the_maximum_age_are_dropped_and_counted(old):
    stale = old["stale"]
    normal = [sent(packet).due_s for packet in good()]
    late_s = [one.due_s - due_s for one, due_s in zip(CAMERAS["stale"], normal, strict=True)]
    assert stale.lost.keys() == {"stale_packets", "skipped_windows"}
    assert stale.lost["stale_packets"] >= sum(late > 1.1 for late in late_s)
    assert "older than max_age_s" in stale.reasons
    answered = [one for one in stale.estimates if one.start_us >= BEGIN_US]
    assert len(answered) > 10  # it catches up
    assert all(one.host.age_ns < 2e9 for one in answered)


def test_missing_packets_are_counted_and_flag_their_windows(ran):
    found = ran["intermittent"]
    assert found.lost == {"gap_packets": 100}
    missing = {window for begin in range(44, 80, 8) for window in range(begin, begin + 4)}
    assert missing <= {*found.flagged(Flag.GAP)} <= missing | {begin - 1 for begin in range(44, 80, 8)}


@pytest.mark.parametrize(("name", "repeats"), [("duplicates", len(IN_FAULT)), ("repeats", 3)])
def test_repeated_packets_are_counted_and_change_nothing(ran, name, repeats):
    found = ran[name]
    assert found.lost == {"duplicate_packets": repeats}
    assert found.status.resets == 0
    assert twists(found) == twists(ran["neighbour"])


def test_bursts_lose_nothing(ran):
    assert ran["bursts"].lost == {}
    assert twists(ran["bursts"]) == twists(ran["neighbour"])


def test_packets_in_swapped_order_are_used_if_their_window_is_open(ran):
    reorder = ran["reorder"]
    too_late = [packet for packet in IN_FAULT if packet % 10 == 4]  # its partner closes the window
    assert reorder.lost == {"gap_packets": 100, "out_of_order_packets": len(too_late)}
    assert reorder.status.recovered_packets == 100
    missing = {packet // 5 for packet in too_late}
    begins = {
        packet // 5 - 1 for packet in IN_FAULT if packet % 10 == 0
    }  # the swap may have begun in the window before
    assert missing <= {*reorder.flagged(Flag.GAP)} <= missing | begins


def test_absurd_numbers_are_neither_losses_nor_restarts(ran):
    found = ran["huge-numbers"]
    assert found.lost == {"out_of_order_packets": len(IN_FAULT) // 10}
    assert twists(found) == twists(ran["neighbour"])


def test_a_driver_that_does_not_count_is_answered_and_named(ran):
    found = ran["uncounted"]
    assert (found.lost, found.status.uncounted_packets) == ({}, N - 1)
    assert "seq 0 in every packet" in found.reasons
    assert twists(found) == twists(ran["neighbour"])


def test_two_drivers_are_named_and_the_first_one_is_answered(ran):
    found = ran["two-drivers"]
    assert sum(found.lost.values()) == len(IN_FAULT)
    assert found.lost["foreign_packets"] >= len(IN_FAULT) - 2
    assert "two drivers publish on this stream" in found.reasons
    assert twists(found) == twists(ran["neighbour"])


def twists(ran):
    return [one.twists for one in ran.estimates]


def test_a_clock_that_jumps_forward_skips_windows(ran):
    found = ran["clock-forward"]
    assert found.lost == {"skipped_windows": 60_000_000 // WINDOW_US}
    assert found.flagged(Flag.RESET) == [0, (BEGIN_US + 60_000_000) // WINDOW_US]


@pytest.mark.parametrize("name", ["clock-back", "wrap"])
def test_a_clock_that_jumps_back_is_a_new_clock(ran, name):
    found = ran[name]
    assert (found.status.resets, found.lost) == (1, {"restart_windows": 1})
    assert len(found.flagged(Flag.RESET)) == 2


def test_a_restarted_driver_begins_a_new_sequence(ran):
    found = ran["restart"]
    assert (found.status.resets, found.lost) == (1, {"restart_windows": 1})
    assert found.flagged(Flag.RESET) == [0, 80]
