"""The command warm-up: compile ahead the machine code that the other commands run."""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

from neurove_protocol.errors import InvalidField
from neurove_service.cli.arguments import command
from neurove_service.cli.bars import progress
from neurove_service.cli.extras import absent
from neurove_service.cli.processors import FILE, PROCESSORS, settings_for, write_settings

_SCENES: Final = ("street", "room", "wall")
"""Scenes of the simulator that together run all of its loops."""

_SLICES: Final = 3  # of a simulation; the first ones are empty


class _Step(NamedTuple):
    """One part of the work, by the name that the progress shows."""

    name: str
    run: Callable[[], None]


def warm_up(args: argparse.Namespace) -> int:
    """Compile ahead what serve, demo, drive and simulate run, and say where it is kept."""
    if args.cpu or args.out:
        return _elsewhere(args)
    from neurove_core.compiled import work
    from neurove_service import logs

    logs.configure("warning")
    began = time.monotonic()
    steps = list(_steps(args.model))
    with progress() as show:
        for done, step in enumerate(steps):
            show("compiling", done, len(steps), step.name)
            step.run()
        show("compiling", len(steps), len(steps), "done")
    found, took_s = work(), time.monotonic() - began
    caches = _roots(found.folders)
    if args.json:
        where = [str(one) for one in caches]
        print(
            json.dumps(
                {"compiled": found.compiled, "loaded": found.loaded, "seconds": round(took_s, 1), "cache": where}
            )
        )
        return 0
    said = f"compiled {found.compiled} functions" if found.compiled else "nothing to compile"
    print(f"{said}, {found.loaded} were in the cache, {took_s:.1f} s")
    print(f"cache: {', '.join(map(str, caches)) or 'none: set NUMBA_CACHE_DIR to a folder that can be written'}")
    return 0


def _elsewhere(args: argparse.Namespace) -> int:
    """Compile for a named processor, or into a folder, in a process that is set up so."""
    if args.out is None:
        raise InvalidField("warm-up", "--out", "", "a folder, because --cpu makes code that this machine does not use")
    settings = settings_for(args.cpu, args.out)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        written = write_settings(settings, args.out)
    except OSError as error:
        raise InvalidField("warm-up", "--out", str(args.out), f"a folder to write; {error.strerror}") from error
    command = [sys.executable, "-m", "neurove_service.cli", "warm-up", "--model", str(args.model), "--json"]
    child = subprocess.run(command, env=os.environ | settings, stdout=subprocess.PIPE, text=True, check=False)
    if child.returncode != 0:
        return child.returncode
    found = json.loads(child.stdout)
    if args.json:
        print(json.dumps(found | {"settings": settings, "file": str(written)}))
        return 0
    print(f"compiled {found['compiled']} functions, {found['loaded']} were in the cache, {found['seconds']} s")
    print(f"cache: {args.out}; a service uses it with the environment in {written}:")
    for name, value in settings.items():
        print(f"  {name}={value}")
    return 0


def _steps(model: str) -> Iterator[_Step]:
    """The work, in order: first what a service needs."""
    yield _Step(f"model {model}", lambda: _warm_estimator(model))
    if absent("recordings"):
        return  # sources cannot be opened here, so nothing of them runs
    for scene in _SCENES:
        yield _Step(f"simulation of a {scene}", lambda scene=scene: _simulate(scene))  # type: ignore[misc]  # bound early


def _warm_estimator(model: str) -> None:
    from neurove_core import models
    from neurove_core.estimator import Estimator

    Estimator(models.find(model), refine=True).warm_up()


def _simulate(scene: str) -> None:
    from neurove_core.io.packets import slices
    from neurove_core.sources import open_source

    for _ in islice(slices(open_source(f"sim://{scene}?seed=0&imu=200").chunks()), _SLICES):
        pass


def _roots(folders: tuple[Path, ...]) -> list[Path]:
    """The folders that hold all of these, without those inside another one."""
    parents = [folder.parent for folder in folders]
    return sorted({one for one in parents if not any(other in one.parents for other in parents)})


def add_warm_up(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove warm-up`."""
    about = "bundle that will be served, or the name of a built-in model; default `default`"
    made = command(parser, warm_up)
    made.add_argument("--model", metavar="BUNDLE", default="default", help=about)
    made.add_argument(
        "--cpu",
        metavar="NAME",
        help=f"compile for this processor instead of the one of this machine; needs --out ({', '.join(PROCESSORS)})",
    )
    made.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help=f"folder for the compiled code, and for {FILE}, the environment in which a service uses it",
    )
