"""Changes of two nodes under load: `python -m tests.long.standby [--drains 50] [--kills 50] [--hangs 5] [--streams 2]`.

Two nodes serve streams of 50 windows a second each. The node that answers is drained, killed (-9) or stopped (SIGSTOP),
again and again; it comes back and follows. At the end the estimates that a consumer took are compared with a run
without changes. The command reports doubled and missing windows, wrong numbers, and how late the latest window of each
change was, in windows.
"""

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

from tests.live.conftest import START_S, client, free_endpoint, start_router, wait_until
from tests.live.fellows import Consumer, Driver, compared, drain, fellows, follows, small_model, windows_late

WINDOW_US = 20_000
AROUND_NS = 1_000_000_000
"""Windows that arrive in this time after a change count as its windows."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drains", type=int, default=50)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--hangs", type=int, default=5)
    parser.add_argument("--streams", type=int, default=2)
    parser.add_argument("--logs", help="folder for the logs of the nodes")
    args = parser.parse_args()
    streams = [f"cam{number}" for number in range(args.streams)]
    endpoint = free_endpoint()
    router = start_router(endpoint)
    try:
        with tempfile.TemporaryDirectory() as folder, client(endpoint) as transport:
            model = small_model(Path(folder), WINDOW_US)
            with fellows(("a", "b"), endpoint, model, logs=args.logs) as nodes:
                consumer, driver = Consumer(transport), Driver(transport, streams).start()
                wait_until(lambda: all(len(consumer.taken.get(one, ())) > 50 for one in streams), START_S)
                changes = run(transport, nodes, consumer, streams, args)
                driver.stop()
                time.sleep(1)
            return report(consumer, driver, streams, model, changes)
    finally:
        router.kill()
        router.wait()


def run(transport, nodes, consumer, streams, args):
    """Change the node that answers so often; when, and how."""
    changes = []

    def ready():
        """Whether one node answers all streams, and the other one follows them with equal state."""
        first = consumer.leader(streams[0])
        (second,) = set(nodes) - {first}
        return all(consumer.leader(one) == first and follows(transport, second, one) for one in streams)

    def gathered():
        """Streams of two leaders are drained to one node first."""
        if len({consumer.leader(one) for one in streams}) > 1:
            drain(transport, "a")
            drain(transport, "a", resume=True)
        return ready()

    for kind, count in (("drain", args.drains), ("hang", args.hangs), ("kill", args.kills)):
        for number in range(count):
            wait_until(gathered, START_S)
            first = consumer.leader(streams[0])
            changes.append((time.monotonic_ns(), kind))
            if args.logs:
                print(time.strftime("%H:%M:%S"), kind, first, flush=True)
            if kind == "drain":
                drain(transport, first)
                drain(transport, first, resume=True)
            elif kind == "hang":
                nodes[first].hang()
                time.sleep(1.5)
                nodes[first].wake()
            else:
                nodes[first].kill()
                nodes[first].start()
            wait_until(lambda: all(consumer.leader(one) != first for one in streams), START_S)  # noqa: B023
            if number % 10 == 9:
                print(f"{kind} {number + 1}", flush=True)
    wait_until(ready, START_S)
    return changes


def report(consumer, driver, streams, model, changes):
    """Print the figures; return 0 if no window is doubled, missing, out of order or wrong."""
    bad, late, usual = 0, {}, []
    for stream in streams:
        found = compared(consumer, driver, stream, model, WINDOW_US)
        for one in found.unequal[:1]:
            print(f"{stream}: the first that is not equal begins at {one.start_us} us, from {one.node}: {one.flags}")
        again = consumer.dropped.get(stream, [])
        print(f"{stream}: {found}; {len(again)} of an earlier term or published twice, dropped by the rule")
        bad += found.bad
        for one in found.taken:
            delay = windows_late(one, driver, WINDOW_US)
            usual.append(delay)
            for index, (at_ns, kind) in enumerate(changes):
                if 0 <= one.at_ns - at_ns < AROUND_NS:
                    late[kind, index] = max(delay, late.get((kind, index), 0.0))
    high = sorted(usual)[int(0.99 * len(usual))]
    print(f"all windows: median {statistics.median(usual):.2f} windows late, 99 %: {high:.2f}")
    for kind in dict.fromkeys(kind for _, kind in changes):
        worst = sorted(value for (of, _), value in late.items() if of == kind)
        over, middle = sum(value > 2 for value in worst), statistics.median(worst)
        print(
            f"{kind}: {len(worst)}; latest window: median {middle:.2f}, worst {worst[-1]:.2f}, {over} above 2 windows"
        )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
