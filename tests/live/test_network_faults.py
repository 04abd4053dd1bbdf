"""Faults of the network on a real service: a slow link, a stopped service, a stopped consumer.

A killed router is in test_feed.py; faults of cameras are in test_faults.py.
"""

import json
import signal
import threading
import time
from typing import Any

import pytest

from neurove_protocol import EventPacket, Flag
from neurove_protocol.events import encode_packet
from tests.builders import make_packets
from tests.live.conftest import AT_FULL_SPEED, Source, client, free_endpoint, listen, running, service, wait_until
from tests.live.relay import Relay

pytestmark = pytest.mark.live

PACKET_US = 10_000


def play(source: Source, packets: list[EventPacket]) -> None:
    """Send each packet when its time is over, as a live camera."""
    began = time.monotonic() - packets[0].t0_us / 1e6
    for packet in packets:
        time.sleep(max(0.0, began + (packet.t0_us + PACKET_US) / 1e6 - time.monotonic()))
        source.put(encode_packet(packet), live=True)


def test_a_link_that_is_too_slow_delivers_fresh_data_with_gaps_and_never_old_data():
    endpoint, estimates, told = free_endpoint(), [], []
    with service(endpoint, "--model", "untrained", "--queue-s", "30", **AT_FULL_SPEED) as (_, listener, config):
        listen(listener, config, estimates.append, told.append)
        relay = Relay(int(endpoint.rsplit(":", 1)[1]), bytes_per_s=625_000)  # 5 Mbit/s, a quarter of what is sent
        try:
            with client(relay.endpoint) as driver:
                play(Source(driver, config, "cam0"), make_packets(500, n=4000, step_us=PACKET_US))
                wait_until(lambda: told and told[-1].packets_received and told[-1].verdict == "idle")
        finally:
            relay.close()
    ages_s = [one.host.age_ns / 1e9 for one in estimates]
    assert len(estimates) > 30
    assert max(ages_s) < 2
    assert all(Flag.LATE in one.flags for one, age_s in zip(estimates, ages_s, strict=True) if age_s > 0.25)
    assert sum(Flag.GAP in one.flags for one in estimates) > len(estimates) / 2


def test_a_service_that_was_stopped_goes_on_with_the_newest_data():
    endpoint, estimates, told = free_endpoint(), [], []
    with service(endpoint, "--model", "untrained", **AT_FULL_SPEED) as (process, listener, config):
        listen(listener, config, estimates.append, told.append)
        with client(endpoint) as driver:
            source, packets = Source(driver, config, "cam0"), make_packets(500, n=60, step_us=PACKET_US)
            stop, go_on = packets[100].t0_us / 1e6, packets[300].t0_us / 1e6
            timers = [
                threading.Timer(after_s, process.child.send_signal, [number])
                for after_s, number in ((stop, signal.SIGSTOP), (go_on, signal.SIGCONT))
            ]
            for timer in timers:
                timer.start()
            play(source, packets)
            wait_until(lambda: told and told[-1].verdict == "idle")
    lost = told[-1].lost
    assert told[-1].packets_received + lost.gap_packets + lost.overload_packets == len(packets)
    assert lost.stale_packets + lost.overload_packets + lost.gap_packets > 50
    again = [one for one in estimates if one.start_us > packets[310].t0_us]
    assert len(again) > 30
    assert not any(Flag.LATE in one.flags for one in again[20:])
    old = [one for one in estimates if one.host.age_ns > 0.25e9]
    assert all(Flag.LATE in one.flags for one in old)


def test_a_consumer_that_was_stopped_does_not_disturb_the_service():
    endpoint, estimates, told = free_endpoint(), [], []
    with service(endpoint, "--model", "untrained", **AT_FULL_SPEED) as (_, listener, config):
        listen(listener, config, estimates.append, told.append)
        with client(endpoint) as driver, running("watch", "--connect", endpoint, "--json") as consumer:
            shown: list[dict[str, Any]] = []
            reader = threading.Thread(target=lambda: shown.extend(map(json.loads, consumer.child.stdout)))
            reader.start()
            source, packets = Source(driver, config, "cam0"), make_packets(6_000, n=60, step_us=PACKET_US)
            before = next(at for at in range(0, 5_000, 10) if shown or play(source, packets[at : at + 10]))
            consumer.child.send_signal(signal.SIGSTOP)
            try:
                play(source, packets[before : before + 200])
            finally:
                consumer.child.send_signal(signal.SIGCONT)
            wait_until(lambda: told and told[-1].packets_received == before + 200)
            wait_until(lambda: any("late" in one["flags"] for one in shown))
            consumer.child.terminate()
            reader.join()
    assert told[-1].lost.nonzero() == {}
    assert len(estimates) == told[-1].estimates
    waited = [one for one in shown if one["host"]["age_ns"] > 0.5e9]
    assert waited
    assert all("late" in one["flags"] for one in waited)
