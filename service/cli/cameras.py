"""The command cameras: what is plugged in, what is missing, and what to send to the developers."""

import argparse
import importlib.metadata
import json
import platform
from typing import TYPE_CHECKING, Final

from neurove_protocol.errors import EXIT_FAILURE
from neurove_service.cli.arguments import command

if TYPE_CHECKING:
    from neurove_core.live.camera import Cameras
    from neurove_core.live.usb import UsbCamera

_REPORTED: Final = ("neurove", "neuromorphic-drivers", "dv-processing", "numpy")


def cameras(args: argparse.Namespace) -> int:
    """List the event cameras at this machine, and say what is missing."""
    from neurove_core.live import camera, usb

    listed = camera.cameras()
    on_usb = usb.usb_cameras()
    if args.report:
        _print_report(listed, on_usb, as_json=args.json)
        return 0
    if args.json:
        found = [one._asdict() | {"url": one.url if one.model else None} for one in listed.found]
        print(json.dumps({"cameras": found, "missing": listed.missing, "udev_rules": listed.rules}))
    else:
        _print(listed)
    return 0 if listed.usable else EXIT_FAILURE


def _print(listed: "Cameras") -> None:
    for one in listed.found:
        how = f"neurove drive '{one.url}'" if one.model else "no command: the model is not supported"
        print(f"{one.about}  {one.connection}  {how if one.error is None else one.error}")
    print("\n".join((*listed.missing, *listed.rules)) if listed.missing else f"{len(listed.found)} found")


def _print_report(listed: "Cameras", on_usb: "list[UsbCamera] | None", *, as_json: bool) -> None:
    """Print versions, numbers on USB and what the libraries say: no serial number, host, user or path."""
    report = {
        "versions": {name: _version(name) for name in _REPORTED}
        | {"python": platform.python_version(), "system": f"{platform.system()} {platform.release()}"}
        | {"machine": platform.machine()},
        "usb": None if on_usb is None else [f"{one.vendor}:{one.product} {one.about}" for one in on_usb],
        "accessible": [one.accessible for one in on_usb or ()],
        "cameras": [f"{one.about}, {one.connection}, {one.library}, {one.error or 'ok'}" for one in listed.found],
        "missing": list(listed.missing),
    }
    if as_json:
        print(json.dumps(report))
        return
    print("Send these lines to the developers, with what you saw and what you expected:")
    print(json.dumps(report, indent=2))


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def add_cameras(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove cameras`."""
    command(parser, cameras)
    about = "print what to send to the developers: versions and USB numbers, no serial number and no path"
    parser.add_argument("--report", action="store_true", help=about)
