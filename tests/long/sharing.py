"""Many cameras on three nodes: `python -m tests.long.sharing [--streams 32] [--copies 2]`; a minute or two.

The streams have 20 windows a second each. A node joins, one is killed (-9), and it comes back. For each change the
command reports, in windows: how late the latest window of any stream was, how late the windows of the last 3 s were
(what remains of the change), the longest time without a window of one stream, and for how long two nodes answered one
stream. At the end it compares all estimates that a consumer took with a run without changes. Streams of the killed node
that no other node followed, such as all with `--copies 1`, begin anew: they are reported and not counted.

Windows that a node skipped, or computed with missing packets, have a flag; they, and what follows from them, are
reported and not counted, and so are windows that were published and lost on the way.

On a machine that cannot compute all copies, nodes end followers, so not every place is taken after `--settle` seconds.
The command reports that, and goes on.
"""

import argparse
import itertools
import os
import statistics
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from neurove_protocol.duty import DutyReply, DutyRequest
from neurove_service.node.sharing import drawn
from tests.live.conftest import client, free_endpoint, start_router, wait_until
from tests.live.fellows import KEYS, Consumer, Driver, Fellow, compared, duty, small_model, windows_late

WINDOW_US = 50_000
START_S = 300
END_US = 1 << 62
LAST_S = 3
"""Windows of this time before the next change show what remains of the last one."""

NO_SILENCE = (0.0, "")


class Change(NamedTuple):
    """What the command did, and when."""

    at_ns: int
    kind: str
    of: set  # the streams that it concerns
    alone: set  # those of them that no other node followed with equal state


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--streams", type=int, default=32)
    parser.add_argument("--copies", type=int, default=2)
    parser.add_argument("--events", type=int, default=50, help="in each packet; a window has two packets")
    parser.add_argument("--settle", type=float, default=60, help="seconds that a change may take")
    parser.add_argument("--queue-s", type=float, default=60, help="of the nodes: how late they may be before they skip")
    parser.add_argument("--logs", help="folder for the logs of the nodes")
    args = parser.parse_args()
    streams = [f"cam{number}" for number in range(args.streams)]
    endpoint = free_endpoint()
    router = start_router(endpoint)
    try:
        with tempfile.TemporaryDirectory() as folder, client(endpoint) as transport:
            model = small_model(Path(folder), WINDOW_US)
            share = ("--copies", str(args.copies), "--max-streams", str(args.streams), "--queue-s", str(args.queue_s))
            nodes = {name: Fellow(name, endpoint, model, *share, logs=args.logs) for name in ("n1", "n2", "n3")}
            consumer, driver = Consumer(transport), Driver(transport, streams, args.events, 100, WINDOW_US // 2)
            try:
                changes, lossy = run(transport, nodes, consumer, driver, streams, args)
            finally:
                for node in nodes.values():
                    if node.process is not None and node.process.child.poll() is None:
                        node.end()
            return report(consumer, driver, streams, model, changes, lossy, args.copies)
    finally:
        router.kill()
        router.wait()


def run(transport, nodes, consumer, driver, streams, args):
    """Let nodes join, die and come back; each change, and the streams that had lost packets before the first one."""
    changes, alone = [], set()

    def join(*names):
        for name in names:
            nodes[name].start()
        wait_until(lambda: all(transport.tokens(KEYS.alive(name), 1.0) for name in names), START_S)

    def settle(*alive):
        """Wait until the streams are where they belong, and each of their other nodes follows with equal state."""
        owners = {one: drawn(one, dict.fromkeys(alive, 1))[: args.copies] for one in streams}
        began = time.monotonic()
        wait_until(lambda: all(consumer.taken.get(one) for one in streams), START_S)
        waiting = [(one, node) for one in streams for node in owners[one]]

        def is_there(one, node):
            reply = duty(transport, node, one)
            return reply is not None and reply.equal

        def all_there():
            waiting[:] = [(one, node) for one, node in waiting if not is_there(one, node)]
            moved = all(consumer.leader(one) in owners[one] for one in streams)
            return (moved and not waiting) or time.monotonic() > began + args.settle

        wait_until(all_there, START_S + args.settle)
        counts = {node: sum(consumer.leader(one) == node for one in streams) for node in alive}
        missing = f", {len(waiting)} of {sum(map(len, owners.values()))} places not ready yet" if waiting else ""
        load = os.getloadavg()[0]
        alone.clear()
        alone.update(one for one, _ in waiting)
        print(f"after {time.monotonic() - began:.1f} s: answers {counts}{missing}; load {load:.1f}", flush=True)

    def change(kind, of, act, *alive):
        of = {one for one in streams if of is None or consumer.leader(one) == of}
        for one in of - alone if kind.endswith("killed") else ():  # followers may have ended since
            replies = transport.ask(KEYS.duty(), DutyRequest(stream=one).encode(), 1.0)
            found = [DutyReply.decode(reply.payload) for reply in replies]
            if not any(reply.role == "follows" and reply.equal for reply in found):
                alone.add(one)
        changes.append(Change(time.monotonic_ns(), kind, of, of & alone))
        print(kind, flush=True)
        act()
        settle(*alive)
        time.sleep(LAST_S)

    join("n1", "n2")
    driver.start()
    settle("n1", "n2")
    time.sleep(2)
    lossy = {one for one in streams if any(is_lossy(got.estimate) for got in list(consumer.taken[one]))}
    consumer.forget()
    change("n3 joins", None, lambda: join("n3"), "n1", "n2", "n3")
    change("n2 is killed", "n2", nodes["n2"].kill, "n1", "n3")
    change("n2 joins again", None, lambda: join("n2"), "n1", "n2", "n3")
    driver.stop()
    changes.append(Change(time.monotonic_ns(), "end", set(), set()))
    return changes, lossy


def overlaps(got):
    """How long two nodes answered a stream at each change of the term [windows]."""
    by_term = {}
    for one in got:
        by_term.setdefault(one.estimate.term, []).append(one.at_ns)
    terms = sorted(by_term)
    return [
        (by_term[after][0], max(0.0, (by_term[before][-1] - by_term[after][0]) / 1e3 / WINDOW_US))
        for before, after in itertools.pairwise(terms)
    ]


def is_lossy(estimate):
    """Whether the node says that packets or windows are missing before an estimate."""
    return bool({"gap", "overload"} & set(estimate.flags))


def told(got):
    """Who published an estimate, and when it arrived."""
    one = got.estimate
    at = datetime.fromtimestamp(time.time() - (time.monotonic_ns() - got.at_ns) / 1e9, UTC)
    return f"{one.node} term {one.term} window {one.start_us // WINDOW_US} at {at:%H:%M:%S.%f}"


def report(consumer, driver, streams, model, changes, lossy, copies):
    """Print the figures; return 0 if no window is doubled, missing, out of order or wrong.

    The streams in `lossy` had lost packets before the first change.
    """
    bad, anew, losses, excused = 0, 0, 0, 0
    late, remains, silent, twice, usual = {}, {}, {}, {}, []
    ends = [one.at_ns for one in changes]
    kill = next(one for one in changes if one.kind.endswith("killed"))
    killed = kill.of if copies == 1 else kill.alone

    def kind_at(at_ns):
        return next((one.kind for one in reversed(changes) if at_ns >= one.at_ns), "before")

    for stream in streams:
        found = compared(consumer, driver, stream, model, WINDOW_US)
        if stream in killed:
            anew += len(found.broken) + len(found.unequal)
            bad += found.doubled
        else:
            lossy_us = (
                -1
                if stream in lossy
                else min((one.estimate.start_us for one in found.taken if is_lossy(one.estimate)), default=END_US)
            )
            losses += lossy_us < END_US
            excused += sum(one.start_us >= lossy_us for one in found.unequal)
            wrong = [one for one in found.unequal if one.start_us < lossy_us]
            bad += found.doubled + len(wrong)
            if found.doubled or wrong:
                print(f"{stream}: {found.doubled} doubled, {len(wrong)} of another state")
            by_start = {one.estimate.start_us: one for one in found.taken}
            for before, after in found.broken:
                last, first = by_start[before], by_start[after]
                lost = first.estimate.seq - last.estimate.seq - 1
                missing = (after - before) // WINDOW_US - 1
                if lost == missing or is_lossy(first.estimate) or kind_at(first.at_ns) == "end":  # nodes end then, too
                    excused += missing
                    continue
                bad += 1
                print(
                    f"{stream}: {missing} windows missing from {before + WINDOW_US} us, {lost} of them published; "
                    f"{kind_at(first.at_ns)}, {last.estimate.node} before and {first.estimate.node} after"
                )
        for one in found.taken:
            delay = windows_late(one, driver, WINDOW_US)
            usual.append(delay)
            if stream not in killed:
                late.setdefault(kind_at(one.at_ns), []).append(delay)
                if any(0 <= end_ns - one.at_ns < LAST_S * 1e9 for end_ns in ends):
                    remains.setdefault(kind_at(one.at_ns), []).append(delay)
        for before, after in itertools.pairwise(found.taken):
            pause = (after.at_ns - before.at_ns) / 1e3 / WINDOW_US
            kind = kind_at(after.at_ns)
            silent[kind] = max(silent.get(kind, NO_SILENCE), (pause, stream, before, after), key=lambda one: one[0])
        everything = sorted(found.taken + consumer.dropped.get(stream, []), key=lambda one: one.at_ns)
        for at_ns, length in overlaps(everything):
            twice.setdefault(kind_at(at_ns), []).append(length)
    total = sum(len(consumer.taken[one]) for one in streams)
    dropped = sum(len(one) for one in consumer.dropped.values())
    print(
        f"{total} windows of {len(streams)} streams, {dropped} dropped by the rule of terms; "
        f"{bad} doubled, missing or wrong"
    )
    if excused:
        print(
            f"{losses} streams lost packets or skipped windows, and said so: {excused} windows missing or of another "
            "state from then on, or lost on the way to the consumer"
        )
    if killed:
        print(f"{len(killed)} streams of the killed node began anew: {anew} gaps and windows of another state")
    usual.sort()
    high = usual[int(0.99 * len(usual))]
    print(f"all windows: median {statistics.median(usual):.2f} windows late, 99 %: {high:.2f}, worst {usual[-1]:.2f}")
    for kind, values in late.items():
        over = sum(value > 2 for value in values)
        lengths = twice.get(kind, [0.0])
        rest = sorted(remains.get(kind, [0.0]))
        print(
            f"{kind}: latest window {max(values):.2f}, {over} of {len(values)} above 2 windows; "
            f"in the last {LAST_S} s median {statistics.median(rest):.2f}, 99 % {rest[int(0.99 * len(rest))]:.2f}"
        )
        pause, stream, *ends = silent.get(kind, NO_SILENCE)
        who = f" ({stream}, {' and then '.join(map(told, ends))})" if ends else ""
        print(
            f"  longest time without a window of a stream {pause:.1f} windows{who}; "
            f"{len(twice.get(kind, []))} changes, two nodes answered for at most {max(lengths):.2f} windows"
        )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
