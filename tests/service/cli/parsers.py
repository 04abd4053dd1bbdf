"""Every parser of the command line."""

from neurove_service.cli.commands import COMMANDS, build_parser


def all_parsers():
    """The parser of every command and subcommand, by the words that call it."""
    found = {}

    def walk(parser):
        found[parser.prog] = parser
        for command in parser.commands.values():
            walk(command)

    walk(build_parser({command.name for command in COMMANDS}))
    return found
