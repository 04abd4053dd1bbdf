"""The command that makes a model better on one robot: adapt."""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurove_protocol.errors import InvalidField
from neurove_service.cli.arguments import (
    add_force,
    add_lens_flags,
    check_folder,
    command,
    count,
    mounting_of,
    numbers,
    sensor_size,
)
from neurove_service.cli.bars import event_count, progress
from neurove_service.cli.devices import TRAINS, add_device_flag, device_from

if TYPE_CHECKING:
    from neurove_core.geometry.mounting import Mounting

NOT_BETTER = 1
"""Exit code if the adapted model is not better; nothing is written then without --accept-worse."""


def adapt(args: argparse.Namespace) -> int:
    """Make a model better on one robot, from its recorded drive with odometry."""
    import torch

    from neurove_core import models
    from neurove_core.adaptation import prepare, truth
    from neurove_core.adaptation.adapt import Recipe, configuration, least_windows
    from neurove_core.adaptation.adapt import adapt as run
    from neurove_core.estimator import Estimator
    from neurove_core.models import bundle

    torch.set_num_threads(1)
    prepare.check_output(args.out, force=args.force)
    check_folder("adapt", "--out", args.out.parent)
    folder: Path = args.work or Path("runs") / f"adapt-{args.out.stem}"
    check_folder("adapt", "--work", folder)
    if args.truth is not None and len(args.recordings) > 1:
        raise InvalidField(
            "adapt", "--truth", str(args.truth), "belongs to one recording; use --topic for several bags"
        )
    device = device_from(args, "adapt")
    given = prepare.Input(
        args.sensor, args.events_topic, args.time_unit, args.calibration, args.height, args.offset, args.held_out
    )
    asked = truth.Asked(args.truth, args.topic, args.truth_unit, args.frame, _mounting(args))
    for source in args.recordings:
        prepare.opened(source, given)  # all of them, before the first is read
    start = models.find(args.start)
    recipe = Recipe(
        updates=args.updates,
        learning_rate=args.learning_rate,
        simulated=args.simulated,
        calibration_sequences=args.calibration_sequences,
        workers=args.workers,
        seed=args.seed,
        device=device,
        config=args.config,
    )
    config = configuration(start, recipe, args.out.stem)
    estimator = Estimator(start)
    estimator.warm_up()
    prepared = []
    for source in args.recordings:
        with event_count(source) as show:
            prepared.append(prepare.prepare(source, given, asked, estimator, least_windows(config), show))
    notes = [note for one in prepared for note in one.notes]
    if not args.json:
        print("\n".join(notes), flush=True)
    with progress() as show_task:
        found = run(prepared, start, config, folder, recipe, show_task)
    written = found.better or args.accept_worse
    if written:
        bundle.save(found.bundle, args.out)
    report = {
        "better": found.better,
        "why": found.why,
        "written": str(args.out) if written else None,
        "before": found.before,
        "after": found.after,
        "notes": [*notes, *found.notes],
        "start": start.digest,
        "digest": found.bundle.digest,
    }
    print(json.dumps(report) if args.json else "\n".join([*found.notes, *_table(report)]))
    return 0 if written else NOT_BETTER


def _mounting(args: argparse.Namespace) -> "Mounting | None":
    from neurove_core.geometry.mounting import Mounting

    if args.extrinsics is not None:
        if args.mount is not None or args.position is not None:
            raise InvalidField(
                "adapt", "--extrinsics", str(args.extrinsics), "give it or --mount and --position, not both"
            )
        return mounting_of("adapt", args.extrinsics)
    if args.mount is None and args.position is None:
        return None
    roll, pitch, yaw = args.mount or (0.0, 0.0, 0.0)
    return Mounting.from_angles(roll, pitch, yaw, args.position or (0.0, 0.0, 0.0))


def _table(report: dict[str, Any]) -> Iterator[str]:
    """Before and after on the held-out pieces, for people."""
    before, after = report["before"], report["after"]
    yield ""
    yield f"{'held-out pieces':18} {'before':>9} {'after':>9} {'change':>8}"
    for part, unit, scale in (("v_l", "m/s", 1.0), ("v_a", "deg/s", float(np.degrees(1.0)))):
        yield _row(f"{part} RE", before[part]["re"], after[part]["re"])
        yield _row(f"{part} RMSE {unit}", _times(before[part]["rmse"], scale), _times(after[part]["rmse"], scale))
    yield ""
    yield f"{'axis':18} {'before':>9} {'after':>9} {'change':>8}  truth within the 90 % interval, before and after"
    for axis, one in before["axes"].items():
        other = after["axes"][axis]
        unit, scale = ("deg/s", float(np.degrees(1.0))) if axis[0] == "w" else ("m/s", 1.0)
        row = _row(f"{axis} RMSE {unit}", _times(one["rmse"], scale), _times(other["rmse"], scale))
        yield f"{row}  {_share(one['coverage'])} {_share(other['coverage'])}"
    yield ""
    yield report["why"]
    if report["written"]:
        yield f"wrote {report['written']}, {report['digest'][:12]}"
    else:
        yield "nothing is written; --accept-worse writes the bundle anyway"


def _row(name: str, before: float | None, after: float | None) -> str:
    if before is None or after is None:
        return f"{name:18} {'-':>9} {'-':>9} {'-':>8}"
    return f"{name:18} {before:9.3f} {after:9.3f} {after / max(before, 1e-9) - 1:+8.0%}"


def _times(value: float | None, scale: float) -> float | None:
    return None if value is None else value * scale


def _share(value: float | None) -> str:
    return "    -" if value is None else f"{value:5.0%}"


def _share_of(text: str) -> float:
    """A share between 0.05 and 0.5."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.05 <= value <= 0.5:
        raise argparse.ArgumentTypeError(f"{text!r}: give a share from 0.05 to 0.5")
    return value


def _rate(text: str) -> float:
    """A learning rate."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"{text!r}: give a number above 0, at most 1")
    return value


def _whole(text: str) -> int:
    """A whole number from 0 on."""
    return 0 if text == "0" else count(text)


def add_adapt(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove adapt`."""
    command(parser, adapt)
    parser.epilog = (
        "Exit codes: 0 the bundle is written; 1 the adapted model is not better on the held-out pieces, and nothing is "
        "written without --accept-worse; 2 wrong usage, such as a truth whose times do not overlap with the events."
    )
    about = "recordings of one robot with one camera, in any supported format"
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help=about)
    about = "bundle to write (.safetensors)"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=about)
    about = "poses as text (t x y z qx qy qz qw) or HDF5, wheel speed as CSV (t,v), or a bag"
    parser.add_argument("--truth", type=Path, metavar="FILE", help=about)
    about = "topic of the robot's motion: Odometry, PoseStamped, TwistStamped; default: the only one of the bag"
    parser.add_argument("--topic", metavar="T", help=about)
    parser.add_argument(
        "--truth-unit", choices=("s", "ms", "us", "ns"), metavar="U", help="unit of the times in a text file"
    )
    about = "whose motion the truth is: base or camera; default base for topics and wheel speed, camera for pose files"
    parser.add_argument("--frame", choices=("base", "camera"), metavar="F", help=about)
    about = "pose of the camera's optical frame in the base: 16 numbers of a matrix, or x y z qx qy qz qw"
    parser.add_argument("--extrinsics", type=Path, metavar="FILE", help=about)
    about = "angles of the camera: roll clockwise, pitch down, yaw left [deg]; default: level, looks forward"
    parser.add_argument("--mount", type=numbers, metavar="ROLL,PITCH,YAW", help=about)
    about = "position of the camera in the base: forward, left, up [m]; default 0,0,0"
    parser.add_argument("--position", type=numbers, metavar="X,Y,Z", help=about)
    about = "seconds to add to the times of the truth; default: found from motion that both show"
    parser.add_argument("--offset", type=float, metavar="S", help=about)
    parser.add_argument("--start", default="default", metavar="BUNDLE", help="model to begin from; default `default`")
    about = "share of each recording that is held out for the comparison; default 0.2"
    parser.add_argument("--held-out", type=_share_of, default=0.2, metavar="SHARE", help=about)
    about = "updates of the weights; default 600; 0: fit only a gain per axis, in seconds"
    parser.add_argument("--updates", type=_whole, default=600, metavar="N", help=about)
    about = "peak of the learning rate; default 1e-4"
    parser.add_argument("--learning-rate", type=_rate, default=1e-4, metavar="R", help=about)
    about = "training configuration that gives augmentations and simulated scenes; default `wider`"
    parser.add_argument("--config", default="wider", metavar="CONFIG", help=about)
    about = "simulated sequences that are mixed in, so that nothing is forgotten; default 16"
    parser.add_argument("--simulated", type=count, default=16, metavar="N", help=about)
    about = "simulated sequences to fit the uncertainty on; default 96; 0: none"
    parser.add_argument("--calibration-sequences", type=_whole, default=96, metavar="N", help=about)
    parser.add_argument("--seed", type=_whole, default=0, metavar="N", help="seed of all random draws; default 0")
    parser.add_argument("--workers", type=count, default=1, metavar="N", help="processes that simulate; default 1")
    add_device_flag(parser, TRAINS)
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="folder for sequences and checkpoint; default runs/adapt-NAME"
    )
    about = "write the bundle even if it is not better on the held-out pieces"
    parser.add_argument("--accept-worse", action="store_true", help=about)
    add_force(parser, "FILE")
    parser.add_argument("--sensor", type=sensor_size, metavar="WxH", help="sensor size, if the recording lacks it")
    parser.add_argument("--events-topic", metavar="T", help="event stream to read; default: the recording's first")
    about = "unit of the event times: s, ms, us or ns; default: that of the recording's layout"
    parser.add_argument("--time-unit", choices=("s", "ms", "us", "ns"), metavar="U", help=about)
    add_lens_flags(parser)
