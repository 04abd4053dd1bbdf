"""Who may import whom (STYLE section 2), read from the sources: the offending line is named."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
PRODUCT = ("protocol", "neurove_core", "service")
OF_PROTOCOL = {
    *sys.stdlib_module_names,
    "numpy",
    "msgpack",
    "pydantic",
    "pydantic_core",
    "protocol",
}  # core: pydantic's
APART = ("neurove_core.training", "neurove_core.experiments")


class Import(NamedTuple):
    """One name that a module imports, such as `neurove_core.models.bundle.load`."""

    line: int
    name: str
    lazy: bool  # inside a function: it costs nothing until it is called

    def of(self, *packages: str) -> bool:
        return any(self.name == package or self.name.startswith(package + ".") for package in packages)


def imports_of(source: str, package: str) -> Iterator[Import]:
    """Every import of a module, wherever in it, relative ones made absolute.

    Args:
        source: of the module.
        package: that the module lies in, with dots.
    """
    pending: list[tuple[ast.AST, bool]] = [(ast.parse(source), False)]
    while pending:
        node, lazy = pending.pop()
        for name in names_of(node, package):
            yield Import(getattr(node, "lineno", 0), name, lazy)
        inside = lazy or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        pending += [(child, inside) for child in ast.iter_child_nodes(node)]


def names_of(node: ast.AST, package: str) -> list[str]:
    match node:
        case ast.Import(names=names):
            return [alias.name for alias in names]
        case ast.ImportFrom(module=module, names=names, level=level):
            above = package.split(".")[: len(package.split(".")) - level + 1] if level else []
            base = ".".join([*above, *([module] if module else [])])
            return [f"{base}.{alias.name}" for alias in names]
        case ast.Call(func=ast.Name(id="__import__" | "import_module"), args=[ast.Constant(value=str(name)), *_]):
            return [name]
        case ast.Call(func=ast.Attribute(attr="import_module"), args=[ast.Constant(value=str(name)), *_]):
            return [name]
    return []


def why_not(path: Path, found: Import) -> str | None:
    """Why the module at `path` (relative to the root) may not import this; None if it may."""
    package, module = path.parts[0], Import(0, ".".join(path.with_suffix("").parts), lazy=False)
    if package == "tests":
        private = any(part.startswith("_") and not part.endswith("__") for part in found.name.split("."))
        return "tests use no private names" if private and found.of(*PRODUCT) else None
    if found.of("tests"):
        return "nothing imports tests"
    if package == "protocol":
        allowed = found.name.split(".")[0] in OF_PROTOCOL
        return None if allowed else "protocol imports the standard library, numpy, msgpack and pydantic alone"
    if package == "neurove_core":
        if found.of("zenoh", "service"):
            return "neurove_core knows no network and no service"
        if found.of(*APART) and not module.of(*APART):
            return "training and experiments are imported from inside themselves alone"
        return None
    if found.lazy and (
        module.name == "neurove_service.cli.main" or module.name.startswith("neurove_service.commands_")
    ):
        return None
    if found.of("zenoh") and module.name != "neurove_service.transport":
        return "service imports zenoh in transport.py alone"
    if found.of(*APART):
        return "service imports neither training nor experiments; cli.py and its commands may, inside their functions"
    return None


def offences(root: Path) -> list[str]:
    """`path:line: who may not import what, and why` for every wrong import below a root."""
    return [
        f"{path.relative_to(root).as_posix()}:{one.line}: may not import {one.name}: {reason}"
        for package in (*PRODUCT, "tests")
        for path in sorted((root / package).rglob("*.py"))
        for one in imports_of(path.read_text(), ".".join(path.relative_to(root).parent.parts))
        if (reason := why_not(path.relative_to(root), one))
    ]


def test_every_module_imports_only_what_its_layer_may():
    assert offences(ROOT) == []


def test_the_check_sees_the_whole_tree():
    seen = {path.parent.name for package in PRODUCT for path in (ROOT / package).rglob("*.py")}
    assert {"protocol", "neurove_core", "service"} <= seen
    bundle = (ROOT / "neurove_core" / "bundle.py").read_text()
    assert {"torch", "neurove_core.networks.kinds.Network"} <= {one.name for one in imports_of(bundle, "neurove_core")}


@pytest.mark.parametrize(
    ("path", "line", "name"),
    [
        ("protocol/a.py", "import torch", "torch"),
        ("protocol/a.py", "import zenoh", "zenoh"),
        ("protocol/a.py", "from torch.nn import Module", "torch.nn.Module"),
        ("protocol/a.py", "from neurove_core import bundle", "neurove_core.models.bundle"),
        ("protocol/deep/er.py", "from service import stream", "neurove_service.streams.stream"),
        ("protocol/a.py", "def f():\n    import torch  # here", "torch"),
        ("protocol/a.py", "if TYPE_CHECKING:\n    import torch  # here", "torch"),
        ("protocol/a.py", "try:\n    import scipy  # here\nexcept ImportError:\n    pass", "scipy"),
        ("protocol/a.py", "x = __import__('torch')", "torch"),
        ("protocol/a.py", "x = importlib.import_module('torch.nn')", "torch.nn"),
        ("protocol/a.py", "from tests import builders", "tests.builders"),
        ("neurove_core/a.py", "import zenoh as z", "zenoh"),
        ("neurove_core/io/a.py", "from zenoh import Session", "zenoh.Session"),
        (
            "neurove_core/a.py",
            "from neurove_service.streams.stream import Stream",
            "neurove_service.streams.stream.Stream",
        ),
        ("neurove_core/a.py", "from neurove_core import training", "neurove_core.training"),
        ("neurove_core/a.py", "from . import experiments", "neurove_core.experiments"),
        ("neurove_core/io/a.py", "from ..training import loop", "neurove_core.training.loop"),
        ("neurove_core/a.py", "from .training.loop import fit", "neurove_core.training.loop.fit"),
        (
            "neurove_core/trainings.py",
            "import neurove_core.experiments.sine.data",
            "neurove_core.experiments.sine.data",
        ),
        ("service/node/app.py", "import zenoh", "zenoh"),
        ("service/node/app.py", "def f():\n    from zenoh import Config  # here", "zenoh.Config"),
        ("service/dashboard/transport.py", "import zenoh", "zenoh"),
        ("service/node/app.py", "from neurove_core.training import loop", "neurove_core.training.loop"),
        ("service/transport.py", "def f():\n    import neurove_core.experiments  # here", "neurove_core.experiments"),
        ("service/cli/main.py", "import zenoh", "zenoh"),
        ("service/cli/asking.py", "import zenoh", "zenoh"),
        ("service/commands/asking.py", "def f():\n    import zenoh  # here", "zenoh"),
        ("service/cli/main.py", "class A:\n    from neurove_core import training  # here", "neurove_core.training"),
        (
            "tests/service/test_a.py",
            "from neurove_service.streams.stream import _Sequence",
            "neurove_service.streams.stream._Sequence",
        ),
        ("tests/test_a.py", "import neurove_protocol._private", "neurove_protocol._private"),
    ],
)
def test_a_planted_violation_is_caught_with_its_file_and_line(tmp_path, path, line, name):
    file = tmp_path / path
    file.parent.mkdir(parents=True)
    source = f"import json\n\n{line if 'here' in line else line + '  # here'}\n"
    file.write_text(source)
    number = next(i for i, text in enumerate(source.splitlines(), 1) if text.endswith("# here"))
    (caught,) = offences(tmp_path)
    assert caught.startswith(f"{path}:{number}: may not import {name}: ")


@pytest.mark.parametrize(
    ("path", "line"),
    [
        (
            "protocol/a.py",
            "import json, numpy as np, msgpack, pydantic\nfrom neurove_protocol.errors import NeuroVEError",
        ),
        ("protocol/a.py", "from . import errors\nfrom .errors import shown"),
        (
            "neurove_core/a.py",
            "import torch, numba\nfrom protocol import Events\nfrom neurove_core.models.bundle import _x",
        ),
        ("neurove_core/training/loop.py", "from neurove_core.training import dataset\nfrom . import dataset as d"),
        ("neurove_core/experiments/sine/data.py", "from neurove_core.training import loop"),
        ("service/transport.py", "import zenoh\nfrom protocol import Twist"),
        (
            "service/node/app.py",
            "from neurove_core.estimator import Estimator\nfrom neurove_service.transport import Transport",
        ),
        ("service/cli/experiments.py", "def train():\n    from neurove_core.training import loop"),
        ("service/cli/main.py", "def train():\n    import zenoh\n    from neurove_core.training import loop"),
        (
            "tests/live/test_a.py",
            "import zenoh, torch, neurove_service.cli.main\nfrom neurove_core.training import loop",
        ),
        ("tests/test_a.py", "from __future__ import annotations\nfrom protocol import __doc__\nimport _pytest"),
    ],
)
def test_what_a_layer_may_import_is_not_caught(tmp_path, path, line):
    file = tmp_path / path
    file.parent.mkdir(parents=True)
    file.write_text(line + "\n")
    assert offences(tmp_path) == []
