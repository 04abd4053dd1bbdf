"""The command warm-up: compile ahead the machine code that the other commands run."""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

from neurove_protocol.errors import InvalidField
from neurove_service.cli.arguments import command
from neurove_service.cli.bars import progress
from neurove_service.cli.extras import absent
from neurove_service.cli.processors import FILE, PROCESSORS, name_here, settings_for, write_settings

_SCENES: Final = ("street", "room", "wall")
"""Scenes of the simulator that together run all of its loops."""

_SLICES: Final = 3  # of a simulation; the first ones are empty


class _Step(NamedTuple):
    """One part of the work, by the name that the progress shows."""

    name: str
    run: Callable[[], None]


def warm_up(args: argparse.Namespace) -> int:
    """Compile ahead what serve, demo, drive and simulate run, and say where it is kept."""
    if args.ahead:
        return _ahead(args)
    if args.cpu or args.out:
        return _elsewhere(args)
    from neurove_core import models
    from neurove_core.compiled import work, write_ahead
    from neurove_core.warming import complete_for, note_complete
    from neurove_service import logs

    logs.configure("warning")
    began = time.monotonic()
    steps = list(_steps(args.model))
    with progress() as show:
        for done, step in enumerate(steps):
            show("compiling", done, len(steps), step.name)
            step.run()
        show("compiling", len(steps), len(steps), "done")
    if args.ahead_as:
        print(write_ahead(args.ahead_as, complete_for(models.find(args.model).config)))
        return 0
    note_complete()
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
        raise InvalidField(
            "warm-up", "--out", "", "a folder, or --ahead, because --cpu makes code that this machine does not use"
        )
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


def _ahead(args: argparse.Namespace) -> int:
    """Compile in one process, and let a second one, which loads all of it, write it into the package.

    The second process loads only what Python code calls, not the functions that these call.
    """
    from neurove_core.compiled.ahead import FOLDER, SWITCH

    if args.out is not None:
        raise InvalidField("warm-up", "--out", str(args.out), "absent with --ahead, which writes into the package")
    with tempfile.TemporaryDirectory() as cache:
        settings = settings_for(args.cpu, Path(cache)) | {SWITCH: "off"}
        name = args.cpu or name_here()
        own = FOLDER / name
        try:
            own.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            why = f"a package that this user may write; {error.strerror}"
            raise InvalidField("warm-up", "--ahead", str(own), why) from error
        command = [sys.executable, "-m", "neurove_service.cli", "warm-up", "--model", str(args.model), "--json"]
        for more in ([], ["--ahead-as", name]):
            child = subprocess.run(
                [*command, *more], env=os.environ | settings, stdout=subprocess.PIPE, text=True, check=False
            )
            if child.returncode != 0:
                return child.returncode
    size = sum(one.stat().st_size for one in own.iterdir())
    if args.json:
        print(json.dumps({"files": int(child.stdout), "bytes": size, "folder": str(own), "processor": name}))
        return 0
    print(f"{int(child.stdout)} files of compiled code for {name}, {size / 1e6:.1f} MB: {own}")
    print("All users of this installation start with it on processors of this kind, and compile nothing.")
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
        help=f"compile for this processor instead of this machine's; needs --out or --ahead ({', '.join(PROCESSORS)})",
    )
    made.add_argument(
        "--ahead",
        action="store_true",
        help="write the compiled code into the installed package: for all users of it, for an image or for a wheel",
    )
    made.add_argument("--ahead-as", metavar="NAME", help=argparse.SUPPRESS)
    made.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help=f"folder for the compiled code, and for {FILE}, the environment in which a service uses it",
    )
