"""Damaged files and random messages: `python -m tests.long.fuzz --files 3000 --messages 1000000`; hours at this size.

Each format gets `--files` damaged files (tests/mutations.py), read in a process of its own: a library that ends the
process is found too, and the file stays in the folder. Each decoder of the protocol gets its share of `--messages`
random or damaged messages. Only declared errors are allowed, and no message may take more than 50 ms of processor time.
The exit code is 1 if something else happened.
"""

import argparse
import gc
import json
import resource
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from neurove_protocol import NeuroVEError
from tests.mutations import WRITTEN, mutated, read_or_refused
from tests.protocol.messages import KINDS, Kind

MESSAGE_S = 0.05
"""Longest time for one message [s]."""

FILE_S = 5.0
"""Longest time for one damaged file [s]."""


def fuzz_format(name: str, runs: int, seed: int, folder: Path) -> dict[str, Any]:
    """Read damaged files of one format: counts, the slowest [s], the largest resident size [MiB], and failures."""
    warnings.simplefilter("error")
    data, rng = WRITTEN[name](folder), np.random.default_rng([seed, sum(name.encode())])
    refused, slowest, failures = 0, 0.0, []
    for run in range(runs):
        damaged = mutated(data, rng)
        path = folder / name
        path.write_bytes(damaged)
        began = time.thread_time()
        try:
            refused += read_or_refused(str(path), name) is not None
        except Exception:  # noqa: BLE001  # anything else than a declared error is a finding
            kept = path.with_name(f"found-{len(failures)}-{name}")
            kept.write_bytes(damaged)
            failures.append(f"run {run}, kept as {kept}: {traceback.format_exc().splitlines()[-1]}")
        took = time.thread_time() - began
        if took > FILE_S:
            failures.append(f"run {run} took {took:.1f} s, at most {FILE_S} s")
        slowest = max(slowest, took)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    return {"files": runs, "refused": refused, "slowest_s": slowest, "peak_mib": peak_mib, "failures": failures[:20]}


def fuzz_format_apart(name: str, runs: int, seed: int, folder: Path) -> dict[str, Any]:
    """As `fuzz_format`, in a process of its own."""
    place = folder / name.replace(".", "-")
    place.mkdir()
    worker = ["-m", "tests.long.fuzz", "--worker", name, "--files", str(runs), "--seed", str(seed)]
    ended = subprocess.run(
        [sys.executable, *worker, "--folder", str(place)], capture_output=True, text=True, check=False
    )
    if ended.returncode:
        why = f"the process ended with {ended.returncode} at {place / name}: {ended.stderr[-500:]}"
        return {"files": runs, "failures": [why]}
    found: dict[str, Any] = json.loads(ended.stdout)
    return found


def fuzz_messages(kind: Kind, runs: int, seed: int) -> dict[str, Any]:
    """Decode random and damaged messages of one kind: counts, the slowest [s], and failures."""
    rng, example = np.random.default_rng([seed, sum(kind.name.encode())]), kind.bytes()
    refused, slowest, failures = 0, 0.0, []
    for run in range(runs):
        data = rng.bytes(int(rng.integers(0, 400))) if run % 4 == 0 else mutated(example, rng)
        began = time.thread_time()
        try:
            kind.decode(data)
        except NeuroVEError:
            refused += 1
        except Exception:  # noqa: BLE001  # as above
            failures.append(f"{data.hex()}: {traceback.format_exc().splitlines()[-1]}")
        took = time.thread_time() - began
        if took > MESSAGE_S:
            failures.append(f"{data.hex()[:200]} took {1e3 * took:.0f} ms")
        slowest = max(slowest, took)
    return {"messages": runs, "refused": refused, "slowest_s": slowest, "failures": failures[:20]}


def main() -> int:
    """Run what the arguments ask for, and print one line of JSON for each format and each kind of message."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=300, help="damaged files of each format")
    parser.add_argument("--messages", type=int, default=100_000, help="messages in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="part of the names of the formats and kinds to run")
    parser.add_argument("--folder", type=Path, help="folder for files; default: a temporary one")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        print(json.dumps(fuzz_format(args.worker, args.files, args.seed, args.folder)))
        return 0
    failed = False
    folder = args.folder or Path(tempfile.mkdtemp(prefix="neurove-fuzz-"))
    for name in WRITTEN:
        if args.files and (args.only or "") in name:
            found = fuzz_format_apart(name, args.files, args.seed, folder)
            failed |= bool(found["failures"])
            print(json.dumps({"format": name, **found}), flush=True)
    gc.collect()
    gc.freeze()
    for kind in KINDS:
        if args.messages and (args.only or "") in kind.name:
            found = fuzz_messages(kind, args.messages // len(KINDS), args.seed)
            failed |= bool(found["failures"])
            print(json.dumps({"message": kind.name, **found}), flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
