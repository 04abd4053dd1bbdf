"""Help, log lines and error texts are plain technical English: no private word, in any command or module."""

import ast
import re
from pathlib import Path

import pytest

from tests.service.cli.parsers import all_parsers

ROOT = Path(__file__).parents[3]
PACKAGES = ("protocol", "neurove_core", "service")

PRIVATE = re.compile(
    r"""\b(
    beside | holes? | nobody | somebody | told | tells? | comes?\ along | came\ along | by\ chance | can\ not | noted
    | minded | came\ of\ it | became\ of | what\ became | kept\ fed | taken\ back | takes?\ back | takes?\ it\ back
    | at\ rest | resting | written\ whole | as\ it\ is | for\ what\ this\ is\ worth | catch\ up | owes?
    | keeps?\ house | goes\ before | beforehand | given\ up | twin
    | cut\ (short|off|push|message|file|or) | (is|was|are)\ cut
    )\b""",
    re.VERBOSE | re.IGNORECASE,
)


def modules():
    return sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


LOG_METHODS = ("debug", "info", "warning", "error", "exception", "critical")


@pytest.mark.parametrize("text", ["it runs beside it", "2 holes", "Nobody listens", "can not read", "as it is now"])
def test_a_private_word_is_found(text):
    assert PRIVATE.search(text)


@pytest.mark.parametrize(
    "text", ["the whole file", "it cannot be read", "a retold", "shortcut", "intellect", "noteworthy"]
)
def test_a_plain_word_is_not_found(text):
    assert not PRIVATE.search(text)


@pytest.mark.parametrize(("command", "parser"), list(all_parsers().items()), ids=list(all_parsers()))
def test_the_help_of_every_command_has_no_private_word(command, parser):
    found = [match[0] for match in PRIVATE.finditer(" ".join(parser.format_help().split()))]
    assert found == [], command


def texts_of(call):
    """String literals among the arguments of a call, parts of f-strings included."""
    for argument in [*call.args, *(keyword.value for keyword in call.keywords)]:
        for node in ast.walk(argument):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.lineno, node.value


def calls_that_speak(tree, errors):
    """Calls whose strings people read: of loggers, in `raise`, and of the constructors of `errors`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            yield node.exc
        elif isinstance(node, ast.Call):
            match node.func:
                case ast.Attribute(value=ast.Name(id="log"), attr=name) if name in LOG_METHODS:
                    yield node
                case ast.Attribute(value=ast.Call(func=ast.Name(id="super")), attr="__init__"):
                    yield node
                case ast.Name(id=name) | ast.Attribute(attr=name) if name.endswith("Error") or name in errors:
                    yield node


@pytest.fixture(scope="module")
def errors():
    found = error_classes()
    assert {"BadModel", "NoService", "BrokenRecording"} <= found
    return found


def test_calls_that_speak_are_found():
    source = "log.info('a')\nraise Bad(f'b {x} c')\nValueError('d')\nsuper().__init__('e')\nLate('f')\nprint('g')"
    found = {text for call in calls_that_speak(ast.parse(source), {"Late"}) for _, text in texts_of(call)}
    assert found == {"a", "b ", " c", "d", "e", "f"}


def name_of(base):
    return base.attr if isinstance(base, ast.Attribute) else getattr(base, "id", "")


def error_classes():
    """Names of the packages' classes that derive from an error."""
    classes = [
        node for path in modules() for node in ast.walk(ast.parse(path.read_text())) if type(node) is ast.ClassDef
    ]
    found = {"Exception"}
    while True:
        more = {
            one.name
            for one in classes
            if any(name_of(base) in found or name_of(base).endswith("Error") for base in one.bases)
        }
        if more <= found:
            return found
        found |= more


@pytest.mark.parametrize("path", modules(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_log_lines_and_error_texts_have_no_private_word(path, errors):
    tree = ast.parse(path.read_text())
    found = {
        f"{line}: {text!r}: {match[0]}"
        for call in calls_that_speak(tree, errors)
        for line, text in texts_of(call)
        if (match := PRIVATE.search(text))
    }
    assert found == set()
