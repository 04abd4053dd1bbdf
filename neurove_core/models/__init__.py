"""Model bundles: their format and parts, and the models that are built in.

This face is light: `built_in` and `find` import the bundle format when they are called. torch is imported for a model
with random weights, for a baseline, and by whoever asks a bundle for its `network`. The parts are modules: `bundle`
(the file), `metadata` (the optional header fields), `golden` (the stored golden test), `uncertainty` (from log sigma to
a covariance), `manifest` and `signing_keys` (signatures). README.md describes how each built-in model was trained.
"""

import functools
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from neurove_core.models.bundle import Bundle

DEFAULT: Final = "default"
"""Name of the built-in model that serves unless another one is named."""


RANDOM: Final = "untrained"
"""Name of the built-in model with random weights, whose estimates mean nothing."""


@functools.cache
def shipped() -> tuple["Bundle", ...]:
    """The built-in models that this installation has as files; `default` is among them.

    Raises:
        BadModel: a file of this installation is damaged.
    """
    from neurove_core.models import bundle

    return tuple(bundle.load(file) for file in sorted(Path(__file__).parent.glob(f"*{bundle.SUFFIX}")))


def built_in() -> tuple["Bundle", ...]:
    """The built-in models: those of `shipped` and, in a process that has loaded torch, `untrained`.

    A service has not, and a list of models would take seconds and 180 MB more if it did. `find` loads it.

    Raises:
        BadModel: a file of this installation is damaged.
    """
    return (*shipped(), *([untrained()] if "torch" in sys.modules else []))


@functools.cache
def untrained() -> "Bundle":
    """The model with random weights; it loads torch.

    Raises:
        MissingExtra: torch is not installed.
    """
    from neurove_core.models import bundle

    return bundle.untrained(name=RANDOM)


def file_of(model: str) -> Path:
    """The file of the built-in model of this name, such as `default`; else `model` as a path, which may not exist."""
    from neurove_core.models import bundle

    built_in_files = {file.stem: file for file in Path(__file__).parent.glob(f"*{bundle.SUFFIX}")}
    return built_in_files.get(model, Path(model))


def find(model: str) -> "Bundle":
    """Load a model by the name of a built-in one, such as `default`, or by the path of its bundle.

    Raises:
        BadModel: the file is missing or is not a bundle.
        MissingExtra: it is `untrained`, and torch is not installed.
    """
    from neurove_core.models import bundle

    if model == RANDOM:
        return untrained()
    for found in shipped():
        if found.name == model:
            return found
    return bundle.load(Path(model))
