"""The commands that make and evaluate models: train, calibrate, evaluate."""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurove_protocol.errors import EXIT_PARTIAL, InvalidField
from neurove_service.cli.arguments import (
    add_force,
    add_lens_flags,
    add_recording_flags,
    add_refine_flag,
    check_folder,
    command,
    count,
    refuse_existing,
    sigma,
    tell_faults,
)
from neurove_service.cli.bars import event_count, progress
from neurove_service.cli.devices import CALIBRATES, add_device_flag, device_from, refuse_pool, runner_on
from neurove_service.cli.extras import one_thread
from neurove_service.cli.pools import add_pool_flags, pool_of
from neurove_service.lifecycle import end_with_parent

if TYPE_CHECKING:
    from neurove_core.estimator import Estimator
    from neurove_core.evaluation.estimates import Estimates
    from neurove_core.geometry.motion import Twists
    from neurove_core.io import Recording
    from neurove_core.tasks import FailedTasks, Pool
    from neurove_core.training.config import TrainingConfig

_CALIBRATION_SEQUENCES = 96


def train(args: argparse.Namespace) -> int:
    """Train a model on simulated sequences and recordings."""
    import torch

    from neurove_core import models
    from neurove_core.models import bundle
    from neurove_core.training import config as configs
    from neurove_core.training import joining, loop, pipeline

    torch.set_num_threads(args.threads)
    config = configs.load(args.config)
    out: Path = args.out or Path("runs") / config.name
    started = joining.launched()  # by torchrun, which starts the same command again after a failure
    if not args.resume:
        results = (out / f"{config.name}{bundle.SUFFIX}", *([] if started else [out / loop.CHECKPOINT]))
        if not (started and (out / loop.CHECKPOINT).exists()):
            _refuse_run(out, results, force=args.force)
    if args.devices > 1 and not started:
        return _launch(args, config, out)
    if started:
        end_with_parent()
    start = models.find(args.start) if args.start else None
    with joining.joined(args.device) as ranks, pool_of(args) as pool, progress(shown=ranks.leads) as show:
        if args.devices not in (1, ranks.count):
            bound = f"the launcher started {ranks.count} processes; leave the flag out, or give that number"
            raise InvalidField("training", "--devices", args.devices, bound)
        path = pipeline.train(
            config,
            out,
            data=args.data,
            start=start,
            resume=args.resume or started,
            ranks=ranks,
            pool=pool,
            calibration_sequences=args.calibration_sequences,
            on_progress=show,
        )
    if not ranks.first:
        return 0
    size, told = path.stat().st_size, json.loads((out / loop.RUN_JSON).read_bytes())["validated"]
    summary = {"bundle": str(path), "bytes": size, "run": str(out / loop.RUN_JSON), "validated": told}
    print(json.dumps(summary) if args.json else "\n".join([*told, f"wrote {path}, {size:,} bytes"]))
    return 0


def _launch(args: argparse.Namespace, config: "TrainingConfig", out: Path) -> int:
    """Start this command once for each device, through the launcher of torch; errors of the arguments come first."""
    from neurove_core import models
    from neurove_core.training import launch, loop, pipeline
    from neurove_core.training.ranks import device_of

    device_of(args.device, devices=args.devices)
    pipeline.check(
        config,
        out,
        models.find(args.start) if args.start else None,
        resume=args.resume,
        devices=args.devices,
        calibration_sequences=args.calibration_sequences,
    )
    if not args.resume:  # the processes continue from a checkpoint, if there is one
        (out / loop.CHECKPOINT).unlink(missing_ok=True)
    return launch.launch(args.devices, "neurove_service.cli", args.words)


def _refuse_run(out: Path, results: tuple[Path, ...], *, force: bool) -> None:
    """Refuse a folder that holds a run: its checkpoint or its model would be replaced."""
    if not force and any(path.exists() for path in results):
        bound = "the folder holds a run; --resume continues it, --force replaces it"
        raise InvalidField("training", "--out", str(out), bound)


def calibrate(args: argparse.Namespace) -> int:
    """Fit the uncertainty of a trained model on new simulated sequences; its estimates stay the same."""
    import torch

    from neurove_core import models
    from neurove_core.models import bundle
    from neurove_core.models.bounds import Bounds
    from neurove_core.training import config as configs
    from neurove_core.training import pipeline

    torch.set_num_threads(1)
    config, model = configs.load(args.config), models.find(args.model)
    bounds = Bounds(args.uncertain_m_s, args.uncertain_rad_s)
    out: Path = args.out or Path(f"{model.name}{bundle.SUFFIX}")
    refuse_existing("calibrate", "--out", out, None, force=args.force)
    device = device_from(args, "calibrate")
    data: Path = args.data or Path("runs") / config.name / "data"
    with pool_of(args) as pool, progress() as show:
        report = pipeline.calibrate(model, config, data, out, args.calibration_sequences, pool, show, bounds, device)
    if args.json:
        print(json.dumps({"bundle": str(out), **report}))
        return 0
    print(f"wrote {out}")
    print(f"share of the truth in the {report['level']:.0%} interval, for sequences that the fit did not use:")
    for name, axes in report["groups"].items():
        print(f"{name:26}", *(f"{axis} {row[str(report['level'])]:.2f}" for axis, row in axes.items()))
    return 0


def evaluate(args: argparse.Namespace) -> int:
    """Compare a model's estimates with the truth: RMSE and RE as in the paper, per axis and per recording."""
    from neurove_core import models
    from neurove_core.estimator import Estimator
    from neurove_core.evaluation import evaluate as evaluation
    from neurove_core.geometry import motion
    from neurove_core.io.calibration import with_lens
    from neurove_core.io.formats.pose_files import read_truth
    from neurove_core.sources import open_source

    one_thread()
    refuse_pool(args, "evaluate")
    model = models.find(args.model)
    estimator = Estimator(model, runner_on(args, model, "evaluate"), refine=args.refine == "auto")
    given = motion.twists(read_truth(args.truth)) if args.truth else None
    if args.plot:
        check_folder("evaluate", "--plot", args.plot)
    opened = [(source, open_source(source, args.sensor, args.topic, args.time_unit)) for source in args.recordings]
    sources = [(source, with_lens(one, args.calibration, args.height)) for source, one in opened]
    truths = [given or _truth(source, recording) for source, recording in sources]
    with pool_of(args) as pool:
        estimates, failed = _estimates(args, estimator, [one for _, one in sources], pool)
    if failed and not estimates:
        raise failed
    evaluated = [evaluation.evaluate(found, truths[number]) for number, found in sorted(estimates.items())]
    report = {"model": estimator.bundle.info.model_dump(), **evaluation.report(evaluated)}
    print(json.dumps(report) if args.json else "\n".join(_table(report)))
    if args.plot:
        from neurove_core.evaluation.plots import plot, plot_reliability

        files = [file for one in evaluated for file in plot(one, args.plot)]
        if report["uncertainty"]:
            files += plot_reliability(report["uncertainty"], args.plot)
        for file in files:
            print(f"wrote {file}", file=sys.stderr)
    if failed:
        print(f"neurove: {failed.message}; the figures are those of the others", file=sys.stderr)
    return EXIT_PARTIAL if failed else 0


def _estimates(
    args: argparse.Namespace, estimator: "Estimator", recordings: "list[Recording]", pool: "Pool"
) -> "tuple[dict[int, Estimates], FailedTasks | None]":
    """The estimates for each recording, by its number, and the error that names the recordings that failed."""
    from neurove_core.evaluation.estimates import estimate_recording, estimate_recordings
    from neurove_core.tasks import HERE, FailedTasks

    found: dict[int, Estimates] = {}
    if args.device is not None:
        estimator.warm_up()
        with event_count(f"{len(recordings)} recordings on {args.device}") as show:
            together = estimate_recordings(estimator, recordings, show, inertial=not args.no_imu)
        for recording in recordings:
            tell_faults(recording)
        return dict(enumerate(together)), None
    if pool is HERE:
        estimator.warm_up()
        for number, recording in enumerate(recordings):
            with event_count(recording.name) as show:
                found[number] = estimate_recording(estimator, recording, on_events=show, inertial=not args.no_imu)
            tell_faults(recording)
        return found, None
    from neurove_core.evaluation.jobs import EvaluationJob, estimates_of

    model, refine = estimator.bundle.to_bytes(), args.refine == "auto"
    how: tuple[Any, ...] = (args.sensor, args.topic, args.time_unit, args.calibration, args.height, not args.no_imu)
    names = {f"{number + 1} {source}": number for number, source in enumerate(args.recordings)}
    jobs = {name: EvaluationJob(model, refine, args.recordings[number], *how) for name, number in names.items()}
    with progress() as show_task:
        try:
            for name, (estimates, faults) in pool.run(estimates_of, jobs):
                found[names[name]] = estimates
                show_task("evaluated", len(found), len(jobs), name)
                for fault in faults:
                    print(f"neurove: {fault}", file=sys.stderr)
        except FailedTasks as failed:
            return found, failed
    return found, None


def _truth(source: str, recording: "Recording") -> "Twists":
    from neurove_core.evaluation.evaluate import NoTruth

    truth = None if recording.endless else recording.twists()
    if truth is None:
        why = "it never ends: add ?seconds=S" if recording.endless else "it holds no truth: give --truth FILE"
        raise NoTruth(f"{source}: {why}", source=source)
    return truth


def _table(report: dict[str, Any]) -> Iterator[str]:
    """The lines of the report for people."""
    yield f"{report['model']['name']} ({report['model']['digest'][:12]}), {report['windows']} windows"
    yield f"{'':24} {'v_l RE':>7} {'RMSE m/s':>9} {'v_a RE':>7} {'RMSE deg/s':>10}  R2 v_l, v_a"
    rows = [(report["model"]["name"], report), ("zero velocity", report["zero"]), ("mean of the truth", report["mean"])]
    each = [(one["name"], one) for one in report["recordings"]] if len(report["recordings"]) > 1 else []
    for name, row in [*rows, *each]:
        errors = f"{_number(row['re_v_l'], 7)} {row['rmse_v_l_m_s']:9.3f} {_number(row['re_v_a'], 7)}"
        explained = ", ".join("constant truth" if row[r2] is None else f"{row[r2]:.3f}" for r2 in ("r2_v_l", "r2_v_a"))
        yield f"{name[:24]:24} {errors} {row['rmse_v_a_deg_s']:10.2f}  {explained}"
    yield report["judgement"]
    yield ""
    floors, without = report["re_floors"], (report["re_v_l_unfloored"], report["re_v_a_unfloored"])
    yield f"RE counts truths above {floors['v_l_m_s']} m/s and {floors['v_a_rad_s']} rad/s"
    yield f"without these floors it is {_number(without[0], 0)} and {_number(without[1], 0)}"
    yield ""
    yield f"{'axis':6} {'RMSE':>8} {'median':>8} {'bias':>8} {'spread':>8} {'correlation':>11}"
    for axis, row in report["per_axis"].items():
        unit = "deg_s" if axis[0] == "w" else "m_s"
        numbers = [_number(row[f"{name}_{unit}"], 8) for name in ("rmse", "median_error", "bias", "spread")]
        yield f"{axis:6} {' '.join(numbers)} {_number(row['correlation'], 11)}  {unit.replace('_s', '/s')}"
    yield from _uncertainty_table(report["uncertainty"])
    latency = report["latency_ms"]
    rate = report["firing_rate"]
    fires = "no spikes" if rate is None else f"firing rate {rate:.3f}"
    yield f"{fires}; a window takes {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms"
    yield "angular part: " + ", ".join(f"{name} {share:.0%}" for name, share in report["source_share"].items())
    if not report["scaled"]:
        yield "linear part: assumes a camera 1 m above the ground, because the recording does not give its height"


def _uncertainty_table(report: dict[str, Any] | None) -> Iterator[str]:
    if report is None:
        yield "the model has no uncertainty: `neurove calibrate` adds it"
        return
    yield ""
    inside = f"in {report['level']:.0%}"
    yield f"{'axis':6} {'sigma':>8} {inside:>8}  median sigma; share of the truth in its interval"
    for axis, row in report["per_axis"].items():
        unit = "deg_s" if axis[0] == "w" else "m_s"
        yield f"{axis:6} {row[f'median_sigma_{unit}']:8.3f} {row['coverage']:8.1%}   {unit.replace('_s', '/s')}"
    yield f"{report['uncertain_share']:.1%} of the estimates are flagged uncertain"


def _number(value: float | None, width: int) -> str:
    return f"{'-' if value is None else format(value, '.3f'):>{width}}"


def add_train(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove train`."""
    command(parser, train)
    about = "TOML file, or the name of a configuration: `default` is that of the built-in model"
    parser.add_argument("config", metavar="CONFIG", help=about)
    about = "folder for bundle, checkpoint, run.json and curve; default runs/NAME"
    parser.add_argument("--out", type=Path, metavar="DIR", help=about)
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder for the sequences; default OUT/data")
    parser.add_argument("--resume", action="store_true", help="continue from the checkpoint in OUT, if it exists")
    add_force(parser, "a run in OUT")
    about = "initialise weights from BUNDLE, a file or `default`, instead of randomly"
    parser.add_argument("--start", metavar="BUNDLE", help=about)
    about = "number of processes of this machine that share each batch, one GPU each if there are any; default 1"
    parser.add_argument("--devices", type=count, default=1, metavar="N", help=about)
    about = "auto, cpu or cuda; default auto: GPUs if there are any"
    parser.add_argument("--device", default="auto", metavar="KIND", help=about)
    add_pool_flags(parser, "simulate")
    about = "threads of each device's process; default 1"
    parser.add_argument("--threads", type=count, default=1, metavar="N", help=about)
    _add_calibration(parser, "; 0: no uncertainty")


def add_calibrate(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove calibrate`."""
    command(parser, calibrate)
    parser.add_argument("model", metavar="BUNDLE", help="file of a bundle, or `default`")
    about = "configuration that trained the model; default `default`"
    parser.add_argument("--config", default="default", metavar="CONFIG", help=about)
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder for the sequences; default runs/CONFIG/data")
    _add_calibration(parser, "")
    add_pool_flags(parser, "simulate")
    add_device_flag(parser, CALIBRATES)
    parser.add_argument("--out", type=Path, metavar="FILE", help="bundle to write; default NAME.safetensors")
    add_force(parser, "FILE")
    about = "estimates with a smaller linear sigma are never `uncertain` [m/s]; default: the node decides"
    parser.add_argument("--uncertain-m-s", type=sigma, metavar="S", help=about)
    about = "the same for the angular sigma [rad/s]"
    parser.add_argument("--uncertain-rad-s", type=sigma, metavar="S", help=about)


def add_evaluate(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove evaluate`."""
    command(parser, evaluate)
    parser.add_argument("model", metavar="BUNDLE", help="file of a bundle, `default` or `untrained`")
    about = "recordings with truth, such as sim://street?seconds=8"
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help=about)
    about = "poses of the camera, on the recording's clock; default: the truth in the recording"
    parser.add_argument("--truth", type=Path, metavar="FILE", help=about)
    add_recording_flags(parser)
    add_lens_flags(parser)
    add_refine_flag(parser)
    parser.add_argument("--no-imu", action="store_true", help="use the events alone, not the inertial samples")
    parser.add_argument("--plot", type=Path, metavar="DIR", help="draw truth and estimate over time into this folder")
    add_device_flag(parser)
    add_pool_flags(parser, "run the model on one recording each")


def _add_calibration(parser: argparse.ArgumentParser, none: str) -> None:
    about = f"number of simulated sequences to fit the uncertainty on; default {_CALIBRATION_SEQUENCES}{none}"
    parser.add_argument("--calibration-sequences", type=int, default=_CALIBRATION_SEQUENCES, metavar="N", help=about)
