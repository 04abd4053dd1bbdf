"""Arguments that several commands share: their types, their flags, and the settings that they give."""

import argparse
import math
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from neurove_protocol import Sensor
from neurove_protocol.errors import InvalidField, NeuroVEError
from neurove_protocol.keys import NAME_RULE, is_name
from neurove_service import logs
from neurove_service.config import ClientConfig, ServiceConfig, load
from neurove_service.endpoints import check_address

if TYPE_CHECKING:
    from neurove_core.geometry.mounting import Mounting
    from neurove_core.io import Recording
    from neurove_core.live.source import LiveSource

MAX_SECONDS: Final = 1e9
"""Longest time of a flag [s]: 31 years, which clocks and timers can hold."""

Run = Callable[[argparse.Namespace], int]
"""Runs one command and returns its exit code."""


def command(parser: argparse.ArgumentParser, run: Run, *, as_json: bool = True) -> argparse.ArgumentParser:
    """Let a parser run a command, and add `--json` if the command prints JSON too."""
    parser.set_defaults(run=run)
    if as_json:
        parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    return parser


def subcommand(commands: Any, name: str, run: Run, *, as_json: bool = True) -> argparse.ArgumentParser:
    """Add a command to a group; the first line of its function's docstring is its help."""
    about = (run.__doc__ or "").partition("\n")[0]  # empty under PYTHONOPTIMIZE=2
    return command(commands.add_parser(name, help=about, description=about), run, as_json=as_json)


def add_source(parser: argparse.ArgumentParser, **source: Any) -> None:
    """Add the source of events and how to read it."""
    default = f"; default {source['default']}" if source else ""
    about = f"recording, sim:// (the built-in simulator), pattern://, camera:// or dv://HOST:PORT{default}"
    parser.add_argument("source", metavar="SOURCE", help=about, **source)
    add_recording_flags(parser)
    parser.add_argument("--loop", action="store_true", help="start again at the end")


def add_recording_flags(parser: argparse.ArgumentParser) -> None:
    """Add what a recording may not say itself: the sensor's size, the event stream to read, and the unit of time."""
    parser.add_argument("--sensor", type=sensor_size, metavar="WxH", help="sensor size, if the recording lacks it")
    parser.add_argument("--topic", metavar="T", help="event stream to read; default: the recording's first")
    about = "unit of the times in the recording: s, ms, us or ns; default: that of its layout"
    parser.add_argument("--time-unit", choices=("s", "ms", "us", "ns"), metavar="U", help=about)


def add_lens_flags(parser: argparse.ArgumentParser) -> None:
    """Add the lens and the height of the camera, if the recording lacks them."""
    about = "lens of the camera: YAML of ROS, Kalibr or OpenCV, or XML of OpenCV; FILE#NAME for one of several cameras"
    parser.add_argument("--calibration", metavar="FILE", help=about)
    parser.add_argument("--height", type=metres, metavar="M", help="height of the camera above the ground [m]")


def add_refine_flag(parser: argparse.ArgumentParser) -> None:
    """Add whether the angular part of estimates is refined."""
    about = "refine the angular velocity by the events of each window; default auto: if the lens is known"
    parser.add_argument("--refine", choices=("auto", "off"), default="auto", help=about)


def add_axes_flag(parser: argparse.ArgumentParser) -> None:
    """Add the mounting of the inertial unit, if the recording lacks it."""
    about = "axes of the inertial unit along x (right), y (down), z (forward) of the camera, such as -x,y,-z; write "
    parser.add_argument("--imu-axes", metavar="A", help=about + "--imu-axes=A, because of the first dash")


def add_playback_flags(parser: argparse.ArgumentParser, seconds_help: str) -> None:
    """Add how fast and how long a source is played."""
    parser.add_argument(
        "--speed", type=speed, default=1.0, metavar="R", help="sensor seconds per second, or max; default 1.0"
    )
    parser.add_argument("--seconds", type=duration, metavar="S", help=seconds_help)


def add_client_flags(parser: argparse.ArgumentParser) -> None:
    """Add where the service is."""
    _add_settings(parser, ClientConfig, ("connect", "prefix", "zenoh_config"))


def add_service_flags(parser: argparse.ArgumentParser) -> None:
    """Add every setting of the service."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings as TOML")
    _add_settings(parser, ServiceConfig, tuple(ServiceConfig.model_fields))


def _add_settings(
    parser: argparse.ArgumentParser, kind: type[ServiceConfig] | type[ClientConfig], names: tuple[str, ...]
) -> None:
    for name in names:
        field = kind.model_fields[name]
        about = f"{field.description} Default: {_default_text(field.default)}.".replace("%", "%%")
        parser.add_argument("--" + name.replace("_", "-"), metavar=name.upper(), help=about)


def _default_text(value: object) -> str:
    """A default as people write it."""
    if value is None or value in ((), {}):
        return "none"
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def client_config(args: argparse.Namespace) -> ClientConfig:
    """The settings of a client; configures its log."""
    logs.configure("warning")  # what the settings say while they are read
    config, _ = load(ClientConfig, flags(args, ClientConfig))
    logs.configure(config.log_level if "NEUROVE_LOG_LEVEL" in os.environ else "warning")
    return config


def flags(args: argparse.Namespace, kind: type[ServiceConfig] | type[ClientConfig]) -> dict[str, Any]:
    """The settings that the command line gives; None for each that it does not give."""
    return {name: getattr(args, name, None) for name in kind.model_fields}


def address(text: str) -> str:
    """An address to listen on, HOST:PORT."""
    try:
        return check_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def stream_name(text: str) -> str:
    """A name that a stream can have."""
    return _name(text)


def stream_names(text: str) -> tuple[str, ...]:
    """Names of streams with commas between."""
    return tuple(_name(part) for part in text.split(",") if part)


def node_name(text: str) -> str:
    """A name that a node can have."""
    return _name(text)


def _name(text: str) -> str:
    if not is_name(text):
        raise argparse.ArgumentTypeError(f"{text!r}: give {NAME_RULE}")
    return text


def count(text: str) -> int:
    """A whole number above 0."""
    if not (text.isascii() and text.isdecimal() and 0 < int(text) < 1 << 31):
        raise argparse.ArgumentTypeError(f"{text!r}: give a whole number above 0")
    return int(text)


def seed(text: str) -> int:
    """A whole number that every generator of random numbers takes as its seed."""
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        raise argparse.ArgumentTypeError(f"{text!r}: give a whole number from 0 to 999999999")
    return int(text)


def _above_0(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: give {what} above 0")
    return value


def metres(text: str) -> float:
    """A number of metres above 0."""
    return _above_0(text, "metres")


def numbers(text: str) -> tuple[float, float, float]:
    """Three numbers with commas between."""
    try:
        first, second, third = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: give three numbers, such as 0,10,0") from None
    if not all(map(math.isfinite, (first, second, third))):
        raise argparse.ArgumentTypeError(f"{text!r}: give finite numbers")
    return first, second, third


def sigma(text: str) -> float:
    """A standard deviation above 0."""
    return _above_0(text, "a finite number")


def sensor_size(text: str) -> Sensor:
    """A sensor size from the text WIDTHxHEIGHT."""
    width, _, height = text.partition("x")
    try:
        return Sensor(int(width), int(height))
    except (ValueError, NeuroVEError):
        raise argparse.ArgumentTypeError(f"{text!r}: give WIDTHxHEIGHT in pixels, such as 640x480") from None


def speed(text: str) -> float:
    """A factor above 0, or infinity for the text max."""
    try:
        factor = math.inf if text in ("max", "inf") else float(text)
    except ValueError:
        factor = math.nan
    if not factor > 0:
        raise argparse.ArgumentTypeError(f"{text!r}: give a factor above 0, such as 1.0, or max")
    return factor


def seconds(text: str) -> float:
    """A number of seconds above 0, at most MAX_SECONDS."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= MAX_SECONDS:
        raise argparse.ArgumentTypeError(f"{text!r}: give seconds above 0, at most {MAX_SECONDS:,.0f}")
    return value


def duration(text: str) -> float:
    """A number of seconds as `seconds`, or infinity for the text inf: no bound."""
    return math.inf if text in ("inf", "max") else seconds(text)


def tell_faults(recording: "Recording | LiveSource") -> None:
    """Print to stderr what a reader skipped, discarded, lost or could not read: one line for each reason."""
    for fault in recording.faults.found:
        print(f"neurove: {recording.name}: {fault}", file=sys.stderr)


def refuse_existing(what: str, field: str, path: Path, source: str | None, *, force: bool) -> None:
    """Refuse a file to write that exists, unless the user gives --force, and that is the input in any case.

    Args:
        what: the command.
        field: name of the argument.
        path: the file.
        source: the recording that is read; None if none is.
        force: whether an existing file may be replaced.

    Raises:
        InvalidField: the file exists.
    """
    if not path.exists():
        return
    if source is not None and Path(source).exists() and path.samefile(source):
        raise InvalidField(what, field, str(path), "it is the input recording")
    if not force:
        raise InvalidField(what, field, str(path), "the file exists; --force replaces it")


def add_force(parser: argparse.ArgumentParser, name: str) -> None:
    """Add --force, which lets a command replace the file that it writes."""
    parser.add_argument("--force", action="store_true", help=f"replace {name} if it exists")


def mounting_of(what: str, path: Path) -> "Mounting":
    """The pose of a camera in the base of its robot, from a text file of numbers; see `Mounting.from_numbers`.

    Args:
        what: the command.
        path: the file of --extrinsics.

    Raises:
        InvalidField: it has no such numbers.
    """
    from neurove_core.geometry.mounting import Mounting

    return Mounting.from_numbers(str(path), _numbers_in(what, path))


def _numbers_in(what: str, path: Path) -> list[float]:
    """All numbers of a text file, without names before a colon and comments: a matrix as text, YAML or JSON."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InvalidField(what, "--extrinsics", str(path), "is not a text file") from None
    lines = [re.sub(r'"?[A-Za-z_]\w*"?\s*[:=]', " ", line.partition("#")[0]) for line in text.splitlines()]
    words = re.split(r"[\s,;\[\]{}()]+", " ".join(lines))
    try:
        return [float(word) for word in words if word and word != "-"]
    except ValueError as error:
        raise InvalidField(what, "--extrinsics", str(path), f"expected numbers: {error}") from None


def check_folder(what: str, field: str, path: Path) -> None:
    """Create a folder for results, and refuse one that cannot be written, before the work begins.

    Args:
        what: the command.
        field: name of the argument.
        path: the folder.

    Raises:
        InvalidField: it cannot be created or written.
    """
    from neurove_core.files import make_writable

    try:
        make_writable(path)
    except OSError as error:
        raise InvalidField(what, field, str(path), f"files cannot be written: {error.strerror or error}") from None


def commit() -> str:
    """The commit of the running code, with a + after local changes; outside a git checkout the package's version."""
    import importlib.metadata
    import subprocess

    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return importlib.metadata.version("neurove")
