"""Errors of recordings: RecordingError and its subclasses."""

from pathlib import Path
from typing import Final

from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError


class RecordingError(NeuroVEError):
    """A recording, or a source of events, cannot be read."""


class UnknownSource(RecordingError):
    """The source is not a recording that can be read."""

    code = "unknown_source"

    def __init__(self, source: str | Path, why: str, supported: tuple[str, ...] = ()) -> None:
        known = f"; supported sources: {'; '.join(supported)}" if supported else ""
        super().__init__(f"source {str(source)!r}: {why}{known}", value=str(source), why=why)


class MissingGeometry(RecordingError):
    """Neither the recording nor the caller gives the sensor size."""

    code = "missing_geometry"

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: its header has no sensor geometry; give --sensor WIDTHxHEIGHT", value=str(path))


ECF_FILTER: Final = 0x8ECF
"""Number of the HDF5 filter of Prophesee's Event Compression Format."""


class MissingFilter(RecordingError):
    """The rows of an HDF5 file are compressed by a filter that is not installed."""

    code = "missing_filter"

    def __init__(self, path: Path, name: str, number: int) -> None:
        known = number == ECF_FILTER
        needs = f"ECF (HDF5 filter {number})" if known else f"HDF5 filter {number}"
        cure = "Prophesee's hdf5_ecf plugin" if known else "the plugin of this filter"
        super().__init__(
            f"{path}: {name} is compressed with {needs}, which is not installed: install {cure} and set "
            "HDF5_PLUGIN_PATH to its folder",
            value=str(path),
            where=name,
            filter=number,
        )


class BrokenRecording(RecordingError):
    """The recording is damaged at one place. All data before it was read."""

    code = "broken_recording"
    exit_code = EXIT_FAILURE

    def __init__(self, path: Path, where: str, why: str) -> None:
        super().__init__(f"{path}: broken at {where}: {why}", value=str(path), where=where, why=why)
        self.where, self.why = where, why


class NoCarlaServer(RecordingError):
    """No CARLA simulator responds."""

    code = "no_carla_server"

    def __init__(self, host: str, port: int, timeout_s: float, why: str) -> None:
        super().__init__(
            f"no CARLA server answers at {host}:{port} within {timeout_s:g} s: {why}; start one or give its address",
            host=host,
            port=port,
        )
