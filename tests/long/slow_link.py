"""A slow link: `python -m tests.long.slow_link --mbit 5`; half a minute, not part of `make test`.

A camera of 19 Mbit/s sends over a link that carries less. The run prints how many windows were answered, how old the
estimates were, and what was lost.
"""

import argparse
import time

import numpy as np

from neurove_protocol import Flag, TwistEstimate
from neurove_protocol.control import StreamStatus
from neurove_protocol.events import encode_packet
from neurove_service.clients import ask
from tests.builders import make_packets
from tests.live.conftest import AT_FULL_SPEED, Source, client, free_endpoint, service, wait_until
from tests.live.relay import Relay

PACKET_US = 10_000


def run(mbit: float, seconds: float) -> str:
    """Send for some seconds; return one line of figures."""
    endpoint = free_endpoint()
    estimates: list[TwistEstimate] = []
    told: list[StreamStatus] = []
    with service(endpoint, "--model", "untrained", **AT_FULL_SPEED) as (_, listener, config):
        ask.listen(listener, config, estimates.append, told.append)
        relay = Relay(int(endpoint.rsplit(":", 1)[1]), mbit * 1e6 / 8)
        with client(relay.endpoint) as driver:
            source, began = Source(driver, config, "cam0"), time.monotonic()
            for packet in make_packets(int(seconds * 1e6 / PACKET_US), n=4000, step_us=PACKET_US):
                time.sleep(max(0.0, began + (packet.t0_us + PACKET_US) / 1e6 - time.monotonic()))
                source.put(encode_packet(packet), live=True)
            wait_until(lambda: bool(told) and told[-1].verdict == "idle")
        relay.close()
    ages_s = [one.host.age_ns / 1e9 for one in estimates if one.host is not None]
    gaps = sum(Flag.GAP in one.flags for one in estimates)
    return (
        f"{mbit:g} Mbit/s: {len(estimates)} of {int(seconds * 20)} windows answered, {gaps} flagged gap; "
        f"age p50 {np.percentile(ages_s, 50):.2f} s, most {max(ages_s):.2f} s; lost {told[-1].lost.nonzero()}"
    )


def main() -> None:
    """Print the line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mbit", type=float, default=5.0, help="of the link [Mbit/s]")
    parser.add_argument("--seconds", type=float, default=8.0, help="time [s]")
    given = parser.parse_args()
    print(run(given.mbit, given.seconds))


if __name__ == "__main__":
    main()
