"""The command completion: a script that lets a shell complete commands, flags and file names."""

import argparse
from collections.abc import Container
from typing import Any, Final

from neurove_service.cli.arguments import subcommand
from neurove_service.cli.commands import COMMANDS, build_parser
from neurove_service.cli.parser import Parser

_FILES: Final = ("BUNDLE", "CONFIG", "FILE", "IN", "KEY", "OUT", "PUB", "RECORDING", "SOURCE")
_FOLDERS: Final = ("DIR",)


def bash(_: argparse.Namespace) -> int:
    """Print the script for bash: eval "$(neurove completion bash)"."""
    return _print_script("bash")


def zsh(_: argparse.Namespace) -> int:
    """Print the script for zsh: neurove completion zsh > a folder of $fpath, as _neurove."""
    return _print_script("zsh")


def _print_script(shell: str) -> int:
    import shtab

    parser = build_parser({command.name for command in COMMANDS})
    _complete_paths(parser, _FILES, shtab.FILE)
    _complete_paths(parser, _FOLDERS, shtab.DIRECTORY)
    print(shtab.complete(parser, shell))
    return 0


def _complete_paths(parser: Parser, metavars: Container[Any], paths: Any) -> None:
    for action in parser.arguments:
        if action.metavar in metavars:
            action.complete = paths  # type: ignore[attr-defined]  # shtab reads it
    for command in parser.commands.values():
        _complete_paths(command, metavars, paths)


def add_completion(parser: Parser) -> None:
    """Add the commands of `neurove completion`."""
    commands = parser.add_commands()
    for run in (bash, zsh):
        subcommand(commands, run.__name__, run, as_json=False)
