"""The command bench: speed on this machine, as ratios within one run."""

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError
from neurove_service.cli.arguments import add_force, command, commit, refuse_existing

if TYPE_CHECKING:
    from neurove_core.bench import Row

ALL = (
    "ingest",
    "window",
    "served",
    "refinement",
    "end-to-end",
    "train",
    "streams",
    "decode",
    "simulate",
    "sine",
    "wire",
    "processes",
    "metrics",
    "narrow",
    "gpu",
)

FIGURES = "figures"
"""The name under which all benchmarks of `neurove_core.bench.figures` run, with its table at the end."""

NARROW = {"ONEDNN_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2", "NUMBA_CPU_NAME": "haswell"}
"""Variables that restrict an x86-64 machine to AVX2; the libraries read them when they are loaded."""


def bench(args: argparse.Namespace) -> int:
    """Measure our speed and the peers' in one process: same input, interleaved runs, answers compared."""
    import torch

    from neurove_core.bench import chart, figures, machine

    torch.set_num_threads(1)
    for suffix in (".png", ".svg") if args.plot else ():
        refuse_existing("bench", "--plot", args.plot.with_suffix(suffix), None, force=args.force)
    stamp = machine.stamp(commit())
    print(stamp, file=sys.stderr)
    rows: list[Row] = []
    missing: list[str] = []
    asked: Sequence[str] = args.what or ALL
    wants_table = FIGURES in asked
    if wants_table:
        asked = list(dict.fromkeys(name for one in asked for name in (figures.BENCHMARKS if one == FIGURES else [one])))
    for name in asked:
        for row in _rows(name, args, missing):
            rows.append(row)
            if not args.json:
                print(_sentence(row), flush=True)
    if wants_table and not args.json:
        print(f"\n{figures.table(rows)}")
    if missing:
        print(f"not measured: {'; '.join(dict.fromkeys(missing))}", file=sys.stderr)
    if args.json:
        print(json.dumps([row._asdict() for row in rows]))
    if args.plot:
        for file in chart.save(rows, stamp, args.plot):
            print(f"wrote {file}", file=sys.stderr)
    return EXIT_FAILURE if any(row.equal is False for row in rows) else 0


def _rows(name: str, args: argparse.Namespace, missing: list[str]) -> Iterator["Row"]:
    from neurove_core.bench import device, ingest, processes, refinement, served, simulate, sine, window
    from neurove_service.cli import bench_metrics
    from neurove_service.clients import bench_wire

    options = {"quick": args.quick, "with_peers": args.peers}
    run: dict[str, Callable[[], list[Row]]] = {
        "ingest": lambda: ingest.ingest(_rounds(args, 21), missing, **options),
        "window": lambda: window.window(_rounds(args, 15), missing, **options),
        "served": lambda: served.served(_rounds(args, 31), missing, **options),
        "refinement": lambda: refinement.refinement(_rounds(args, 15), quick=args.quick),
        "end-to-end": lambda: ingest.end_to_end(_rounds(args, 15), missing, **options),
        "train": lambda: window.train(_rounds(args, 3), missing, **options),
        "streams": lambda: window.streams(_rounds(args, 21), quick=args.quick),
        "decode": lambda: ingest.decode(_rounds(args, 9), missing, **options),
        "simulate": lambda: simulate.rows(_rounds(args, 5), quick=args.quick),
        "sine": lambda: sine.compare(_rounds(args, 9)),
        "wire": lambda: bench_wire.wire(_rounds(args, 15), quick=args.quick),
        "processes": lambda: processes.processes(_rounds(args, 7), quick=args.quick),
        "metrics": lambda: bench_metrics.metrics(_rounds(args, 11), quick=args.quick),
        "narrow": lambda: _narrow(args, missing),
        "gpu": lambda: device.gpu(_rounds(args, 15), missing, quick=args.quick),
    }
    yield from run[name]()


def _narrow(args: argparse.Namespace, missing: list[str]) -> "list[Row]":
    """Run the benchmark `window` in a process that uses AVX2 at most.

    Raises:
        NeuroVEError: the process failed; it printed its reason to stderr.
    """
    from neurove_core.bench import Row

    if platform.machine().lower() not in ("x86_64", "amd64"):
        missing.append(f"narrow (this machine is {platform.machine()}, AVX2 exists on x86-64 only)")
        return []
    flags = [flag for flag, given in (("--peers", args.peers), ("--quick", args.quick)) if given]
    command = [sys.executable, "-m", "neurove_service.cli", "bench", "window", "--json", *flags]
    run = subprocess.run(command, env={**os.environ, **NARROW}, stdout=subprocess.PIPE, check=False)
    try:
        found = [Row(**row) for row in json.loads(run.stdout)]
    except (ValueError, TypeError):
        raise NeuroVEError(f"bench narrow: its process ended with exit code {run.returncode}") from None
    return [row._replace(name=f"{row.name}, AVX2 at most") for row in found]


def _rounds(args: argparse.Namespace, usual: int) -> int:
    return 1 if args.quick else usual


def _sentence(row: "Row") -> str:
    agree = {True: "equal answers", False: "DIFFERENT ANSWERS", None: "a different computation by design"}[row.equal]
    if row.deviation is not None:
        agree = f"rounded in another order, its result deviates by {row.deviation:+.2%}"
    share = "" if row.share_of_limit is None else f", {row.share_of_limit:.0%} of this machine's limit"
    against = f"{row.ratio:.2f} times as fast as {row.peer} ({row.peer_ms:.3g} ms; {agree})"
    return f"{row.name}: {row.ours_ms:.3g} ms{share}; {against}"


def add_bench(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove bench`."""
    command(parser, bench)
    names = ", ".join(ALL)
    about = f"any of {names}; default: all. 'figures' runs what the table of speed figures needs, and prints it"
    parser.add_argument("what", nargs="*", type=_benchmark, metavar="WHAT", help=about)
    parser.add_argument("--peers", action="store_true", help="measure the peers of the extra 'bench' too")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw a chart as FILE.png and FILE.svg")
    add_force(parser, "FILE.png and FILE.svg")
    parser.add_argument(
        "--quick", action="store_true", help="small input, once, to compare the answers; its times mean nothing"
    )


def _benchmark(text: str) -> str:
    if text not in (*ALL, FIGURES):
        raise argparse.ArgumentTypeError(f"unknown benchmark {text!r}; known are {', '.join((*ALL, FIGURES))}")
    return text
