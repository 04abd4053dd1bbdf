"""kill -9 at random points of a push and its activation: `python -m tests.long.kills [--rounds 20] [--seed 0]`.

Every round starts a service, pushes and activates a new model, kills it at a random time, starts it again and checks
that it serves a whole model. Not part of `make test`: it takes minutes.
"""

import argparse
import collections
import random
import sys
import tempfile
from pathlib import Path

from tests.live.killing import Node

SPAN_S = 2.0
"""A push and its activation take about so long here, chunks slowed down."""


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
        for number in range(args.rounds):
            after_s = draw.uniform(0, SPAN_S)
            new, step, before = node.kill_in_a_change(args.seed * 1000 + number, after_s=after_s)
            models = node.check(new, before)
            ready_s.append(node.ready_s)
            steps[step] += 1
            served["new" if models.active.digest == new else "before"] += 1
            which = "new" if models.active.digest == new else "before"
            print(f"{number + 1}: killed after {after_s:.2f} s at {step}; serves the {which} model", flush=True)
    print(f"{args.rounds} kills, 0 half models; last step heard: {dict(steps)}; serves after it: {dict(served)}")
    print(f"longest start until ready: {max(ready_s):.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
