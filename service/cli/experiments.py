"""The commands of experiments, which need no service: reproduce."""

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from neurove_service.cli.arguments import command, commit
from neurove_service.cli.bars import progress


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
        args.model,
        args.streets,
        args.primed or repriming.PRIMED,
        progress=lambda name: print(name, file=sys.stderr) if told else None,
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

    from neurove_core.experiments.sine import report

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

        runs: list[report.SineRun] = []
        files: dict[Path, None] = {}
        for run in report.reproduce(models, seeds, changes=dict(args.set), quick=args.quick, progress=progress):
            runs.append(run)
            if args.out:
                files |= dict.fromkeys(report.save_run(runs, args.out, command=typed, commit=made_by))
    if args.out:
        files |= dict.fromkeys(report.save(runs, args.out))
    figures = [run.figures for run in runs]
    tables = report.tables(figures)
    print(json.dumps(figures) if args.json else "\n".join(report.markdown(tables[n], n) for n in tables))
    for file in files:
        print(f"wrote {file}", file=sys.stderr)
    return 0


def reproduce_real(args: argparse.Namespace) -> int:
    """What a model makes of real events that nobody tuned it on."""
    from neurove_core.experiments import real

    rows, about = _real_rows(args.model, args.recordings, args.out)
    print(json.dumps(about | {"checks": rows}) if args.json else real.markdown(rows, real.title(about)), end="")
    return 0


def _real_rows(model: str, recordings: Path, out: Path | None) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """All checks of a model, told one by one as they are made, and how they were made; written into `out`."""
    import torch

    from neurove_core import models
    from neurove_core.estimator import Estimator
    from neurove_core.experiments import real

    torch.set_num_threads(1)
    estimator = Estimator(models.find(model))
    rows = []
    for row in real.run(estimator, recordings):
        rows.append(row)
        print(f"{row['recording']}: {row['what']}", file=sys.stderr)
    about = {"model": estimator.bundle.info.model_dump()} | _made_by()
    for file in real.save(rows, about, out) if out else []:
        print(f"wrote {file}", file=sys.stderr)
    return rows, about


def reproduce_velocity(args: argparse.Namespace) -> int:
    """Tables III and IV: velocity by NeuroVE, NeuroVE w/o, its equal in ANN, SNN-ANG, and what learns nothing."""
    import torch

    from neurove_core.experiments.velocity import figures, report, run

    torch.set_num_threads(args.threads)
    config = run.base_config(args.config, args.steps, quick=args.quick)
    seeds = range(args.seed, args.seed + args.seeds)
    experiment = run.Experiment(config, tuple(args.methods.split(",")), seeds, args.recordings, args.quick)
    out: Path = args.out or Path("runs") / config.name
    folder: Path = args.data or out / "data"
    found = []
    with progress() as show:
        for one in run.reproduce(experiment, folder, out, show, args.workers):
            found.append(one)
            show(
                "judged",
                len(found),
                len(experiment.methods) * len(seeds),
                f"{one.row['method']} seed {one.row['seed']}",
            )
    told = _made_by() | run.results(experiment, folder, found)
    print(json.dumps(told) if args.json else report.markdown(told), end="")
    tracks = {one.row["method"]: one.tracks for one in reversed(found)}
    for file in [*report.save(told, out), *figures.save(told, tracks, out)]:
        print(f"wrote {file}", file=sys.stderr)
    if args.recordings:
        _real_rows("default", args.recordings, out)
    return 0


def _made_by() -> dict[str, str]:
    """The command as it was typed, and the code's commit."""
    return {"command": shlex.join(["neurove", *sys.argv[1:]]), "commit": commit()}


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: whole numbers joined by commas") from None


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
    repriming.add_argument(
        "--primed", type=_numbers, metavar="N,...", help="numbers of windows to replay; default 8,16,32,64"
    )
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
    real = command(parser, "real", reproduce_real)
    real.add_argument("model", nargs="?", default="default", metavar="BUNDLE", help="a bundle's file; `default`")
    real.add_argument("--recordings", type=Path, required=True, metavar="DIR", help="where the recordings lie")
    real.add_argument("--out", type=Path, metavar="DIR", help="write real.json and real.md there")
    _add_velocity(parser)


def _add_velocity(parser: Any) -> None:
    velocity = command(parser, "velocity", reproduce_velocity)
    velocity.add_argument("--methods", default="nve,nve-wo,ann,snn-ang", help="which to train, joined by commas")
    velocity.add_argument("--seed", type=int, default=0, help="the first seed; default 0")
    velocity.add_argument("--seeds", type=int, default=1, metavar="N", help="so many, one after the other; default 1")
    velocity.add_argument("--config", metavar="CONFIG", help="another recipe, a TOML file or a name")
    velocity.add_argument("--steps", type=int, metavar="N", help="so many updates, not those of the configuration")
    velocity.add_argument(
        "--data", type=Path, metavar="DIR", help="simulated sequences are kept there; default OUT/data"
    )
    velocity.add_argument("--recordings", type=Path, metavar="DIR", help="where MVSEC's poses lie, for Table III")
    velocity.add_argument("--out", type=Path, metavar="DIR", help="methods, tables, figures; default runs/velocity")
    velocity.add_argument("--workers", type=int, default=1, metavar="N", help="processes that simulate; default 1")
    velocity.add_argument("--threads", type=int, default=1, metavar="N", help="threads that learn; default 1")
    velocity.add_argument("--quick", action="store_true", help="tiny networks and sequences, to see that it runs")
