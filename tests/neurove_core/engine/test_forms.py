"""The table of fast forms in the engine's README names only files, functions and tests that exist."""

import ast
import re
from pathlib import Path

import pytest

import neurove_core.engine

ROOT = Path(__file__).parents[3]
ENGINE = Path(neurove_core.engine.__file__).parent
ROWS = [line for line in (ENGINE / "README.md").read_text().splitlines() if line.startswith("| ")][1:]
NAMES = sorted({name for row in ROWS for name in re.findall(r"`([\w/]+\.py:[\w.]+)`", row)})


def defined(path: Path) -> set[str]:
    """Functions and classes of a file, and the methods of its classes as `Class.method`."""
    kinds = ast.FunctionDef | ast.ClassDef
    found = {node.name: node for node in ast.parse(path.read_text()).body if isinstance(node, kinds)}
    methods = {
        f"{name}.{inner.name}"
        for name, node in found.items()
        if isinstance(node, ast.ClassDef)
        for inner in node.body
        if isinstance(inner, ast.FunctionDef)
    }
    return {*found, *methods}


@pytest.mark.parametrize("name", NAMES)
def test_every_file_and_function_of_the_table_exists(name):
    file, _, what = name.partition(":")
    path = ROOT / file if "/" in file else ENGINE / file
    assert what in defined(path)


@pytest.mark.parametrize("row", ROWS)
def test_every_fast_form_of_the_table_has_a_test(row):
    _, form, reference, test, _ = row.split("|")
    assert form.strip()
    assert reference.strip()
    assert re.fullmatch(r"`tests/[\w/]+\.py:test_\w+`", test.strip())


def test_every_module_with_fast_code_is_in_the_table():
    named = {name.partition(":")[0] for name in NAMES}
    helpers = {"__init__.py", "llvm.py", "tiles.py"}
    assert {path.name for path in ENGINE.glob("*.py")} - helpers <= named
