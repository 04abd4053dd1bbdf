"""What the commands' arguments have in common: types, flags, and the settings that they make."""

import argparse
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from neurove_protocol import Sensor
from neurove_protocol.errors import NeuroVEError
from neurove_service import logs
from neurove_service.config import ClientConfig, ServiceConfig, load

BAD_NEWS: Final = 1
WRONG_USAGE: Final = 2
CONFLICT: Final = 3
"""Exit codes; 0 is fine."""

Command = Callable[[argparse.Namespace], int]
"""Runs one command and gives its exit code."""


def command(commands: Any, name: str, run: Command, *, as_json: bool = True) -> argparse.ArgumentParser:
    """A parser of one command, which is described by the first line of what it runs."""
    about = (run.__doc__ or "").splitlines()[0]
    parser: argparse.ArgumentParser = commands.add_parser(name, help=about, description=about)
    parser.set_defaults(run=run)
    if as_json:
        parser.add_argument("--json", action="store_true", help="for machines")
    return parser


def add_source(parser: argparse.ArgumentParser, **source: Any) -> None:
    """The source of events and how it is read."""
    parser.add_argument("source", metavar="SOURCE", help="a recording, or sim:// (the built-in simulator)", **source)
    parser.add_argument("--sensor", type=sensor_size, metavar="WxH", help="sensor size, where the recording lacks it")
    parser.add_argument("--topic", metavar="T", help="which of several event streams, where the recording has names")
    parser.add_argument("--loop", action="store_true", help="begin again at the end")


def add_client_flags(parser: argparse.ArgumentParser) -> None:
    """Where the service is."""
    for name in ("connect", "prefix", "zenoh_config"):
        field = ClientConfig.model_fields[name]
        parser.add_argument("--" + name.replace("_", "-"), metavar=name.upper(), help=field.description)


def add_service_flags(parser: argparse.ArgumentParser) -> None:
    """Every setting of the service."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings as TOML")
    for name, field in ServiceConfig.model_fields.items():
        flag = "--" + name.replace("_", "-")
        parser.add_argument(flag, metavar=name.upper(), help=f"{field.description} Default: {field.default}")


def client_config(args: argparse.Namespace) -> ClientConfig:
    """Settings of a client, and its log made ready."""
    config, _ = load(ClientConfig, flags(args, ClientConfig))
    logs.configure(config.log_level if "NEUROVE_LOG_LEVEL" in os.environ else "warning")
    return config


def flags(args: argparse.Namespace, kind: type[ServiceConfig] | type[ClientConfig]) -> dict[str, Any]:
    """What the command line says of these settings; None where it says nothing."""
    return {name: getattr(args, name, None) for name in kind.model_fields}


def sensor_size(text: str) -> Sensor:
    """WIDTHxHEIGHT."""
    width, _, height = text.partition("x")
    try:
        return Sensor(int(width), int(height))
    except (ValueError, NeuroVEError):
        raise argparse.ArgumentTypeError(f"{text!r}: give WIDTHxHEIGHT in pixels, such as 640x480") from None


def speed(text: str) -> float:
    """A factor above 0, or max, which is infinity."""
    try:
        factor = math.inf if text in ("max", "inf") else float(text)
    except ValueError:
        factor = math.nan
    if not factor > 0:
        raise argparse.ArgumentTypeError(f"{text!r}: give a factor above 0, such as 1.0, or max")
    return factor


def seconds(text: str) -> float:
    """Seconds above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text!r}: give seconds above 0")
    return value


def commit() -> str:
    """The commit of the code that runs, with a + where it was changed since; or the version of the package."""
    import importlib.metadata
    import subprocess

    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return importlib.metadata.version("neurove")
