"""Checks of this machine: compiled kernels, processor, the engine's fast path, installed extras."""

import importlib.util
import os
import platform
from pathlib import Path
from typing import Final, Literal, NamedTuple

from neurove_core.live.usb import DEVICES, NODES, usb_cameras
from neurove_service.cli.extras import EXTRAS, absent

CPU_FLAGS: Final = {
    "avx2": "AVX2",
    "avx512f": "AVX-512",
    "avx512_vnni": "VNNI",
    "avx_vnni": "AVX-VNNI",
    "asimd": "NEON",
    "neon": "NEON",
}
"""Names of /proc/cpuinfo, and what people call them."""


class Check(NamedTuple):
    """The result of one check."""

    what: str
    state: str
    level: Literal["ok", "bad", "info"]  # bad: needs an action; info: optional or unknown
    advice: str = ""  # what to do


def check_kernels() -> Check:
    """Whether numba has cached the compiled kernels of neurove_core, and whether it can."""
    folder = _cache_root()
    count = sum(1 for _ in folder.rglob("*.nbi")) if folder.is_dir() else 0
    if not _writable(folder):
        state = f"{count} cached; {folder} is not writable"
        return Check("compiled kernels", state, "bad", "set NUMBA_CACHE_DIR to a folder that the service may write")
    if not count and _brings_code():
        return Check("compiled kernels", "in the package, for the built-in model", "ok")
    if not count:
        advice = "nothing: the first start compiles them and is slow"
        return Check("compiled kernels", f"none cached in {folder}", "info", advice)
    return Check("compiled kernels", f"{count} cached in {folder}", "ok")


def _brings_code() -> bool:
    """Whether the installation has compiled code for this processor, of the present sources."""
    if absent("serve"):
        return False
    from neurove_core import models
    from neurove_core.compiled import ahead
    from neurove_core.warming import complete_for

    return ahead.complete_for() == complete_for(models.find(models.DEFAULT).config)


def _cache_root() -> Path:
    """The folder below which numba keeps the kernels: NUMBA_CACHE_DIR, or next to the sources."""
    configured = os.environ.get("NUMBA_CACHE_DIR")
    if configured:
        return Path(configured)
    spec = importlib.util.find_spec("neurove_core")
    return Path(str(spec.origin)).parent if spec else Path()


def _writable(folder: Path) -> bool:
    """Whether files can be written in a folder, or the folder can be made."""
    nearest = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    return os.access(nearest, os.W_OK)


def check_processor() -> Check:
    """The vector instructions of this processor that the engine can use."""
    names = cpu_features()
    state = f"{platform.machine()} with {', '.join(names)}" if names else f"{platform.machine()}, features unknown"
    return Check("processor", state, "info")


def cpu_features(cpuinfo: Path = Path("/proc/cpuinfo")) -> list[str]:
    """Those of AVX2, AVX-512, VNNI, AVX-VNNI and NEON that this processor has; empty if the file does not exist."""
    try:
        lines = cpuinfo.read_text(errors="replace").splitlines()
    except OSError:
        return []
    flags = next((line.split(":", 1)[1].split() for line in lines if line.startswith(("flags", "Features"))), [])
    return list(dict.fromkeys(name for flag, name in CPU_FLAGS.items() if flag in flags))


def check_engine() -> Check:
    """Which form of the engine serves the built-in model on this machine."""
    if missing := absent("serve"):
        return Check("fast path", f"unknown: {', '.join(missing)} not installed", "info")
    from neurove_core import models
    from neurove_core.engine.vectors import has_byte_products
    from neurove_core.estimator import Estimator

    model = models.find(models.DEFAULT)
    form = Estimator(model).form
    int8 = f"int8 models {'with' if has_byte_products() else 'without'} VNNI"
    if form.startswith(("plain", "torch")):
        return Check("fast path", f"{form}: the compiled forms do not work here", "bad", "see the warning above")
    return Check("fast path", f"{form}; {model.config.network.precision}; {int8}", "ok")


def check_cameras(devices: Path = DEVICES, nodes: Path = NODES) -> Check:
    """Whether this user may use the event cameras on USB.

    Args:
        devices: folder in which Linux lists the USB devices.
        nodes: folder of the files by which programs use them.
    """
    found = usb_cameras(devices, nodes)
    if not found:
        state = "none on USB" if found is not None else "none: this machine has no USB bus"
        return Check("cameras", state, "info")
    state = ", ".join(f"{one.vendor}:{one.product} ({one.about})" for one in found)
    if not all(one.accessible for one in found):
        return Check("cameras", f"no permission: {state}", "bad", "`neurove cameras` prints the line of udev to add")
    return Check("cameras", state, "ok")


def check_extras() -> list[Check]:
    """Which extras of the package are installed."""
    return [_check_extra(extra) for extra in EXTRAS]


def _check_extra(extra: str) -> Check:
    missing = absent(extra)
    if not missing:
        return Check(f"extra {extra}", "installed", "ok")
    advice = f"if you need it: pip install 'neurove[{extra}]'"
    return Check(f"extra {extra}", f"not installed: {', '.join(missing)}", "info", advice)
