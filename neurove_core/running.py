"""Which runner computes the network of a model, and in which form."""

import numpy as np
from numpy.typing import NDArray

from neurove_core.extras import installed
from neurove_core.ingest.channels import Recent, remembered, with_history
from neurove_core.models.bundle import Bundle
from neurove_core.networks.arrays import Runner


def form_of(runner: Runner) -> str:
    """The form of the engine in a runner, and why it serves; see `engine.choice`."""
    return str(getattr(runner, "choice", "torch (this network or this machine has no compiled form)"))


def runner_of(bundle: Bundle) -> Runner:
    """The fastest runner of a model: on arrays, whether it was read from a file or is in memory; baselines in torch.

    Both run the same code, so a golden test that was recorded of a model in memory holds for its file.
    """
    if bundle.config.kind == "neurove":
        from neurove_core.engine.array_runner import ArrayRunner

        found = ArrayRunner(bundle.current_weights)
        found.choose(_golden_input(bundle))
        if found.is_compiled or not installed("torch"):
            return found  # else torch is faster than plain numpy
    from neurove_core.engine import runner

    return runner.runner_of(bundle.network.eval().requires_grad_(requires_grad=False))


def _golden_input(bundle: Bundle) -> NDArray[np.uint8] | None:
    """The network's input for the golden windows of a model; None where it has none."""
    if bundle.golden is None:
        return None
    found, recent = [], Recent()
    for window in bundle.golden.counts:
        found.append(with_history(window, recent, bundle.config))
        recent = remembered(window, recent, bundle.config)
    return np.stack(found)
