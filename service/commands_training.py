"""The commands that make models and judge them: train, evaluate."""

import argparse
import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from service.arguments import command


def train(args: argparse.Namespace) -> int:
    """Train a model on simulated sequences, from a configuration and its seed."""
    import torch

    from neurove_core.training import config as configs
    from neurove_core.training import data, loop

    torch.set_num_threads(args.threads)
    config = configs.load(args.config)
    out: Path = args.out or Path("runs") / config.name
    folder: Path = args.data or out / "data"
    with _progress() as show:
        cache = data.Cache(folder, config)
        wanted = config.data.sequences
        for done, name in enumerate(cache.fill(args.workers), wanted - len(cache.missing()) + 1):
            show("simulated", done, wanted, name)

        def learned(at: loop.Progress) -> None:
            errors = f"{at.linear_m_s:.3f} m/s {at.angular_rad_s:.4f} rad/s"
            show("learned", at.step, at.steps, errors)

        path = loop.train(config, out, folder, resume=args.resume, on_progress=learned)
    told = {"bundle": str(path), "bytes": path.stat().st_size, "run": str(out / loop.RUN_JSON)}
    print(json.dumps(told) if args.json else f"wrote {path}, {told['bytes']:,} bytes")
    return 0


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[str, int, int, str], None]]:
    """Shows how far each task is: bars on a terminal, else a line now and then."""
    if not sys.stderr.isatty():
        yield _say
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), TextColumn("{task.fields[about]}"))
    with Progress(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[str, Any] = {}

        def show(what: str, done: int, of: int, about: str) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=of, about="")
            bars.update(tasks[what], completed=done, about=about)

        yield show


def _say(what: str, done: int, of: int, about: str) -> None:
    if what != "learned" or done % 100 < 4 or done == of:
        print(f"{what} {done}/{of}: {about}", file=sys.stderr, flush=True)


def add(commands: Any) -> None:
    """Add these commands to the parser."""
    parser = command(commands, "train", train)
    parser.add_argument("config", metavar="CONFIG", help="a TOML file, or `default`: that of the built-in model")
    parser.add_argument("--out", type=Path, metavar="DIR", help="checkpoint, run.json and bundle; default runs/NAME")
    parser.add_argument("--data", type=Path, metavar="DIR", help="simulated sequences are kept there; default OUT/data")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in OUT, if there is one")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes that simulate; default 1")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="threads that learn; default 1")
