"""Event cameras on the USB buses of this machine, as Linux lists them; no library of a camera is needed."""

import os
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final, NamedTuple

DEVICES: Final = Path("/sys/bus/usb/devices")
NODES: Final = Path("/dev/bus/usb")

KNOWN: Final = (
    ("152a", "84[0-1]?", "iniVation DVS128, DAVIS or DVXplorer"),
    ("04b4", "00f[4-5]", "Prophesee EVK3 or EVK4"),
    ("31f7", "000[3-4]", "CenturyArks SilkyEvCam"),
    ("1409", "8e00", "IDS uEye EVS"),
)
"""Vendor, product (a pattern of udev and of a shell), cameras. Source: the udev rules of neuromorphic-drivers."""


class UsbCamera(NamedTuple):
    """An event camera on a USB bus."""

    vendor: str  # four hexadecimal digits
    product: str
    about: str  # the cameras that have these numbers
    accessible: bool  # whether this user may read and write it


def udev_rule(vendor: str, product: str) -> str:
    """The line of udev that lets the users of the group plugdev, and who sits at the machine, use a camera.

    >>> udev_rule("31f7", "0003")
    'SUBSYSTEM=="usb", ATTR{idVendor}=="31f7", ATTR{idProduct}=="0003", MODE="0660", GROUP="plugdev", TAG+="uaccess"'
    """
    which = f'ATTR{{idVendor}}=="{vendor}", ATTR{{idProduct}}=="{product}"'
    return f'SUBSYSTEM=="usb", {which}, MODE="0660", GROUP="plugdev", TAG+="uaccess"'


def usb_cameras(devices: Path = DEVICES, nodes: Path = NODES) -> list[UsbCamera] | None:
    """The event cameras on the USB buses; None if this machine has no USB bus.

    Args:
        devices: folder in which Linux lists the devices.
        nodes: folder of the files by which programs use them.
    """
    if not devices.is_dir() or not nodes.is_dir():
        return None
    return sorted(_cameras(devices, nodes))


def _cameras(devices: Path, nodes: Path) -> Iterator[UsbCamera]:
    for device in devices.iterdir():
        vendor, product = _text(device / "idVendor"), _text(device / "idProduct")
        about = next((one for v, p, one in KNOWN if v == vendor and fnmatchcase(product, p)), None)
        if about is None:
            continue
        bus, number = _text(device / "busnum"), _text(device / "devnum")
        node = nodes / bus.rjust(3, "0") / number.rjust(3, "0")
        yield UsbCamera(vendor, product, about, os.access(node, os.R_OK | os.W_OK))


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip().lower()
    except OSError:  # unplugged while it is read, or an interface, which has no such file
        return ""
