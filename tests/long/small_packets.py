"""Many small packets: `python -m tests.long.small_packets --rate 20000`; half a minute, not part of `make test`.

A driver sends packets of a few events to a node. The run prints the processor time of the node, what it lost, and the
latency of its estimates.
"""

import argparse
import os
import time
from pathlib import Path

from neurove_protocol.control import StreamStatus
from neurove_protocol.events import encode_packet
from neurove_service.clients import ask
from tests.builders import make_packets
from tests.live.conftest import AT_FULL_SPEED, Source, client, free_endpoint, service, wait_until


def process_seconds(pid: int, *, children: bool = False) -> float:
    """Processor time so far of a process, or of its children that ended [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    first = 13 if children else 11
    return (int(fields[first]) + int(fields[first + 1])) / os.sysconf("SC_CLK_TCK")


def run(rate: int, seconds: float, events: int) -> str:
    """Send for some seconds; return one line of figures."""
    payloads = [encode_packet(one) for one in make_packets(int(rate * seconds), n=events, step_us=1_000_000 // rate)]
    told: list[StreamStatus] = []
    endpoint = free_endpoint()
    with service(endpoint, "--model", "default", **AT_FULL_SPEED) as (process, listener, config):
        ask.listen(listener, config, lambda _: None, told.append)
        with client(endpoint) as driver:
            source = Source(driver, config, "cam0")
            before_s, began, sent = process_seconds(process.child.pid), time.monotonic(), 0
            while sent < len(payloads):
                due = min(len(payloads), int((time.monotonic() - began) * rate))
                for payload in payloads[sent:due]:
                    source.put(payload, live=True)
                sent = due
                time.sleep(0.0002)
            took_s = time.monotonic() - began
            wait_until(lambda: bool(told) and told[-1].verdict == "idle")
            cores = (process_seconds(process.child.pid) - before_s) / took_s
    status = told[-1]
    latency = status.latency_ms
    return (
        f"{len(payloads)} packets of {events} events in {took_s:.1f} s: {cores:.2f} cores, "
        f"{status.packets_received} received, lost {status.lost.nonzero() or 'nothing'}, "
        f"p50 {latency.p50 if latency else 0:.1f} ms, p99 {latency.p99 if latency else 0:.1f} ms"
    )


def main() -> None:
    """Print the line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=int, default=20_000, help="packets a second")
    parser.add_argument("--events", type=int, default=5, help="events of a packet")
    parser.add_argument("--seconds", type=float, default=6.0, help="time [s]")
    given = parser.parse_args()
    print(run(given.rate, given.seconds, given.events))


if __name__ == "__main__":
    main()
