"""What every command inherits: numbers, paths, signals and the sentences of expected errors."""

import argparse
import ast
import errno
import os
import signal
from pathlib import Path

import pytest

from neurove_service.cli import running
from neurove_service.cli.arguments import count, duration, metres, seconds, seed
from neurove_service.cli.failures import failure
from neurove_service.cli.parser import Parser
from neurove_service.lifecycle import Terminated, interrupt_on_signals
from tests.service.cli.parsers import all_parsers

CLI = Path(running.__file__).parent


def refuses(kind, text):
    parser = Parser(prog="x")
    parser.add_argument("--flag", type=kind)
    with pytest.raises(SystemExit) as ended:
        parser.parse_args([f"--flag={text}"])
    return ended.value.code == 2


def test_no_number_flag_of_any_command_takes_nan_or_more_than_64_bits():
    kinds = [
        action.type
        for parser in all_parsers().values()
        for action in parser.arguments
        if action.type in (int, float, count, duration, metres, seconds, seed)
    ]
    assert len(kinds) > 20
    for kind in set(kinds):
        whole = ["9" * 30, "9" * 5000] if kind in (int, count, seed) else []
        for text in ("nan", "-inf", "", *whole, *([] if kind is duration else ["inf"])):
            assert refuses(kind, text), (kind, text)


@pytest.mark.parametrize("text", ["-1", "1000000000", "1.5", "", "9" * 5000])
def test_a_seed_that_no_generator_takes_is_refused(text):
    assert refuses(seed, text)
    assert seed("999999999") == 999_999_999


def test_an_unbounded_duration_is_infinite():
    assert duration("inf") == float("inf")
    assert duration("2.5") == 2.5
    for text in ("1e10", "nan", "0", "-1"):
        with pytest.raises(argparse.ArgumentTypeError, match="give seconds above 0"):
            duration(text)


@pytest.mark.parametrize("kind", [Path, int, float])
def test_a_parser_checks_the_usual_types(kind, capsys):
    parser = Parser(prog="x")
    parser.add_argument("--flag", type=kind)
    with pytest.raises(SystemExit):
        parser.parse_args(["--flag", ""])
    assert "argument --flag: '': give" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "sentence", "code"),
    [
        (PermissionError(errno.EACCES, "Permission denied", "runs/a"), "runs/a: Permission denied", 2),
        (OSError(errno.ENOSPC, "No space left on device", "out.h5"), "out.h5: No space left on device", 1),
        (OSError(errno.EXDEV, "Invalid cross-device link", "a", None, "b"), "a to b: Invalid cross-device link", 1),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files", 1),
        (MemoryError(), "not enough memory", 1),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), "not enough memory", 1),
        (RuntimeError("can't start new thread"), "cannot start a thread", 1),
    ],
)
def test_errors_of_the_system_are_sentences(error, sentence, code):
    message, exit_code = failure(error, "train")
    assert message.startswith(sentence)
    assert exit_code == code


@pytest.mark.parametrize("error", [RuntimeError("a bug"), OSError("no number"), KeyError("x")])
def test_a_bug_keeps_its_traceback(error):
    assert failure(error, "train") is None


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_command_like_control_c(run, monkeypatch, number, signals_as_before):
    signal.signal(number, signal.SIG_DFL)  # `nohup make test` ignores SIGHUP
    cleaned = []

    def working(*_):
        try:
            os.kill(os.getpid(), number)
            signal.pause()
        finally:
            os.kill(os.getpid(), number)  # a second one does not disturb the cleanup
            cleaned.append(True)

    monkeypatch.setattr(running, "load", working)
    assert run("config", "show") == (128 + number, "", "")
    assert cleaned == [True]


def test_a_signal_while_a_named_tuple_is_made_ends_the_command_just_after(signals_as_before):
    """numba makes one at the end of a compiled loop and does not survive an exception there."""
    where = {"__name__": "namedtuple_Found", "kill": os.kill, "pid": os.getpid(), "number": signal.SIGTERM}
    interrupt_on_signals()
    exec("def make():\n    kill(pid, number)\n    return 'made'", where)
    made = []

    def make_and_wait():
        made.append(where["make"]())
        signal.pause()

    with pytest.raises(Terminated) as ended:
        make_and_wait()
    assert (made, ended.value.number) == (["made"], signal.SIGTERM)


def test_a_hangup_that_is_ignored_stays_ignored(signals_as_before):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    interrupt_on_signals()
    os.kill(os.getpid(), signal.SIGHUP)
    with pytest.raises(Terminated):
        os.kill(os.getpid(), signal.SIGTERM)


def test_every_console_of_the_command_line_is_the_one_that_cleans_text():
    for path in CLI.glob("*.py"):
        if path.name == "console.py":
            continue
        calls = {
            node.func.id
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert not calls & {"Console", "get_console"} or path.name == "demo.py", path  # demo.py draws a picture
