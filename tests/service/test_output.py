"""Standard output of every command: full, closed, narrow, and with text from outside."""

import io
import os
import subprocess
import sys

import pytest
from rich.table import Table
from rich.text import Text

from neurove_service.cli.console import console
from neurove_service.output import OutputError, printable, standard_streams, unfiltered

HOSTILE = "cam0\x1b]0;owned\x07\x1b[2J\r\x9b31m\u202eevil"
CLEAN = "cam0�]0;owned��[2J��31m�evil"
SHOWN = "cam0�]0;owned�[2J�31m�"  # in a table: rich removes the bell and the carriage return


def neurove(*arguments, redirect="", **environment):
    words = " ".join([sys.executable, "-m", "neurove_service.cli", *arguments, redirect])
    return subprocess.run(["bash", "-c", words], capture_output=True, text=True, env=environ(**environment))


def environ(**changes):
    return {**os.environ, **changes}


def test_control_characters_become_replacement_characters_and_layout_stays():
    assert printable(HOSTILE) == CLEAN
    assert printable("a\tb\n±²é") == "a\tb\n±²é"


def test_what_a_command_prints_has_no_control_characters(capsys):
    with standard_streams():
        print(HOSTILE)
        print(HOSTILE, file=sys.stderr)
        sys.stderr.writelines([HOSTILE, "\n"])
    assert capsys.readouterr() == (CLEAN + "\n", f"{CLEAN}\n{CLEAN}\n")


def test_a_table_keeps_its_colours_and_loses_the_control_characters_of_its_text():
    file = io.StringIO()
    table = Table("stream")
    table.add_row(Text(HOSTILE, style="bold red"))
    console(file=file, force_terminal=True, color_system="standard", width=60).print(table)
    written = file.getvalue()
    assert "\x1b[1;31m" in written
    assert SHOWN in written
    assert not any(hostile in written for hostile in ("\x07", "\x1b[2J", "\x1b]0", "\x9b", "\r", "\u202e"))


def test_only_the_console_passes_the_filter(capsys):
    with standard_streams():
        console(force_terminal=True, color_system="standard").print("[bold]x", Text(HOSTILE))
        unfiltered(sys.stdout).write("\x1b[0m")
    out = capsys.readouterr().out
    assert "\x1b[1mx\x1b[0m" in out
    assert SHOWN in out


def test_characters_that_the_encoding_lacks_are_replaced_and_the_stream_is_as_before(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict")
    monkeypatch.setattr(sys, "stdout", stream)
    with standard_streams():
        print("9.81 m/s² \udcff")
    assert sys.stdout is stream
    assert stream.errors == "strict"
    stream.flush()
    assert stream.buffer.getvalue() == b"9.81 m/s? ?\n"


def test_a_closed_stream_is_one_error(monkeypatch):
    stream = io.StringIO()
    stream.close()
    monkeypatch.setattr(sys, "stdout", stream)
    with standard_streams(), pytest.raises(OutputError, match="cannot write to standard output: it is closed"):
        print("x")


@pytest.mark.parametrize(
    ("arguments", "redirect", "why"),
    [
        (("config", "show"), "> /dev/full", "No space left on device"),
        (("--help",), "> /dev/full", "No space left on device"),
        (("config", "show", "--json"), ">&-", "it is closed"),
    ],
)
def test_output_that_fails_is_one_sentence_and_exit_code_1(arguments, redirect, why):
    ran = neurove(*arguments, redirect=redirect)
    assert (ran.returncode, ran.stdout, ran.stderr) == (1, "", f"neurove: cannot write to standard output: {why}\n")


@pytest.mark.parametrize("redirect", ["2>&-", "2> /dev/full"])
def test_a_standard_error_that_fails_changes_neither_output_nor_exit_code(redirect):
    assert neurove("config", "show", redirect=redirect).returncode == 0
    assert neurove("config", "show", "--queue-s", "inf", redirect=redirect).returncode == 2


def test_a_reader_that_leaves_is_no_error():
    ran = neurove("config", "show", redirect="| head -c 0; exit ${PIPESTATUS[0]}")
    assert (ran.returncode, ran.stderr) == (0, "")


def test_python_optimize_changes_no_command():
    code = (
        "from tests.service.cli.parsers import all_parsers\n"
        "print(len([parser.format_help() for parser in all_parsers().values()]))"
    )
    plain, optimised = (
        subprocess.run([sys.executable, *flags, "-c", code], capture_output=True, text=True, check=True).stdout
        for flags in ((), ("-OO",))
    )
    assert plain == optimised
