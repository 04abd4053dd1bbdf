"""`camera://`: an event camera at this machine, through neuromorphic-drivers or dv-processing (extra `camera`)."""

from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import parse_qsl, urlsplit

from neurove_core.extras import MissingExtra
from neurove_core.io.errors import UnknownSource
from neurove_core.live import dv_camera, neuromorphic
from neurove_core.live.found import Found
from neurove_core.live.source import LiveFormat, LiveSource, NoCamera
from neurove_core.live.usb import DEVICES, KNOWN, NODES, udev_rule, usb_cameras
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

MODELS: Final = (*neuromorphic.MODELS, *dv_camera.MODELS)
"""The models that a URL may name."""

RULES_FILE: Final = "/etc/udev/rules.d/70-neurove-cameras.rules"

_DENIED: Final = ("access denied", "permission", "insufficient")
_BUSY: Final = ("busy", "already used")


class Cameras(NamedTuple):
    """The cameras at this machine, and what is missing."""

    found: tuple[Found, ...]
    missing: tuple[str, ...]  # sentences
    rules: tuple[str, ...]  # lines for RULES_FILE

    @property
    def usable(self) -> tuple[Found, ...]:
        """Those that can be opened."""
        return tuple(one for one in self.found if one.model and one.error is None)


def cameras(devices: Path = DEVICES, nodes: Path = NODES) -> Cameras:
    """List the cameras at this machine, and say in words what is missing.

    Args:
        devices: folder in which Linux lists the USB devices.
        nodes: folder of the files by which programs use them.
    """
    usb = usb_cameras(devices, nodes)
    found, missing = _listed(has_bus=usb is not None)
    if usb is None:
        why = "this machine has no USB bus: is this a container or a virtual machine? Pass /dev/bus/usb to it"
        return Cameras(found, (*missing, why), ())
    denied = sorted({(one.vendor, one.product, one.about) for one in usb if not one.accessible})
    rules = tuple(udev_rule(vendor, product) for vendor, product, _ in denied)
    for vendor, product, about in denied:
        what = f"no permission to use {vendor}:{product} ({about})"
        missing = (*missing, f"{what}: write the line below to {RULES_FILE}, then unplug the camera and plug it in")
    if not usb and not found:
        known = ", ".join(f"{vendor}:{product}" for vendor, product, _ in KNOWN)
        missing = (*missing, f"no event camera is plugged in: no USB device is one of {known}")
    elif len(usb) > len(found) and not denied and not missing:
        what = ", ".join(f"{one.vendor}:{one.product} ({one.about})" for one in usb)
        missing = (*missing, f"the libraries do not know every camera on USB: {what}")
    return Cameras(found, missing, rules)


def _listed(*, has_bus: bool) -> tuple[tuple[Found, ...], tuple[str, ...]]:
    """What the libraries list, each camera once, and which library is missing or failed."""
    found: list[Found] = []
    missing: list[str] = []
    libraries: tuple[tuple[str, Callable[[], list[Found]]], ...] = (
        (neuromorphic.LIBRARY, neuromorphic.discover),
        (dv_camera.LIBRARY, dv_camera.discover),
    )
    for library, discover in libraries:
        try:
            serials = {_plain(one.serial) for one in found}
            found += [one for one in discover() if one.serial is None or _plain(one.serial) not in serials]
        except ModuleNotFoundError:
            missing.append(f"{library} is not installed: pip install 'neurove[camera]'")
        except RuntimeError as error:
            if has_bus:  # without a USB bus there is a sentence for it
                missing.append(f"{library} cannot list cameras: {error}")
    return tuple(found), tuple(missing)


def _plain(serial: str | None) -> str:
    return (serial or "").lstrip("0").upper()


def open_camera(url: str, sensor: Sensor | None = None) -> LiveSource:
    """Open the camera of `camera://`, `camera://MODEL` or `camera://MODEL?serial=SERIAL`.

    Raises:
        UnknownSource: the URL has other parts.
        InvalidField: the model is unknown, or a sensor is given: a camera knows its size.
        NoCamera: there is no such camera, or it cannot be opened.
        MissingExtra: the library that opens it is not installed.
    """
    parts = urlsplit(url)
    query = dict(parse_qsl(parts.query, keep_blank_values=True))
    model, serial = parts.netloc.lower(), query.get("serial")
    if parts.path.strip("/") or query.keys() - {"serial"}:
        raise UnknownSource(url, "expected camera://, camera://MODEL or camera://MODEL?serial=SERIAL")
    if model and model not in MODELS:
        raise InvalidField(url, "model", model, f"the models are {', '.join(MODELS)}")
    if sensor is not None:
        raise InvalidField(url, "--sensor", str(sensor), "a camera knows the size of its pixel array")
    try:
        chosen = model or _only(url, serial)
        if chosen in dv_camera.MODELS:
            return dv_camera.open_camera(url, chosen, serial)
        return neuromorphic.open_camera(url, chosen, serial)
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name), "camera") from None
    except NoCamera as error:
        raise NoCamera(url, _why(str(error.details["why"]))) from None


def _only(url: str, serial: str | None) -> str:
    """The model of the only camera, or of the one with this serial number.

    Raises:
        NoCamera: there is none, or there are several. ModuleNotFoundError: no library is installed.
    """
    listed = cameras()
    fitting = [one for one in listed.usable if serial is None or _plain(one.serial) == _plain(serial)]
    if len(fitting) == 1:
        return fitting[0].model
    if fitting:
        raise NoCamera(url, f"{len(fitting)} cameras are plugged in: choose one of {', '.join(x.url for x in fitting)}")
    if not listed.found:
        import neuromorphic_drivers  # noqa: F401  # names the extra if it is missing
    failed = [f"{one.about}: {one.error}" for one in listed.found if one.error]
    why = f"none has the serial number {serial}" if listed.usable else "; ".join((*failed, *listed.missing))
    raise NoCamera(url, why or "no event camera is plugged in")


def _why(text: str) -> str:
    """Why a camera cannot be opened: what a library says, and what to do."""
    plain = text.lower()
    if any(word in plain for word in _DENIED) and RULES_FILE not in text:
        return f"{text}: `neurove cameras` prints the line of udev that gives the permission"
    if any(word in plain for word in _BUSY):
        return f"{text}: another program uses the camera"
    listed = cameras()
    if not listed.found and not any(one in text for one in listed.missing):
        return "; ".join((text, *listed.missing))
    return text


FORMAT = LiveFormat("camera://, camera://MODEL?serial=... (an event camera at this machine)", "camera", open_camera)
