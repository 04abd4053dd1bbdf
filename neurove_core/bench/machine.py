"""This machine: its description for results, and its limits for comparison."""

import importlib.metadata
import os
import platform
from collections.abc import Callable
from pathlib import Path

import torch

from neurove_core.config import ModelConfig
from neurove_core.networks.neurove import NeuroVE

_SIDE = 1024


def stamp(commit: str) -> str:
    """One line for a result: commit, processor, load, threads and versions."""
    versions = " ".join(f"{name} {importlib.metadata.version(name)}" for name in ("torch", "numpy", "numba"))
    isa = torch.backends.cpu.get_cpu_capability()
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    return (
        f"commit {commit}; {_processor()} ({os.cpu_count()} cores, {isa}, load {load}); "
        f"{torch.get_num_threads()} thread; Python {platform.python_version()} {versions}"
    )


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def peak() -> Callable[[], object]:
    """A large float32 matrix product, which reaches the highest arithmetic rate of this machine."""
    a, b = torch.randn(_SIDE, _SIDE), torch.randn(_SIDE, _SIDE)
    out = torch.empty(_SIDE, _SIDE)
    return lambda: torch.mm(a, b, out=out)


PEAK_FLOPS = 2 * _SIDE**3
"""Operations of one call of the function that `peak` returns."""


def flops(config: ModelConfig) -> int:
    """Multiplications and additions of one window with dense products, without elementwise operations."""
    net = config.network
    sizes = NeuroVE(config).map_sizes()
    inputs, total = config.input_shape[0], 0
    for outputs, (rows, columns) in zip(net.channels, sizes, strict=True):
        total += 9 * inputs * outputs * rows * columns
        inputs = outputs
    total += inputs * sizes[-1][0] * sizes[-1][1] * net.features
    inputs = net.features
    for _ in range(net.cells):
        total += (5 * inputs + 4 * net.hidden) * net.hidden
        inputs = net.hidden
    return 2 * (total + net.hidden * 6 * config.window.bins)
