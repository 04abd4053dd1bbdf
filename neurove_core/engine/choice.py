"""The choice of a form at load: every form gives the same bits, so the fastest one on this machine may serve."""

import os
import time
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_protocol.errors import InvalidField

VARIABLE: Final = "NEUROVE_FORM"
"""Environment variable that names the form of every model, and so turns timing off."""

FORMS: Final = ("sparse", "dense", "float32")
"""sparse: over the neurons that fired. dense: over all neurons. float32: over the neurons that fired, with the integers
of an int8 model held in float32."""

_BUDGET_S: Final = 0.02  # for all forms together, after one run of each
_ROUNDS: Final = 9


class Choice(NamedTuple):
    """The form that serves, and why."""

    form: str
    why: str

    def __str__(self) -> str:
        return f"{self.form} ({self.why})"


def pinned() -> str | None:
    """The form that the environment names; None where the fastest one is to be found.

    Raises:
        InvalidField: there is no form of this name.
    """
    asked = os.environ.get(VARIABLE, "auto")
    if asked in ("", "auto"):
        return None
    if asked not in FORMS:
        raise InvalidField("environment", VARIABLE, asked, f"known are auto, {', '.join(FORMS)}")
    return asked


def fastest(forms: Mapping[str, Callable[[], NDArray[np.float32]]]) -> Choice:
    """Time forms in turn for some milliseconds.

    Args:
        forms: each computes the same numbers; the first one is what the model asks for.

    Returns:
        the form that took the least time of those whose numbers equal the first one's bit for bit.
    """
    usual, *_ = forms
    wanted = forms[usual]()
    others = {name: run for name, run in forms.items() if name != usual}
    equal = {usual: forms[usual], **{name: run for name, run in others.items() if _same(run(), wanted)}}
    least = dict.fromkeys(equal, float("inf"))
    ends = time.perf_counter() + _BUDGET_S
    for turn in range(_ROUNDS):
        if turn and time.perf_counter() > ends:
            break
        for name, run in equal.items():
            began = time.perf_counter()
            run()
            least[name] = min(least[name], time.perf_counter() - began)
    found = min(least, key=lambda name: least[name])
    times = ", ".join(f"{name} {1e3 * least[name]:.2g} ms" for name in least)
    unequal = "".join(f", {name} differs" for name in forms if name not in equal)
    return Choice(found, f"fastest on its golden windows: {times}{unequal}")


def _same(found: NDArray[np.float32], wanted: NDArray[np.float32]) -> bool:
    return found.tobytes() == wanted.tobytes()
