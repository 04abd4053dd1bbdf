"""The commands that make models and judge them: train, evaluate."""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from neurove_core.geometry import motion
from neurove_service.cli.arguments import command, sensor_size
from neurove_service.cli.bars import progress

_CALIBRATION_SEQUENCES = 96


def train(args: argparse.Namespace) -> int:
    """Train a model on simulated sequences and recordings, from a configuration and its seed."""
    import torch

    from neurove_core import models
    from neurove_core.training import config as configs
    from neurove_core.training import loop, pipeline

    torch.set_num_threads(args.threads)
    config = configs.load(args.config)
    out: Path = args.out or Path("runs") / config.name
    with progress() as show:
        path = pipeline.train(
            config,
            out,
            data=args.data,
            start=models.find(args.start) if args.start else None,
            resume=args.resume,
            devices=args.devices,
            device=args.device,
            workers=args.workers,
            calibration_sequences=args.calibration,
            on_progress=show,
        )
    told = {"bundle": str(path), "bytes": path.stat().st_size, "run": str(out / loop.RUN_JSON)}
    print(json.dumps(told) if args.json else f"wrote {path}, {told['bytes']:,} bytes")
    return 0


def calibrate(args: argparse.Namespace) -> int:
    """Give a trained model its uncertainty, fitted on simulated sequences that it never saw; its answers stay."""
    import torch

    from neurove_core import models
    from neurove_core.models import bundle
    from neurove_core.training import config as configs
    from neurove_core.training import pipeline

    torch.set_num_threads(1)
    config, model = configs.load(args.config), models.find(args.model)
    out: Path = args.out or Path(f"{model.name}{bundle.SUFFIX}")
    data: Path = args.data or Path("runs") / config.name / "data"
    with progress() as show:
        report = pipeline.calibrate(model, config, data, out, args.sequences, args.workers, show)
    if args.json:
        print(json.dumps({"bundle": str(out), **report}))
        return 0
    print(f"wrote {out}")
    print(f"share of the truth in the {report['level']:.0%} interval, of sequences that were not used to fit it:")
    for name, axes in report["groups"].items():
        print(f"{name:26}", *(f"{axis} {row[str(report['level'])]:.2f}" for axis, row in axes.items()))
    return 0


def evaluate(args: argparse.Namespace) -> int:
    """How far a model's estimates lie from the truth: RMSE and RE as in the paper, per axis and per group."""
    import torch

    from neurove_core import models
    from neurove_core.estimator import Estimator
    from neurove_core.evaluation import evaluate as evaluation
    from neurove_core.io import open_source, read_poses

    torch.set_num_threads(1)
    estimator = Estimator(models.find(args.model))
    estimator.warm_up()
    given = motion.twists(read_poses(args.truth)) if args.truth else None
    judged = []
    for source in args.recordings:
        recording = open_source(source, args.sensor, args.topic)
        truth = given or (None if recording.endless else recording.twists())
        if truth is None:
            why = "it never ends: say how many seconds" if recording.endless else "it holds no truth: give --truth FILE"
            raise evaluation.NoTruth(f"{source}: {why}", source=source)
        judged.append(evaluation.evaluate(evaluation.estimate_recording(estimator, recording), truth))
    told = {"model": estimator.bundle.info.model_dump(), **evaluation.report(judged)}
    print(json.dumps(told) if args.json else "\n".join(_table(told)))
    if args.plot:
        from neurove_core.evaluation.plots import plot, plot_reliability

        files = [file for one in judged for file in plot(one, args.plot)]
        if told["uncertainty"]:
            files += plot_reliability(told["uncertainty"], args.plot)
        for file in files:
            print(f"wrote {file}", file=sys.stderr)
    return 0


def _table(told: dict[str, Any]) -> Iterator[str]:
    """The report for people."""
    yield f"{told['model']['name']} ({told['model']['digest'][:12]}), {told['windows']} windows"
    yield f"{'':24} {'v_l RE':>7} {'RMSE m/s':>9} {'v_a RE':>7} {'RMSE deg/s':>10}  R2 v_l, v_a"
    rows = [(told["model"]["name"], told), ("zero velocity", told["zero"]), ("mean of the truth", told["mean"])]
    each = [(one["name"], one) for one in told["recordings"]] if len(told["recordings"]) > 1 else []
    for name, row in [*rows, *each]:
        errors = f"{_number(row['re_v_l'], 7)} {row['rmse_v_l_m_s']:9.3f} {_number(row['re_v_a'], 7)}"
        explained = f"{_number(row['r2_v_l'], 6)} {_number(row['r2_v_a'], 6)}"
        yield f"{name[:24]:24} {errors} {row['rmse_v_a_deg_s']:10.2f}  {explained}"
    floors, without = told["re_floors"], (told["re_v_l_unfloored"], told["re_v_a_unfloored"])
    yield f"RE counts truths above {floors['v_l_m_s']} m/s and {floors['v_a_rad_s']} rad/s"
    yield f"without these floors it is {_number(without[0], 0)} and {_number(without[1], 0)}"
    yield ""
    yield f"{'axis':6} {'RMSE':>8} {'median':>8} {'bias':>8} {'spread':>8} {'correlation':>11}"
    for axis, row in told["per_axis"].items():
        unit = "deg_s" if axis[0] == "w" else "m_s"
        numbers = [_number(row[f"{name}_{unit}"], 8) for name in ("rmse", "median_error", "bias", "spread")]
        yield f"{axis:6} {' '.join(numbers)} {_number(row['correlation'], 11)}  {unit.replace('_s', '/s')}"
    yield from _uncertainty_table(told["uncertainty"])
    latency = told["latency_ms"]
    rate = told["firing_rate"]
    fires = "no spikes" if rate is None else f"firing rate {rate:.3f}"
    yield f"{fires}; a window takes {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms"
    if not told["scaled"]:
        yield "linear part: for a camera 1 m above the ground, because the recording does not say how high it is"


def _uncertainty_table(told: dict[str, Any] | None) -> Iterator[str]:
    if told is None:
        yield "the model has no measure of its errors: neurove calibrate gives it one"
        return
    yield ""
    inside = f"in {told['level']:.0%}"
    yield f"{'axis':6} {'sigma':>8} {inside:>8}  median sigma; share of the truth in its interval"
    for axis, row in told["per_axis"].items():
        name, unit = ("median_sigma_rad_s", "rad/s") if axis[0] == "w" else ("median_sigma_m_s", "m/s")
        yield f"{axis:6} {row[name]:8.3f} {row['coverage']:8.1%}   {unit}"
    yield f"{told['uncertain_share']:.1%} of the estimates are flagged uncertain"


def _number(value: float | None, width: int) -> str:
    return f"{'-' if value is None else format(value, '.3f'):>{width}}"


def add(commands: Any) -> None:
    """Add these commands to the parser."""
    parser = command(commands, "train", train)
    parser.add_argument("config", metavar="CONFIG", help="a TOML file, or `default`: that of the built-in model")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="bundle, checkpoint, run.json, curve; default runs/NAME"
    )
    parser.add_argument("--data", type=Path, metavar="DIR", help="sequences are kept there; default OUT/data")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in OUT, if there is one")
    parser.add_argument("--start", metavar="BUNDLE", help="begin from this model, a file or `default`, not from chance")
    parser.add_argument("--devices", type=int, default=1, metavar="N", help="share each batch over so many; default 1")
    parser.add_argument("--device", default="auto", metavar="KIND", help="auto, cpu or cuda; default auto: GPUs if any")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes that simulate; default 1")
    parser.add_argument(
        "--threads", type=int, default=1, metavar="N", help="threads of each device's process; default 1"
    )
    parser.add_argument(
        "--calibration",
        type=int,
        default=_CALIBRATION_SEQUENCES,
        metavar="N",
        help="sequences that a NeuroVE's uncertainty is fitted on at the end; 0: none; default %(default)s",
    )
    parser = command(commands, "calibrate", calibrate)
    parser.add_argument("model", metavar="BUNDLE", help="a bundle's file, or `default`")
    parser.add_argument(
        "--config", default="default", metavar="CONFIG", help="that it was trained by; default `default`"
    )
    parser.add_argument("--data", type=Path, metavar="DIR", help="sequences are kept there; default runs/CONFIG/data")
    parser.add_argument(
        "--sequences",
        type=int,
        default=_CALIBRATION_SEQUENCES,
        metavar="N",
        help="how many are simulated; default %(default)s",
    )
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes that simulate; default 1")
    parser.add_argument("--out", type=Path, metavar="FILE", help="default NAME.safetensors")
    parser = command(commands, "evaluate", evaluate)
    parser.add_argument("model", metavar="BUNDLE", help="a bundle's file, `default` or `untrained`")
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help="with truth, such as sim://street?seconds=8")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="poses of the camera, on the recording's clock")
    parser.add_argument("--sensor", type=sensor_size, metavar="WxH", help="sensor size, where the recording lacks it")
    parser.add_argument("--topic", metavar="T", help="which of several event streams, where the recording has names")
    parser.add_argument("--plot", type=Path, metavar="DIR", help="write truth and estimate over time there")
