"""The command install-units: the files of a plain machine with systemd, or what would be written."""

import argparse
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from neurove_core.files import write_atomically
from neurove_protocol.errors import NeuroVEError
from neurove_service.cli.arguments import command

SETTINGS: Final = Path("etc/neurove")
UNITS: Final = Path("etc/systemd/system")

_HIDDEN: Final = ("/home", "/root")  # ProtectHome= of the units hides them
_PROGRAMS: Final = re.compile(r"^(ExecStart=)/opt/neurove/venv/bin/", re.MULTILINE)


class InstallError(NeuroVEError):
    """The units cannot be installed."""

    code = "install"


class Step(NamedTuple):
    """One file to write."""

    path: Path
    text: str
    about: str
    keep: bool  # an existing file belongs to the user


def install_units(args: argparse.Namespace) -> int:
    """Write the systemd units, the settings and the configuration of the router, or show what would be written."""
    programs = Path(sys.prefix, "bin")
    hidden = programs.is_relative_to(_HIDDEN[0]) or programs.is_relative_to(_HIDDEN[1])
    if not args.dry_run:
        if hidden:
            raise InstallError(f"{programs}: the units hide /home and /root; install NeuroVE elsewhere, as in /opt")
        if args.root == Path("/") and os.geteuid() != 0:
            raise InstallError("only root may write units; --dry-run shows what would be written")
    for step in steps(args.root, programs, with_router=not args.no_router):
        present = step.path.exists()
        same = present and step.path.read_text(encoding="utf-8") == step.text
        state = "unchanged" if same else "kept" if present and step.keep else "replaced" if present else "new"
        if not args.dry_run and state in ("replaced", "new"):
            step.path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(step.path, step.text.encode())
            step.path.chmod(0o644)
        would = "would be " if args.dry_run and state in ("replaced", "new") else ""
        print(f"{would}{state}: {step.path}  # {step.about}")
    if hidden:
        print(f"neurove: {programs}: the units hide /home and /root; install NeuroVE elsewhere", file=sys.stderr)
    names = "neurove" if args.no_router else "zenoh-router neurove"
    print(f"then: edit {args.root / SETTINGS / 'neurove.toml'}, at least node")
    print("then: systemctl daemon-reload")
    print(f"then: systemctl enable --now {names}")
    return 0


def steps(root: Path, programs: Path, *, with_router: bool) -> Iterator[Step]:
    """The files to write.

    Args:
        root: root folder of the machine.
        programs: folder of the programs of this installation.
        with_router: whether this machine runs the router too.
    """
    yield Step(root / SETTINGS / "neurove.toml", shipped("neurove.toml"), "settings of the service", keep=True)
    yield Step(root / UNITS / "neurove.service", _unit("neurove.service", programs), "the service", keep=False)
    if with_router:
        router = shipped("zenoh-router.json5")
        yield Step(root / SETTINGS / "zenoh-router.json5", router, "configuration of the router", keep=True)
        unit = _unit("zenoh-router.service", programs)
        yield Step(root / UNITS / "zenoh-router.service", unit, "the router", keep=False)


def _unit(name: str, programs: Path) -> str:
    return _PROGRAMS.sub(rf"\g<1>{programs.as_posix()}/", shipped(name))


def shipped(name: str) -> str:
    """A file of `deploy/`: of the checkout, or of the installed package.

    Raises:
        InstallError: this installation does not have it.
    """
    checkout = Path(__file__).resolve().parents[2] / "deploy" / name
    installed = Path(sys.prefix, "share", "neurove", name)
    for path in (checkout, installed):
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise InstallError(f"{name} is not part of this installation: {installed} does not exist")


def add_install_units(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove install-units`."""
    command(parser, install_units, as_json=False)
    parser.add_argument("--dry-run", action="store_true", help="show what would be written; write nothing")
    parser.add_argument("--no-router", action="store_true", help="leave out the Zenoh router: it runs elsewhere")
    about = "root folder of the machine to write to, such as that of an image; default /"
    parser.add_argument("--root", type=Path, default=Path("/"), metavar="DIR", help=about)
