"""A router loses one node: `python -m tests.long.partition [--seconds 4 15] [--times 3]`.

Two nodes serve streams of 50 windows a second each, each through a TCP proxy of its own. The proxy of the node that
answers forwards nothing for so long, in neither direction, and then goes on with what was sent meanwhile. After 15 s
both ends have closed their link (the lease is 10 s), and the node connects again. The command reports windows that are
doubled, missing or wrong for a consumer, and windows that two nodes published after the link was back.
"""

import argparse
import collections
import sys
import tempfile
import time
from pathlib import Path

from tests.live.conftest import client, free_endpoint, start_router, wait_until
from tests.live.fellows import Consumer, Driver, compared, drain, fellows, follows, small_model, windows_late
from tests.live.relay import Link
from tests.long.standby import WINDOW_US

START_S = 300


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, nargs="+", default=[4.0, 15.0])
    parser.add_argument("--times", type=int, default=3, help="of each")
    parser.add_argument("--streams", type=int, default=2)
    parser.add_argument("--logs", help="folder for the logs of the nodes")
    args = parser.parse_args()
    streams = [f"cam{number}" for number in range(args.streams)]
    endpoint = free_endpoint()
    router = start_router(endpoint)
    links = {name: Link(int(endpoint.rpartition(":")[2])) for name in ("a", "b")}
    try:
        with tempfile.TemporaryDirectory() as folder, client(endpoint) as transport:
            model = small_model(Path(folder), WINDOW_US)
            with fellows(links, endpoint, model, logs=args.logs, links=links):
                consumer, driver = Consumer(transport), Driver(transport, streams).start()
                return run(transport, links, consumer, driver, streams, model, args)
    finally:
        for link in links.values():
            link.close()
        router.kill()
        router.wait()


def run(transport, links, consumer, driver, streams, model, args):
    """Part the node that answers, and report."""
    after = []  # when the link was back, and until when

    def follower():
        """The node that follows all streams with equal state."""
        leaders = {consumer.leader(one) for one in streams if consumer.taken.get(one)}
        others = set(links) - leaders
        return len(others) == 1 and all(follows(transport, *others, one) for one in streams)

    for seconds in args.seconds:
        for _ in range(args.times):
            wait_until(lambda: gathered(transport, consumer, streams) and follower(), START_S)
            first = consumer.leader(streams[0])
            parted_ns = time.monotonic_ns()
            if args.logs:
                print(time.strftime("%H:%M:%S"), "part", first, flush=True)
            links[first].part()
            wait_until(lambda: all(consumer.leader(one) != first for one in streams), START_S)  # noqa: B023
            taken_s = (time.monotonic_ns() - parted_ns) / 1e9
            time.sleep(max(0.0, seconds - taken_s))
            back_ns = time.monotonic_ns()
            links[first].heal()
            wait_until(follower, START_S)
            after.append((back_ns, time.monotonic_ns()))
            print(
                f"{seconds} s without {first}: the other node answers after {1e3 * taken_s:.0f} ms; "
                f"{first} follows with equal state {(after[-1][1] - back_ns) / 1e9:.1f} s after the link is back",
                flush=True,
            )
    driver.stop()
    time.sleep(1)
    return report(consumer, driver, streams, model, after, args)


def gathered(transport, consumer, streams):
    """Whether one node answers all streams."""
    if not all(consumer.taken.get(one) for one in streams):
        return False
    if len({consumer.leader(one) for one in streams}) > 1:
        drain(transport, "a")
        drain(transport, "a", resume=True)
    return len({consumer.leader(one) for one in streams}) == 1


def report(consumer, driver, streams, model, after, args):
    """Print the figures; return 0 if no window is doubled, missing or wrong, or published by two nodes."""
    bad = 0
    for stream in streams:
        found = compared(consumer, driver, stream, model, WINDOW_US)
        by_window = collections.defaultdict(set)
        for one in found.taken + consumer.dropped.get(stream, []):
            if any(begin <= one.at_ns <= end for begin, end in after):
                by_window[one.estimate.start_us].add(one.estimate.node)
        twice = sum(len(names) > 1 for names in by_window.values())
        print(f"{stream}: {found}; {twice} published by two nodes after the link was back")
        parted = [one for one in found.taken if one.at_ns >= after[0][0] - 1e9 * max(args.seconds)]
        late = max(windows_late(one, driver, WINDOW_US) for one in parted)
        print(f"{stream}: the latest window was {late:.2f} windows late")
        bad += found.bad + twice
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
