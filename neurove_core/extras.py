"""The error for a library that only an optional extra of this package installs."""

from neurove_protocol.errors import NeuroVEError


class MissingExtra(NeuroVEError):
    """An optional library is needed and not installed."""

    code = "missing_extra"

    def __init__(self, library: str, extra: str = "experiments") -> None:
        super().__init__(f"{library} is not installed: pip install 'neurove[{extra}]'", library=library, extra=extra)
