"""What only an extra of this package brings, and how its absence is told."""

from neurove_protocol.errors import NeuroVEError


class MissingExtra(NeuroVEError):
    """A library that this needs, and that the plain package does without, is not installed."""

    code = "missing_extra"

    def __init__(self, library: str, extra: str = "experiments") -> None:
        super().__init__(f"{library} is not installed: pip install 'neurove[{extra}]'", library=library, extra=extra)
