"""Processors by name: what numba has to be told to compile for one, and whether this machine can run such code."""

import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from neurove_protocol.errors import InvalidField

_V2: Final = ("cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3")
_V3: Final = (*_V2, "avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave")
_V4: Final = (*_V3, "avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl")

PROCESSORS: Final[Mapping[str, tuple[str, ...]]] = {
    "x86-64-v2": _V2,
    "x86-64-v3": _V3,
    "x86-64-v4": _V4,
    "haswell": _V3,
    "znver1": _V3,
    "znver2": _V3,
    "znver3": _V3,
    "skylake": _V3,
    "skylake-avx512": _V4,
    "icelake-server": (*_V4, "avx512vbmi", "avx512vnni"),
}
"""Features that the code for a processor may use. Source: the levels of the psABI of x86-64. A
processor by name has those of its level, so that its code also runs where the system hides the others."""

FILE: Final = "cpu.env"


def settings_for(processor: str | None, cache: Path) -> dict[str, str]:
    """The environment in which numba compiles for a processor, and in which a service reads that code.

    Args:
        processor: its name; None for the one of this machine.
        cache: folder of the code.

    Raises:
        InvalidField: the name is unknown, or this machine cannot run code for it.
    """
    folder = {"NUMBA_CACHE_DIR": str(cache.resolve())}
    if processor is None:
        return folder
    features = PROCESSORS.get(processor)
    if features is None:
        raise InvalidField("warm-up", "--cpu", processor, f"known are {', '.join(PROCESSORS)}")
    lacking = missing(features)
    if lacking:
        why = f"a processor that this machine is able to run; it lacks {', '.join(lacking)}"
        raise InvalidField("warm-up", "--cpu", processor, why)
    return folder | {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": ",".join(f"+{one}" for one in features)}


def name_here() -> str:
    """What LLVM calls the processor of this machine."""
    from llvmlite import binding

    return str(binding.get_host_cpu_name())


def missing(features: tuple[str, ...]) -> list[str]:
    """Those of some features that this machine lacks; on another architecture all of them."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return list(features)
    from llvmlite import binding

    here = binding.get_host_cpu_features()
    return [one for one in features if not here.get(one, False)]


def write_settings(settings: Mapping[str, str], folder: Path) -> Path:
    """Write the environment as a file of lines NAME=VALUE, for systemd's EnvironmentFile or `podman run --env-file`."""
    path = folder / FILE
    path.write_text("".join(f"{name}={value}\n" for name, value in settings.items()))
    return path
