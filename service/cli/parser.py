"""The argument parser of every command: no abbreviated flags; an unknown command or flag names the nearest one."""

import argparse
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn


class Parser(argparse.ArgumentParser):
    """Arguments of one command, or of a group of commands."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)
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
