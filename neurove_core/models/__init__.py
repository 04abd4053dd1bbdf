"""Model bundles: their format and parts, and the models that are built in.

This face is light: `built_in` and `find` import the bundle format, and torch with it, when they are called. The parts
are modules: `bundle` (the file), `metadata` (the optional header fields), `golden` (the stored golden test),
`uncertainty` (from log sigma to a covariance), `manifest` and `signing_keys` (signatures). README.md describes how each
built-in model was trained.
"""

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from neurove_core.models.bundle import Bundle

DEFAULT: Final = "default"
"""Name of the built-in model that serves unless another one is named."""


@functools.cache
def built_in() -> tuple["Bundle", ...]:
    """All built-in models, and `untrained`, whose estimates mean nothing.

    Raises:
        BadModel: a file of this installation is damaged.
    """
    from neurove_core.models import bundle

    files = sorted(Path(__file__).parent.glob(f"*{bundle.SUFFIX}"))
    return (*(bundle.load(file) for file in files), bundle.untrained(name="untrained"))


def find(model: str) -> "Bundle":
    """Load a model by the name of a built-in one, such as `default`, or by the path of its bundle.

    Raises:
        BadModel: the file is missing or is not a bundle.
    """
    from neurove_core.models import bundle

    for found in built_in():
        if found.name == model:
            return found
    return bundle.load(Path(model))
