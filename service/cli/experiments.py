"""The command reproduce, which repeats experiments and needs no service."""

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from neurove_protocol.errors import EXIT_FAILURE, InvalidField
from neurove_service.cli.arguments import add_refine_flag, check_folder, commit, count, seed, subcommand
from neurove_service.cli.bars import progress
from neurove_service.cli.devices import TRAINS, add_device_flag, device_from, runner_on
from neurove_service.cli.parser import Parser
from neurove_service.cli.pools import add_pool_flags, pool_of


def reproduce_firing(args: argparse.Namespace) -> int:
    """Compare how often ALIF, LIF and LTC fire under one random current."""
    from neurove_core.experiments import firing

    _check_out(args.out)
    report = firing.run(args.seed)
    files = firing.save(report, args.out) if args.out else []
    print(firing.to_json(report) if args.json else firing.to_markdown(report), end="")
    for file in files:
        print(f"wrote {file}", file=sys.stderr)
    return 0


def reproduce_repriming(args: argparse.Namespace) -> int:
    """Measure how settled the first estimates are after a model change."""
    from neurove_core.experiments import repriming

    _check_out(args.out)
    on_terminal = sys.stderr.isatty()
    report = repriming.run(
        args.model,
        args.streets,
        args.primed or repriming.PRIMED,
        progress=lambda name: print(name, file=sys.stderr) if on_terminal else None,
    )
    files = repriming.save(report, args.out) if args.out else []
    print(repriming.to_json(report) if args.json else repriming.to_markdown(report), end="")
    for file in files:
        print(f"wrote {file}", file=sys.stderr)
    return 0 if report.least_primed is not None else EXIT_FAILURE


def reproduce_sight(args: argparse.Namespace) -> int:
    """Shuffle, reverse and speed up the times of the events, to learn what a model sees."""
    import torch

    from neurove_core import models
    from neurove_core.estimator import Estimator
    from neurove_core.experiments import real, sight

    if args.recordings and not args.recordings.is_dir():
        raise InvalidField("reproduce", "--recordings", str(args.recordings), "it is not a folder")
    _check_out(args.out)
    torch.set_num_threads(1)
    estimator = Estimator(models.find(args.model), refine=args.refine == "auto")
    rows = []
    for row in sight.run(estimator, args.recordings, quick=args.quick):
        rows.append(row)
        print(row["case"], file=sys.stderr)
    about = {"model": estimator.bundle.info.model_dump()} | _made_by() | {"quick": args.quick}
    results = about | {"sentence": sight.sentence(rows), "cases": rows}
    print(json.dumps(results) + "\n" if args.json else sight.markdown(rows, real.title(about)), end="")
    for file in sight.save(rows, about, args.out) if args.out else []:
        print(f"wrote {file}", file=sys.stderr)
    return 0


def reproduce_sine(args: argparse.Namespace) -> int:
    """Repeat Tables I and II: regression and forecast of a sine by ASLSTM, ASLSTM-w/o, SLSTM and LTC."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from neurove_core.experiments.sine import report
    from neurove_service.cli.console import console

    _check_out(args.out)
    models, seeds = args.models.split(","), range(args.seed, args.seed + args.seeds)
    command_line, made_by = shlex.join(["neurove", *sys.argv[1:]]), commit()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    bars = Progress(*columns, console=console(stderr=True), disable=not sys.stderr.isatty())
    with pool_of(args) as pool, bars as bar:
        tasks: dict[tuple[str, int], Any] = {}

        def progress(model: str, seed: int, update: int, updates: int, mse: float) -> None:
            if (model, seed) not in tasks:
                tasks[model, seed] = bar.add_task("", total=updates)
            rmse = f"{model} seed {seed}: update {update}, RMSE {mse**0.5:.2e}"
            bar.update(tasks[model, seed], completed=update, description=rmse)

        runs: list[report.SineRun] = []
        files: dict[Path, None] = {}
        for run in report.reproduce(
            models, seeds, changes=dict(args.set), quick=args.quick, progress=progress, pool=pool
        ):
            runs.append(run)
            if args.out:
                files |= dict.fromkeys(report.save_run(runs, args.out, command=command_line, commit=made_by))
    if args.out:
        files |= dict.fromkeys(report.save(runs, args.out))
    figures = [run.figures for run in runs]
    tables = report.tables(figures)
    print(json.dumps(figures) if args.json else "\n".join(report.markdown(tables[n], n) for n in tables))
    for file in files:
        print(f"wrote {file}", file=sys.stderr)
    return 0


def reproduce_real(args: argparse.Namespace) -> int:
    """Check a model on real events that it was not tuned on."""
    from neurove_core.experiments import real

    _check_out(args.out)
    rows, about = _real_rows(args.model, args.recordings, args.out, refine=args.refine == "auto")
    print(json.dumps(about | {"checks": rows}) if args.json else real.markdown(rows, real.title(about)), end="")
    if any(row["skipped"] is None for row in rows):
        return 0
    why = "has none of the recordings that can be read" if args.recordings.is_dir() else "is not a folder"
    print(f"neurove: every check was skipped: {args.recordings} {why}", file=sys.stderr)
    return EXIT_FAILURE


def reproduce_motion(args: argparse.Namespace) -> int:
    """Evaluate a model on slow and fast drives, constant motion, rooms and real events, against what is asked of it."""
    import torch

    from neurove_core import models
    from neurove_core.estimator import Estimator
    from neurove_core.evaluation.estimates import AT_ONCE
    from neurove_core.experiments.motion import run, sets

    groups = args.sets.split(",") if args.sets else (*sets.GROUPS, sets.REAL)
    if args.model in (*sets.GROUPS, sets.REAL) and not Path(args.model).exists():
        meant = ",".join([*filter(None, groups if args.sets else ()), args.model])
        bound = f"{args.model} is the name of a set, not a model; sets are separated by commas: --sets {meant}"
        raise InvalidField("reproduce motion", "--sets", " ".join(filter(None, (args.sets, args.model))), bound)
    if args.recordings and not args.recordings.is_dir():
        raise InvalidField("reproduce", "--recordings", str(args.recordings), "it is not a folder")
    for folder in (args.out, args.data):
        _check_out(folder)
    torch.set_num_threads(1)
    model = models.find(args.model)
    estimator = Estimator(model, runner_on(args, model, "reproduce motion"), refine=args.refine == "auto")
    at_once = 1 if args.device is None else AT_ONCE
    with pool_of(args) as pool, progress() as show:
        found = run.run(
            estimator, groups, args.recordings, args.data, show, quick=args.quick, pool=pool, at_once=at_once
        )
    results = {"model": estimator.bundle.info.model_dump()} | _made_by() | {"quick": args.quick} | found
    print(json.dumps(results) + "\n" if args.json else run.markdown(results), end="")
    for file in run.save(results, args.out) if args.out else []:
        print(f"wrote {file}", file=sys.stderr)
    return 0


def _real_rows(
    model: str, recordings: Path, out: Path | None, *, refine: bool = True
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Run all checks of a model, print the name of each, and write them into `out`.

    Returns:
        the checks, and the model, command and commit that made them.
    """
    import torch

    from neurove_core import models
    from neurove_core.estimator import Estimator
    from neurove_core.experiments import real

    torch.set_num_threads(1)
    estimator = Estimator(models.find(model), refine=refine)
    rows = []
    for row in real.run(estimator, recordings):
        rows.append(row)
        print(f"{row['recording']}: {row['what']}", file=sys.stderr)
    about = {"model": estimator.bundle.info.model_dump()} | _made_by()
    for file in real.save(rows, about, out) if out else []:
        print(f"wrote {file}", file=sys.stderr)
    return rows, about


def reproduce_velocity(args: argparse.Namespace) -> int:
    """Repeat Tables III and IV: velocity by NeuroVE, NeuroVE w/o, ANN, SNN-ANG and baselines that do not learn."""
    import torch

    from neurove_core.experiments.velocity import figures, report, run

    if args.recordings and not args.recordings.is_dir():
        raise InvalidField("reproduce", "--recordings", str(args.recordings), "it is not a folder")
    torch.set_num_threads(args.threads)
    config = run.base_config(args.config, args.steps, quick=args.quick)
    seeds = range(args.seed, args.seed + args.seeds)
    device, methods = device_from(args, "reproduce velocity"), tuple(args.methods.split(","))
    experiment = run.Experiment(config, methods, seeds, args.recordings, args.quick, device)
    out: Path = args.out or Path("runs") / config.name
    folder: Path = args.data or out / "data"
    for path in (out, folder):
        _check_out(path)
    found = []
    with pool_of(args) as pool, progress() as show:
        for one in run.reproduce(experiment, folder, out, show, pool):
            found.append(one)
            show(
                "evaluated",
                len(found),
                len(experiment.methods) * len(seeds),
                f"{one.row['method']} seed {one.row['seed']}",
            )
    results = _made_by() | run.results(experiment, folder, found)
    print(json.dumps(results) if args.json else report.markdown(results), end="")
    tracks = {one.row["method"]: one.tracks for one in reversed(found)}
    for file in [*report.save(results, out), *figures.save(results, tracks, out)]:
        print(f"wrote {file}", file=sys.stderr)
    if args.recordings:
        _real_rows("default", args.recordings, out)
    return 0


def _check_out(folder: Path | None) -> None:
    """Refuse a folder that cannot be written, before the experiment begins."""
    if folder is not None:
        check_folder("reproduce", "--out", folder)


def _made_by() -> dict[str, str]:
    """The command line and the commit of the code."""
    return {"command": shlex.join(["neurove", *sys.argv[1:]]), "commit": commit()}


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: give whole numbers separated by commas") from None


def _assignment(text: str) -> tuple[str, str]:
    field, separator, value = text.partition("=")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r}: give FIELD=VALUE")
    return field, value


def add_reproduce(parser: Parser) -> None:
    """Add the commands of `neurove reproduce`."""
    commands = parser.add_commands()
    _add_firing(subcommand(commands, "firing", reproduce_firing))
    _add_motion(subcommand(commands, "motion", reproduce_motion))
    _add_repriming(subcommand(commands, "repriming", reproduce_repriming))
    _add_sight(subcommand(commands, "sight", reproduce_sight))
    _add_sine(subcommand(commands, "sine", reproduce_sine))
    _add_real(subcommand(commands, "real", reproduce_real))
    _add_velocity(subcommand(commands, "velocity", reproduce_velocity))


def _add_firing(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the first of ten runs; default 0")
    _add_out(parser, "folder for table and figure (PNG, SVG)")


def _add_motion(parser: argparse.ArgumentParser) -> None:
    about = "file of a bundle, or the name of a built-in model; default `default`"
    parser.add_argument("model", nargs="?", default="default", metavar="BUNDLE", help=about)
    about = "folder of real recordings and trajectories; without it their rows are skipped"
    parser.add_argument("--recordings", type=Path, metavar="DIR", help=about)
    about = "folder that keeps the simulated events, about 3 GB for all sets; default runs/motion"
    parser.add_argument("--data", type=Path, default=Path("runs/motion"), metavar="DIR", help=about)
    about = "sets to evaluate, separated by commas; default: all"
    parser.add_argument("--sets", metavar="SET,...", help=about)
    about = "one second of one recording per set through a tiny camera, to check that the command works"
    parser.add_argument("--quick", action="store_true", help=about)
    add_refine_flag(parser)
    add_device_flag(parser)
    add_pool_flags(parser, "simulate")
    _add_out(parser, "folder for motion.json and motion.md")


def _add_repriming(parser: argparse.ArgumentParser) -> None:
    about = "name of a built-in model, or file of a bundle; default `default`"
    parser.add_argument("--model", default="default", metavar="BUNDLE", help=about)
    parser.add_argument("--streets", type=count, default=6, metavar="N", help="number of held-out streets; default 6")
    about = "numbers of windows to replay; default 8,16,32,64"
    parser.add_argument("--primed", type=_numbers, metavar="N,...", help=about)
    _add_out(parser, "folder for table, figures and picture")


def _add_sight(parser: argparse.ArgumentParser) -> None:
    about = "file of a bundle, or the name of a built-in model; default `default`"
    parser.add_argument("model", nargs="?", default="default", metavar="BUNDLE", help=about)
    about = "folder of the real recordings; without it only simulated drives are used"
    parser.add_argument("--recordings", type=Path, metavar="DIR", help=about)
    about = "two short drives through a small camera: a minute less, and figures that vary more"
    parser.add_argument("--quick", action="store_true", help=about)
    add_refine_flag(parser)
    _add_out(parser, "folder for sight.json, sight.md and the figure (PNG, SVG)")


def _add_sine(parser: argparse.ArgumentParser) -> None:
    default = "aslstm,aslstm-spiking,aslstm-wo,slstm,ltc"
    about = f"models to train, separated by commas; default {default}"
    parser.add_argument("--models", default=default, metavar="MODEL,...", help=about)
    _add_seeds(parser)
    about = "change one field of the recipe; may be repeated"
    parser.add_argument("--set", type=_assignment, action="append", default=[], metavar="FIELD=VALUE", help=about)
    about = "a few updates, to check that the command works; its figures mean nothing"
    parser.add_argument("--quick", action="store_true", help=about)
    add_pool_flags(parser, "train one model from one seed each")
    _add_out(parser, "folder for figures, tables, pictures and networks")


def _add_real(parser: argparse.ArgumentParser) -> None:
    about = "file of a bundle, or the name of a built-in model; default `default`"
    parser.add_argument("model", nargs="?", default="default", metavar="BUNDLE", help=about)
    parser.add_argument("--recordings", type=Path, required=True, metavar="DIR", help="folder of the recordings")
    add_refine_flag(parser)
    _add_out(parser, "folder for real.json and real.md")


def _add_velocity(parser: argparse.ArgumentParser) -> None:
    default = "nve,nve-wo,ann,snn-ang"
    about = f"methods to train, separated by commas; default {default}"
    parser.add_argument("--methods", default=default, metavar="METHOD,...", help=about)
    _add_seeds(parser)
    about = "another recipe, a TOML file or a name; default: that of the experiment"
    parser.add_argument("--config", metavar="CONFIG", help=about)
    about = "number of updates; default: that of the configuration"
    parser.add_argument("--steps", type=count, metavar="N", help=about)
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder for the sequences; default OUT/data")
    about = "folder with MVSEC's poses, for Table III"
    parser.add_argument("--recordings", type=Path, metavar="DIR", help=about)
    _add_out(parser, "folder for methods, tables and figures; default runs/velocity")
    add_pool_flags(parser, "simulate")
    parser.add_argument("--threads", type=count, default=1, metavar="N", help="threads that train; default 1")
    add_device_flag(parser, TRAINS)
    about = "tiny networks and sequences, to check that the command works; its figures mean nothing"
    parser.add_argument("--quick", action="store_true", help=about)


def _add_seeds(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="first seed; default 0")
    parser.add_argument("--seeds", type=count, default=1, metavar="N", help="number of seeds; default 1")


def _add_out(parser: argparse.ArgumentParser, about: str) -> None:
    parser.add_argument("--out", type=Path, metavar="DIR", help=about)
