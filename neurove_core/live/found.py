"""Found: a camera that a library lists."""

from typing import NamedTuple


class Found(NamedTuple):
    """A camera at this machine."""

    model: str  # in a `camera://` URL; empty if it cannot be opened
    about: str  # name of the model
    serial: str | None
    connection: str
    error: str | None  # why the library cannot read the serial number, such as a missing permission
    library: str

    @property
    def url(self) -> str:
        """The URL that opens this camera."""
        return f"camera://{self.model}" + (f"?serial={self.serial}" if self.serial else "")
