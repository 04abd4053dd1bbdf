"""The commands of experiments, which need no service: reproduce."""

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from service.arguments import command, commit


def reproduce_firing(args: argparse.Namespace) -> int:
    """How often ALIF, LIF and LTC fire under one random current."""
    from neurove_core.experiments import firing

    report = firing.run(args.seed)
    files = firing.save(report, args.out) if args.out else []
    print(firing.to_json(report) if args.json else firing.to_markdown(report), end="")
    for file in files:
        print(f"wrote {file}", file=sys.stderr)
    return 0


def reproduce_repriming(args: argparse.Namespace) -> int:
    """How settled a model's first estimates are after a change of model."""
    from neurove_core.experiments import repriming

    told = sys.stderr.isatty()
    report = repriming.run(
        args.model, args.streets, progress=lambda name: print(name, file=sys.stderr) if told else None
    )
    files = repriming.save(report, args.out) if args.out else []
    print(repriming.to_json(report) if args.json else repriming.to_markdown(report), end="")
    for file in files:
        print(f"wrote {file}", file=sys.stderr)
    return 0 if report.least_primed is not None else 1


def reproduce_sine(args: argparse.Namespace) -> int:
    """Tables I and II: regression and forecast of a sine by ASLSTM, ASLSTM-w/o, SLSTM and LTC."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from neurove_core.experiments import sine_report

    models, seeds = args.models.split(","), range(args.seed, args.seed + args.seeds)
    typed, made_by = shlex.join(["neurove", *sys.argv[1:]]), commit()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        tasks: dict[tuple[str, int], Any] = {}

        def progress(model: str, seed: int, update: int, updates: int, mse: float) -> None:
            if (model, seed) not in tasks:
                tasks[model, seed] = bar.add_task("", total=updates)
            rmse = f"{model} seed {seed}: update {update}, RMSE {mse**0.5:.2e}"
            bar.update(tasks[model, seed], completed=update, description=rmse)

        runs: list[sine_report.Run] = []
        files: dict[Path, None] = {}
        for run in sine_report.reproduce(models, seeds, changes=dict(args.set), quick=args.quick, progress=progress):
            runs.append(run)
            if args.out:
                files |= dict.fromkeys(sine_report.save_run(runs, args.out, command=typed, commit=made_by))
    if args.out:
        files |= dict.fromkeys(sine_report.save(runs, args.out))
    figures = [run.figures for run in runs]
    tables = sine_report.tables(figures)
    print(json.dumps(figures) if args.json else "\n".join(sine_report.markdown(tables[n], n) for n in tables))
    for file in files:
        print(f"wrote {file}", file=sys.stderr)
    return 0


def _assignment(text: str) -> tuple[str, str]:
    field, separator, value = text.partition("=")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r}: FIELD=VALUE is expected")
    return field, value


def add(commands: Any) -> None:
    """Add these commands to the parser."""
    parser = commands.add_parser("reproduce", help="The paper's experiments.").add_subparsers(required=True)
    firing = command(parser, "firing", reproduce_firing)
    firing.add_argument("--seed", type=int, default=0, help="of the first of ten runs; default 0")
    firing.add_argument("--out", type=Path, metavar="DIR", help="write table and figure (PNG, SVG) into this folder")
    repriming = command(parser, "repriming", reproduce_repriming)
    repriming.add_argument("--model", default="default", help="name of a built-in model, or a bundle's file")
    repriming.add_argument("--streets", type=int, default=6, metavar="N", help="so many held-out streets; default 6")
    repriming.add_argument("--out", type=Path, metavar="DIR", help="write table, figures and picture into this folder")
    sine = command(parser, "sine", reproduce_sine)
    sine.add_argument("--models", default="aslstm,aslstm-spiking,aslstm-wo,slstm,ltc", help="which, joined by commas")
    sine.add_argument("--seed", type=int, default=0, help="the first seed; default 0")
    sine.add_argument("--seeds", type=int, default=1, metavar="N", help="so many seeds, one after the other; default 1")
    sine.add_argument(
        "--set", type=_assignment, action="append", default=[], metavar="FIELD=VALUE", help="a trial: another recipe"
    )
    sine.add_argument("--quick", action="store_true", help="a few updates, to see that it runs: figures mean nothing")
    sine.add_argument("--out", type=Path, metavar="DIR", help="write figures, tables, pictures and networks there")
