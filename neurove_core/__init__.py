"""NeuroVE: velocity of an event camera from its events, by a spiking network. No network access, no clocks, no threads.

These are the public names of the package. Each is loaded at its first use, so that reading recordings does not import
torch. Every other name is private by contract: a release may change it without notice.

- `open_source(source)`: a recording from a file, a folder, or a simulation.
- `load_model(name_or_path)`: a model, built in or from a bundle file.
- `Estimator(model)`: estimates twists from events.
- `LIF`, `ALIF`, `LTC`, `SLSTM`, `ASLSTM`, `Readout`: the neurons and cells of the paper, as torch modules.

    from neurove_core import Estimator, load_model, open_source

    recording = open_source("sim://street?seconds=2&seed=3")
    estimator = Estimator(load_model("default"))
    for estimate in estimator.estimates(recording):
        print(estimate.end_us, estimate.twists[-1])  # [us], and vx vy vz [m/s], wx wy wz [rad/s]
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from neurove_core.estimator import Estimator
    from neurove_core.models.bundle import Bundle
    from neurove_core.sources import open_source
    from neurove_core.spiking.alif import ALIF
    from neurove_core.spiking.aslstm import ASLSTM
    from neurove_core.spiking.lif import LIF
    from neurove_core.spiking.ltc import LTC
    from neurove_core.spiking.readout import Readout
    from neurove_core.spiking.slstm import SLSTM

__all__ = ["ALIF", "ASLSTM", "LIF", "LTC", "SLSTM", "Estimator", "Readout", "load_model", "open_source"]

_MODULE_OF = {
    "ALIF": "spiking.alif",
    "ASLSTM": "spiking.aslstm",
    "Estimator": "estimator",
    "LIF": "spiking.lif",
    "LTC": "spiking.ltc",
    "Readout": "spiking.readout",
    "SLSTM": "spiking.slstm",
    "open_source": "sources",
}


def load_model(name_or_path: "str | Path") -> "Bundle":
    """A model for `Estimator`.

    Args:
        name_or_path: name of a built-in model, such as `default`, or the path of a bundle file.

    Raises:
        BadModel: there is neither such a model nor such a file, or the file is not a valid bundle.
    """
    from neurove_core import models

    return models.find(str(name_or_path))


def __getattr__(name: str) -> Any:
    """A public name, loaded at its first use (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = found  # the next use finds it without this function
    return found


def __dir__() -> list[str]:
    """All names of the package, including those not yet loaded."""
    return sorted({*globals(), *__all__})
