"""The argument parser of every command: no abbreviated flags; an unknown command or flag names the nearest one.

`type=int`, `type=float` and `type=Path` of any argument mean `whole_number`, `finite_number` and `given_path` of this
module: no command gets an infinite number, one that no array can hold, or an empty path, which would be the current
folder.
"""

import argparse
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

MAX_WHOLE: Final = 2**63 - 1
"""Largest whole number of an argument: an int64."""


def whole_number(text: str) -> int:
    """A whole number that fits into 64 bits."""
    try:
        number = int(text)
    except ValueError:  # also one of thousands of digits
        raise argparse.ArgumentTypeError(f"{_clipped(text)}: give a whole number") from None
    if abs(number) > MAX_WHOLE:
        raise argparse.ArgumentTypeError(f"{_clipped(text)}: give a whole number of at most 64 bits")
    return number


def finite_number(text: str) -> float:
    """A number that is neither infinite nor NaN."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{_clipped(text)}: give a finite number")
    return number


def given_path(text: str) -> Path:
    """A path that is not empty."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(f"{_clipped(text)}: give a path; the current folder is '.'")
    return Path(text)


def _clipped(text: str) -> str:
    return repr(text if len(text) <= 80 else text[:77] + "...")


_TYPES: Final = {int: whole_number, float: finite_number, Path: given_path}


class Parser(argparse.ArgumentParser):
    """Arguments of one command, or of a group of commands."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)
        for usual, checked in _TYPES.items():
            self.register("type", usual, checked)
        self.commands: dict[str, Parser] = {}

    def add_commands(self) -> Any:
        """Add subcommands, of which the user must give one; `add_parser` of the result adds each."""
        commands = self.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
        self.commands = commands.choices
        return commands

    @property
    def arguments(self) -> tuple[argparse.Action, ...]:
        """Every flag and positional argument."""
        return tuple(self._actions)

    def check_words(self, words: Sequence[str]) -> None:
        """Exit with the nearest known name if a command or a flag is unknown.

        argparse reports missing arguments before unknown flags; a user who mistyped a flag needs the latter.

        Args:
            words: the command line, without the names of the program and of this parser.
        """
        for number, word in enumerate(words, 1):
            if word == "--":
                return
            flag = word.partition("=")[0]
            if word.startswith("--") and " " not in word and flag not in self._option_string_actions:
                self.error(f"unknown flag '{flag}'{_nearest(flag, self._option_string_actions)}")
            if self.commands and not word.startswith("-"):
                if word not in self.commands:
                    self.error(f"unknown command '{word}'{_nearest(word, self.commands)}")
                self.commands[word].check_words(words[number:])
                return

    def error(self, message: str) -> NoReturn:
        """Print what is wrong and where the help is, and exit with 2, as argparse does for wrong usage."""
        self.exit(2, f"{self.prog}: {message}\nSee `{self.prog} --help`.\n")


def _nearest(word: str, known: Iterable[str]) -> str:
    import difflib

    found = difflib.get_close_matches(word, list(known), n=1)
    return f": did you mean '{found[0]}'?" if found else ""
