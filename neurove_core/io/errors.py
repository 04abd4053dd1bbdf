"""What can be wrong with a recording."""

from pathlib import Path

from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError


class UnknownSource(NeuroVEError):
    """What was given names no recording that can be read."""

    code = "unknown_source"

    def __init__(self, source: str | Path, supported: tuple[str, ...], why: str) -> None:
        known = "; ".join(supported)
        super().__init__(f"source {str(source)!r}: {why}; supported are {known}", value=str(source), why=why)


class MissingGeometry(NeuroVEError):
    """The recording does not say how large its sensor is, and nobody else did."""

    code = "missing_geometry"

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: its header has no sensor geometry; give --sensor WIDTHxHEIGHT", value=str(path))


class BrokenRecording(NeuroVEError):
    """The recording can not be read beyond a place; what lies before it is whole."""

    code = "broken_recording"
    exit_code = EXIT_FAILURE

    def __init__(self, path: Path, where: str, why: str) -> None:
        super().__init__(f"{path}: broken at {where}: {why}", value=str(path), where=where, why=why)


class NoCarlaServer(NeuroVEError):
    """No CARLA simulator answers."""

    code = "no_carla_server"

    def __init__(self, host: str, port: int, timeout_s: float, why: str) -> None:
        super().__init__(
            f"no CARLA server answers at {host}:{port} within {timeout_s:g} s: {why}; start one or give its address",
            host=host,
            port=port,
        )
