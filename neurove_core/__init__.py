"""The paper (NeuroVE) and its models: no network, no clocks, no threads.

Its neurons and cells are here by name, `from neurove_core import ALIF, ASLSTM`, and loaded only when asked for: reading
recordings does without torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neurove_core.spiking.alif import ALIF
    from neurove_core.spiking.aslstm import ASLSTM
    from neurove_core.spiking.lif import LIF
    from neurove_core.spiking.ltc import LTC
    from neurove_core.spiking.readout import Readout
    from neurove_core.spiking.slstm import SLSTM

__all__ = ["ALIF", "ASLSTM", "LIF", "LTC", "SLSTM", "Readout"]

_MODULE_OF = {
    "ALIF": "spiking.alif",
    "ASLSTM": "spiking.aslstm",
    "LIF": "spiking.lif",
    "LTC": "spiking.ltc",
    "Readout": "spiking.readout",
    "SLSTM": "spiking.slstm",
}


def __getattr__(name: str) -> Any:
    """A neuron or cell, loaded at its first use (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = found  # the next use finds it without this function
    return found


def __dir__() -> list[str]:
    """The names of the package, those not yet loaded too."""
    return sorted({*globals(), *__all__})
