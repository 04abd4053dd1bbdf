"""The parser of every command: what it imports, what it says about wrong words, and how it shows defaults."""

import re
import subprocess
import sys

import pytest

from neurove_protocol.errors import EXIT_WRONG_USAGE
from neurove_service.cli import main
from neurove_service.cli.commands import COMMANDS, build_parser
from tests.service.cli.parsers import all_parsers

HEAVY = ("pydantic", "rich", "structlog", "zenoh", "torch", "numba", "numpy")
SLOW = ("zenoh", "torch", "numba")


def imported_by(*arguments):
    """Output of a command, and which modules of HEAVY its process has imported."""
    code = (
        "import sys\nfrom neurove_service.cli.main import main\n"
        f"try:\n    main({list(arguments)!r})\nexcept SystemExit as end:\n    assert not end.code\n"
        f"print(*[name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ran.stdout, ran.stderr.split()


@pytest.mark.parametrize("flag", ["--help", "--version"])
def test_help_and_version_import_nothing_heavy(flag):
    out, heavy = imported_by(flag)
    assert out
    assert heavy == []


def test_the_help_of_a_command_imports_neither_torch_nor_zenoh_nor_numba():
    code = (
        "import sys\nfrom neurove_service.cli.commands import COMMANDS, build_parser\n"
        "build_parser({one.name for one in COMMANDS}).format_help()\n"
        f"print(*[name for name in {SLOW!r} if name in sys.modules])"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []


def test_the_version_is_that_of_the_package_and_of_python(capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(["--version"])
    assert ended.value.code == 0
    assert re.fullmatch(r"neurove \d+\.\d+\.\d+, Python 3\.\d+\.\d+\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["helth"], "neurove: unknown command 'helth': did you mean 'health'?"),
        (["bundle", "sing", "x"], "neurove bundle: unknown command 'sing': did you mean 'sign'?"),
        (["drive", "x", "--sped", "2"], "neurove drive: unknown flag '--sped': did you mean '--speed'?"),
        (["record", "--ot=a.mcap"], "neurove record: unknown flag '--ot': did you mean '--out'?"),
        (["--versoin"], "neurove: unknown flag '--versoin': did you mean '--version'?"),
        (["drive", "x", "--speedy-and-long"], "neurove drive: unknown flag '--speedy-and-long'\n"),
        (["model", "new"], "neurove: unknown command 'model'"),
    ],
)
def test_a_mistyped_command_or_flag_names_the_nearest_one(capsys, words, message):
    with pytest.raises(SystemExit) as ended:
        main.main(words)
    assert ended.value.code == EXIT_WRONG_USAGE
    assert capsys.readouterr().err.startswith(message)


@pytest.mark.parametrize("flag", ["--spe", "--sens"])
def test_flags_cannot_be_abbreviated(capsys, flag):
    with pytest.raises(SystemExit):
        main.main(["drive", "pattern://", flag, "1"])
    assert f"unknown flag '{flag}'" in capsys.readouterr().err


def test_words_after_two_dashes_are_no_flags(run):
    assert "no such file" in run("info", "--", "--sped").err


def test_every_command_of_the_table_has_arguments_and_runs_a_function():
    parsers = all_parsers()
    assert {name.split()[1] for name in parsers if " " in name} == {one.name for one in COMMANDS}
    assert all(parser.commands or callable(parser.get_default("run")) for parser in parsers.values())


def test_only_the_chosen_command_is_loaded():
    parser = build_parser({"config"})
    assert list(parser.commands["config"].commands) == ["show"]
    assert not parser.commands["bundle"].commands


def test_help_shows_defaults_as_people_write_them():
    for name, parser in all_parsers().items():
        text = parser.format_help()
        for word in ("inf", "None", "PosixPath", str(sys.maxsize), "()"):
            assert not re.search(rf"(?<![\w-]){re.escape(word)}(?![\w-])", text), f"{name}: {word}"


def test_every_flag_with_a_default_shows_it():
    for name, parser in all_parsers().items():
        for action in parser.arguments:
            if action.default not in (None, False, [], "==SUPPRESS=="):
                assert "default" in action.help.lower(), f"{name} {action.option_strings or action.dest}"


def test_one_idea_has_one_flag_in_all_commands():
    flags = {flag for parser in all_parsers().values() for one in parser.arguments for flag in one.option_strings}
    assert flags.isdisjoint({"--duration", "--rate", "--sequences"})
    assert flags >= {"--seconds", "--speed", "--calibration-sequences"}
