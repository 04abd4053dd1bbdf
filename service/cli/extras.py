"""The extras of the package, and the libraries that only they install."""

import os
import sys
from typing import Final

from neurove_core.extras import MissingExtra, installed

EXTRAS: Final[dict[str, tuple[str, ...]]] = {
    "serve": ("cryptography", "numba", "safetensors"),
    "recordings": ("h5py", "hdf5plugin", "lz4", "mcap", "numba", "PIL", "rosbags", "ruamel", "scipy", "zstandard"),
    "train": ("matplotlib", "tensorboard", "torch"),
    "experiments": ("matplotlib", "scipy", "torch"),
    "bench": ("dv_processing", "faery", "loguru", "snntorch", "tonic", "torch"),
    "carla": ("carla",),
    "camera": ("dv_processing", "neuromorphic_drivers"),
    "metrics": ("prometheus_client",),
    "page": ("starlette", "uvicorn"),
    "foxglove": ("foxglove",),
    "ros2": ("xxhash",),
    "cluster": ("dask", "distributed"),
}
"""Modules that an extra installs itself; some extras also include others, see `_DEPENDS` and pyproject.toml."""

_DEPENDS: Final[dict[str, tuple[str, ...]]] = {
    "train": ("serve", "recordings"),
    "experiments": ("serve", "recordings"),
    "bench": ("serve",),
    "carla": ("recordings",),
    "camera": ("recordings",),
    "ros2": ("recordings",),
}


def missing_extra(error: ModuleNotFoundError, usual: str) -> MissingExtra | None:
    """The extra that installs a missing module; None if no extra does.

    Args:
        error: of an import.
        usual: the extra that the running command needs; it is named if it installs the module.
    """
    module = str(error.name).partition(".")[0]
    having = [extra for extra, modules in EXTRAS.items() if module in modules]
    if not having:
        return None
    if usual in having or any(extra in having for extra in _DEPENDS.get(usual, ())):
        return MissingExtra(module, usual)
    return MissingExtra(module, having[0])


def one_thread() -> None:
    """Let torch compute in one thread, whether it is loaded already or later; a service may run without it."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(1)
    else:
        os.environ["OMP_NUM_THREADS"] = "1"


def absent(extra: str) -> list[str]:
    """Modules of an extra, and of the extras that it includes, that are not installed."""
    modules = [module for name in (*_DEPENDS.get(extra, ()), extra) for module in EXTRAS[name]]
    return [module for module in dict.fromkeys(modules) if not installed(module)]
