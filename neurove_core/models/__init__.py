"""Models that come with the package, each a bundle; how they were made stands in their headers."""

import functools
from pathlib import Path
from typing import Final

from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle

DEFAULT: Final = "default"
"""The model that serves where no other is named: how it was trained is in README.md."""


@functools.cache
def built_in() -> tuple[Bundle, ...]:
    """All of them, and `untrained`, whose numbers mean nothing."""
    files = sorted(Path(__file__).parent.glob(f"*{bundle.SUFFIX}"))
    return (*(bundle.load(file) for file in files), bundle.untrained(name="untrained"))


def find(model: str) -> Bundle:
    """The bundle of a file, or of a name such as `default`.

    Raises:
        BadModel: the file is missing or no bundle.
    """
    for found in built_in():
        if found.name == model:
            return found
    return bundle.load(Path(model))
