"""Compile a network's code in a process of its own, so that a change of model does not hold up the streams.

numba compiles for seconds in Python code. In the process of the node each step of a stream would wait for its turn in
between. The child compiles into the cache on disk, at low priority; the node then reads the cache. Networks of a known
shape need none of this.

`python -m neurove_service.models.precompile CONFIG` takes the configuration of the model as JSON.
"""

import math
import os
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np

from neurove_core.config import ModelConfig
from neurove_core.estimator import Estimator
from neurove_core.models.bundle import Bundle
from neurove_core.networks.arrays import Weights, shapes
from neurove_service import logs

log = logs.get(__name__)

TIMEOUT_S = 60.0
CHILD_BYTES = 512 << 20
"""Memory of the child [bytes]; with less free memory the node compiles by itself."""

_POLL_S = 0.05
_NICE = 5
_WIDE_CELLS = 1 << 16  # indices of more cells need another type


class Shapes:
    """The shapes of networks for which this process has compiled code."""

    def __init__(self) -> None:
        self._known: set[tuple[object, ...]] = set()

    def add(self, config: ModelConfig) -> None:
        """Note that a network of this configuration has run here."""
        self._known.add(_shape(config))

    def need_child(self, config: ModelConfig, free_bytes: int | None) -> bool:
        """Whether code for this configuration is to be compiled by a child."""
        fits = free_bytes is None or free_bytes > CHILD_BYTES
        return fits and config.kind == "neurove" and _shape(config) not in self._known


def in_child(config: ModelConfig, stop: threading.Event, timeout_s: float = TIMEOUT_S) -> bool:
    """Compile the code of a configuration in a child process.

    Args:
        config: of the model.
        stop: ends the child.
        timeout_s: maximum time [s].

    Returns:
        Whether the child has compiled it; if not, the log has the reason, and the first use compiles it.
    """
    command = [sys.executable, "-P", "-m", "neurove_service.models.precompile", config.model_dump_json()]
    # with the same paths of modules: the cache is by path
    try:
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
    except OSError as error:
        log.warning("code is compiled by the node itself", why=error.strerror or str(error))
        return False
    deadline = time.monotonic() + timeout_s
    while child.poll() is None and time.monotonic() < deadline and not stop.wait(_POLL_S):
        pass
    if child.poll() is None:
        child.kill()
    _, errors = child.communicate()
    if child.returncode != 0:
        last = errors.decode(errors="replace").strip().splitlines()[-1:] or [f"exit code {child.returncode}"]
        log.warning("code is compiled by the node itself", why=last[0][:200])
    return child.returncode == 0


def _shape(config: ModelConfig) -> tuple[object, ...]:
    """What the types and constants of compiled code depend on."""
    cells = math.prod(config.window_shape)
    net = config.network
    widths = net.encoding, net.precision, net.channels, net.features, net.hidden, net.cells
    return config.kind, widths, config.window.bins, cells > _WIDE_CELLS, bool(net.history)


def main() -> None:
    """Compile the code of the configuration in the first argument."""
    os.nice(_NICE)
    config = ModelConfig.model_validate_json(sys.argv[1])
    rng = np.random.default_rng(0)
    tensors = {
        name: np.abs(rng.normal(0, 0.1, shape)).astype(np.float32)
        for name, shape in shapes(config, spread=False).items()
    }
    given: Any = Weights(config, tensors), np.zeros(6, np.float32), np.ones(6, np.float32)
    Estimator(Bundle("compiling", False, "", config, *given)).warm_up()


if __name__ == "__main__":
    main()
