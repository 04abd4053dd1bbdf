"""kill -9 at random times of a push and its activation: `python -m tests.long.kills [--rounds 20] [--seed 0]`.

Every round starts the service with one folder and checks that it serves a complete model, the acknowledged one if
there is one. Then it pushes and activates another model and kills the service at a random time. It takes minutes and is
not part of `make test`.
"""

import argparse
import collections
import random
import sys
import tempfile
from pathlib import Path

from tests.live.killing import Node

SPAN_S = 2.0
"""Duration of a push and its activation here, with slow chunks [s]."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    draw = random.Random(args.seed)
    steps: collections.Counter[str] = collections.Counter()
    served: collections.Counter[str] = collections.Counter()
    ready_s = []
    with tempfile.TemporaryDirectory() as folder:
        node = Node(Path(folder))
        last = outcome = ""
        for number in range(args.rounds + 1):  # each start shows the result of the previous kill
            after_s = draw.uniform(0, SPAN_S)
            new, step, before = node.kill_in_a_change(args.seed * 1000 + number, after_s=after_s)
            if last:
                which = "the new" if before == last else "an earlier"
                served[which] += 1
                ready_s.append(node.ready_s)
                print(f"{number}: {outcome}; serves {which} model after the restart", flush=True)
            steps[step] += number < args.rounds
            last, outcome = new, f"killed after {after_s:.2f} s at {step}"
    print(f"{args.rounds} kills, each start with a complete model")
    print(f"last reported step: {dict(steps)}; serves after the restart: {dict(served)}")
    print(f"longest start until ready: {max(ready_s):.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
