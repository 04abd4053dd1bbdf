"""The error for a library that only an optional extra of this package installs."""

import importlib.util

from neurove_protocol.errors import NeuroVEError


class MissingExtra(NeuroVEError):
    """An optional library is needed and not installed."""

    code = "missing_extra"

    def __init__(self, library: str, extra: str = "experiments") -> None:
        super().__init__(f"{library} is not installed: pip install 'neurove[{extra}]'", library=library, extra=extra)


def installed(module: str) -> bool:
    """Whether a top-level module can be imported, without importing it."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # hidden from import, as tests do
        return False
