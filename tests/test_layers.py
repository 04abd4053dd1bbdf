"""Who may import whom, read from the sources: a table of rooms, no circle, nothing upwards, and bounded sizes.

A room is a folder of a package, or a file that lies directly in a package. `MAY_IMPORT` says what a room may import;
every room may import `neurove_protocol` and what is installed, except for what `FOREIGN` restricts.
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = {"protocol": "neurove_protocol", "neurove_core": "neurove_core", "service": "neurove_service"}
OF_PROTOCOL = {*sys.stdlib_module_names, "numpy", "msgpack", "pydantic", "pydantic_core", "neurove_protocol"}
MAX_LEVELS = 12
MAX_LINES, MAX_CLASS_LINES = 450, 200

MAY_IMPORT = {
    # neurove_core, from below
    "neurove_core.config": "",
    "neurove_core.compiled": "",
    "neurove_core.files": "",
    "neurove_core.extras": "",
    "neurove_core.tasks": "",
    "neurove_core.cluster": "extras tasks",
    "neurove_core.figures": "files extras",
    "neurove_core.geometry": "config",
    "neurove_core.spiking": "compiled",
    "neurove_core.ingest": "config compiled geometry",
    "neurove_core.networks": "config compiled spiking",
    "neurove_core.engine": "compiled spiking networks",
    "neurove_core.models": "config files extras networks",
    "neurove_core.timescales": "config ingest networks",
    "neurove_core.refine": "compiled geometry ingest",
    "neurove_core.inertial": "",
    "neurove_core.running": "extras ingest networks engine models",
    "neurove_core.warming": "compiled config geometry ingest networks engine models refine running",
    "neurove_core.stream_state": "ingest networks refine timescales",
    "neurove_core.refined": "ingest refine stream_state",
    "neurove_core.estimator": (
        "geometry ingest networks models io refine refined running stream_state timescales warming"
    ),
    "neurove_core.self_test": "config models estimator",
    "neurove_core.aided": "estimator inertial stream_state",
    "neurove_core.carried": "spiking networks refine inertial stream_state timescales",
    "neurove_core.io": "files extras figures geometry",
    "neurove_core.io.formats": "compiled files extras geometry io",
    "neurove_core.sim": "compiled config figures geometry io io.formats",
    "neurove_core.live": "extras io io.formats",
    "neurove_core.sources": "io io.formats live sim",
    "neurove_core.series": "files io.formats sources tasks",
    "neurove_core.evaluation": (
        "compiled figures geometry ingest networks models estimator stream_state inertial aided io sources"
    ),
    "neurove_core.training": (
        "config files extras figures geometry ingest networks "
        "engine models estimator self_test io io.formats sim sources tasks timescales"
    ),
    "neurove_core.adaptation": (
        "config files geometry models estimator self_test io io.formats sources tasks evaluation training"
    ),
    "neurove_core.bench": (
        "config compiled figures geometry spiking ingest networks engine models refine estimator sim sources"
    ),
    "neurove_core.experiments": (
        "config files extras figures geometry spiking ingest networks engine models estimator stream_state io sim "
        "sources evaluation training tasks"
    ),
    "neurove_core": "spiking models estimator sources",
    # neurove_service
    "neurove_service.output": "",
    "neurove_service.log_writer": "",
    "neurove_service.logs": "output log_writer",
    "neurove_service.lifecycle": "",
    "neurove_service.latency": "",
    "neurove_service.clock_offset": "",
    "neurove_service.limits": "",
    "neurove_service.endpoints": "",
    "neurove_service.labels": "",
    "neurove_service.config": "core:files endpoints labels",
    "neurove_service.guard": "logs",
    "neurove_service.desk": "",
    "neurove_service.transport": "logs guard desk endpoints",
    "neurove_service.streams": (
        "core:config core:geometry core:ingest core:networks core:models core:estimator "
        "core:stream_state core:inertial core:aided core:carried logs guard clock_offset"
    ),
    "neurove_service.models": (
        "core:config core:extras core:files core:ingest core:networks core:models core:estimator core:self_test"
        " core:warming logs guard streams"
    ),
    "neurove_service.metrics": "logs guard",
    "neurove_service.clients": (
        "core:config core:geometry core:ingest core:io core:io.formats core:live core:bench logs guard config "
        "transport clock_offset metrics"
    ),
    "neurove_service.ros2": "core:extras core:geometry core:io core:io.formats clock_offset guard logs transport",
    "neurove_service.node": (
        "core:compiled core:files core:geometry core:models logs guard lifecycle latency endpoints config transport "
        "streams models metrics"
    ),
    "neurove_service.fleet": "core:files logs config labels transport clients",
    "neurove_service.page": "logs config guard transport clients",
    "neurove_service": "",
    "neurove_service.cli": "*",
    "neurove_protocol": "",
}


class Import(NamedTuple):
    """One name that a module imports, such as `neurove_core.models.bundle.load`."""

    line: int
    name: str

    def of(self, *packages: str) -> bool:
        return any(self.name == package or self.name.startswith(package + ".") for package in packages)


def imports_of(source: str, package: str) -> Iterator[Import]:
    """Every import of a module, wherever in it, relative ones made absolute; `package` is what the module lies in."""
    for node in ast.walk(ast.parse(source)):
        for name in names_of(node, package):
            yield Import(getattr(node, "lineno", 0), name)


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


def dotted(path: Path) -> str:
    """The name of the module at a path relative to the root; a package is named as its folder."""
    parts = [FOLDERS.get(path.parts[0], path.parts[0]), *path.with_suffix("").parts[1:]]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(name: str) -> str | None:
    """The room that a dotted name lies in: the longest entry of the table that begins it."""
    rooms = [room for room in MAY_IMPORT if name == room or name.startswith(room + ".")]
    return max(rooms, key=len, default=None)


def allowed(room: str) -> set[str]:
    top = room.partition(".")[0]
    full = {"core": "neurove_core"}
    names = (entry.rpartition(":")[::2] for entry in MAY_IMPORT[room].split())
    return {room, "neurove_protocol", *(f"{full.get(prefix, top)}.{name}" for prefix, name in names)}


def why_not(path: Path, found: Import) -> str | None:
    """Why the module at `path` (relative to the root) may not import this; None if it may."""
    top = path.parts[0]
    if top == "tests":
        private = any(part.startswith("_") and not part.endswith("__") for part in found.name.split("."))
        return "tests use no private names" if private and found.of(*FOLDERS.values()) else None
    if found.of("tests"):
        return "nothing imports tests"
    if found.of("protocol", "service"):
        return "the packages are named neurove_protocol and neurove_service"
    if top == "protocol":
        if found.name.split(".")[0] not in OF_PROTOCOL:
            return "protocol imports the standard library, numpy, msgpack and pydantic alone"
        return None
    if found.of("zenoh") and path.as_posix() not in ("service/transport.py", "service/ros2/zenoh_link.py"):
        return "zenoh is imported in service/transport.py and service/ros2/zenoh_link.py alone"
    if not found.of(*FOLDERS.values()):
        return None
    room, other = room_of(dotted(path)), room_of(found.name)
    assert room is not None
    if found.of("neurove_service.cli") and room != "neurove_service.cli":
        return "nothing imports the command line"
    if other in (None, room) or MAY_IMPORT[room] == "*":
        return None
    if any(part.startswith("_") for part in found.name.split(".")):
        return "private names stay in their room"
    return None if other in allowed(room) else f"{room} may not import {other}"


def modules(root: Path) -> dict[str, Path]:
    """Every module of the three packages below a root, by its dotted name; paths relative to the root."""
    paths = [path.relative_to(root) for folder in FOLDERS for path in sorted((root / folder).rglob("*.py"))]
    return {dotted(path): path for path in paths}


def offences(root: Path) -> list[str]:
    """`path:line: may not import what: why` for every wrong import below a root."""
    tests = [path.relative_to(root) for path in sorted((root / "tests").rglob("*.py"))]
    return [
        f"{path.as_posix()}:{one.line}: may not import {one.name}: {reason}"
        for path in (*modules(root).values(), *tests)
        for one in imports_of((root / path).read_text(), dotted(path.parent))
        if (reason := why_not(path, one))
    ]


def arrows(root: Path, *, of_rooms: bool) -> dict[str, set[str]]:
    """Who imports whom, by module or by room."""
    known = modules(root)
    found: dict[str, set[str]] = {}
    for name, path in known.items():
        source = (room_of(name) or name) if of_rooms else name
        into = found.setdefault(source, set())
        for one in imports_of((root / path).read_text(), dotted(path.parent)):
            module = one.name if one.name in known else one.name.rpartition(".")[0]
            if module in known:
                into.add((room_of(module) or module) if of_rooms else module)
    return {source: {other for other in into if other != source} for source, into in found.items()}


def levels(graph: dict[str, set[str]]) -> dict[str, int]:
    """How many steps down each node reaches; a circle raises with its names."""
    depth: dict[str, int] = {}

    def visit(node: str, above: tuple[str, ...]) -> int:
        if node in above:
            raise AssertionError("import circle: " + " -> ".join((*above[above.index(node) :], node)))
        if node not in depth:
            depth[node] = 1 + max((visit(other, (*above, node)) for other in sorted(graph.get(node, ()))), default=0)
        return depth[node]

    for node in sorted(graph):
        visit(node, ())
    return depth


def test_every_module_imports_only_what_its_room_may():
    assert offences(ROOT) == []


def test_the_table_names_rooms_that_exist_and_every_module_has_one():
    known = modules(ROOT)
    assert {room_of(name) for name in known} == set(MAY_IMPORT)
    mentioned = {other for room in MAY_IMPORT if MAY_IMPORT[room] != "*" for other in allowed(room)}
    assert mentioned <= set(MAY_IMPORT)


def test_no_circle_of_modules():
    assert max(levels(arrows(ROOT, of_rooms=False)).values()) > 1


def test_no_circle_of_rooms_and_few_levels():
    depth = levels(arrows(ROOT, of_rooms=True))
    assert 1 < max(depth.values()) <= MAX_LEVELS


def test_a_planted_circle_is_found():
    with pytest.raises(AssertionError, match="import circle: b -> c -> b"):
        levels({"a": {"b"}, "b": {"c"}, "c": {"b"}})


def test_no_module_and_no_class_is_two_things():
    long = []
    for path in modules(ROOT).values():
        source = (ROOT / path).read_text()
        lines = source.count("\n")
        if lines > MAX_LINES:
            long.append(f"{path}: {lines} lines, at most {MAX_LINES}")
        long += [
            f"{path}: class {node.name} has {size} lines, at most {MAX_CLASS_LINES}"
            for node in ast.walk(ast.parse(source))
            if isinstance(node, ast.ClassDef) and (size := (node.end_lineno or 0) - node.lineno + 1) > MAX_CLASS_LINES
        ]
    assert long == []


@pytest.mark.parametrize(
    ("path", "line", "name"),
    [
        ("protocol/a.py", "import torch", "torch"),
        ("protocol/a.py", "import zenoh", "zenoh"),
        ("protocol/a.py", "from neurove_core import models", "neurove_core.models"),
        ("protocol/deep/er.py", "from neurove_service import streams", "neurove_service.streams"),
        ("protocol/a.py", "def f():\n    import torch  # here", "torch"),
        ("protocol/a.py", "if TYPE_CHECKING:\n    import torch  # here", "torch"),
        ("protocol/a.py", "try:\n    import scipy  # here\nexcept ImportError:\n    pass", "scipy"),
        ("protocol/a.py", "x = __import__('torch')", "torch"),
        ("protocol/a.py", "x = importlib.import_module('torch.nn')", "torch.nn"),
        ("protocol/a.py", "from tests import builders", "tests.builders"),
        ("service/node/app.py", "from protocol import Events", "protocol.Events"),
        ("neurove_core/geometry/a.py", "import zenoh as z", "zenoh"),
        ("neurove_core/spiking/a.py", "from neurove_core.engine import cells", "neurove_core.engine.cells"),
        ("neurove_core/spiking/a.py", "from neurove_core.ingest import wire", "neurove_core.ingest.wire"),
        ("neurove_core/spiking/fused/a.py", "from neurove_core.io import errors", "neurove_core.io.errors"),
        ("neurove_core/spiking/a.py", "from neurove_core import geometry", "neurove_core.geometry"),
        ("neurove_core/networks/a.py", "from ..engine import engine", "neurove_core.engine.engine"),
        ("neurove_core/io/a.py", "from neurove_core.sim import simulate", "neurove_core.sim.simulate"),
        ("neurove_core/io/a.py", "from neurove_core.io.formats import ecd", "neurove_core.io.formats.ecd"),
        ("neurove_core/io/formats/a.py", "from neurove_core import sources", "neurove_core.sources"),
        (
            "neurove_core/models/a.py",
            "from neurove_core.estimator import Estimator",
            "neurove_core.estimator.Estimator",
        ),
        ("neurove_core/estimator.py", "from neurove_core.training.loop import fit", "neurove_core.training.loop.fit"),
        ("neurove_core/training/a.py", "from . import curve, _curve", "neurove_core.training._curve"),
        ("neurove_core/training/a.py", "import neurove_core.experiments.sine", "neurove_core.experiments.sine"),
        ("neurove_core/config.py", "from neurove_service.config import load", "neurove_service.config.load"),
        ("service/node/app.py", "import zenoh", "zenoh"),
        ("service/node/app.py", "def f():\n    from zenoh import Config  # here", "zenoh.Config"),
        ("service/dashboard/transport.py", "import zenoh", "zenoh"),
        ("service/node/app.py", "from neurove_core.training import loop", "neurove_core.training.loop"),
        ("service/node/app.py", "from neurove_service.cli import main", "neurove_service.cli.main"),
        ("service/streams/a.py", "from neurove_service.models import slot", "neurove_service.models.slot"),
        ("service/models/a.py", "from neurove_service.node import app", "neurove_service.node.app"),
        ("service/clients/a.py", "def f():\n    import neurove_core.training  # here", "neurove_core.training"),
        ("service/cli/main.py", "import zenoh", "zenoh"),
        (
            "tests/service/test_a.py",
            "from neurove_service.streams.stream import _x",
            "neurove_service.streams.stream._x",
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
    if "_curve" in name:  # inside a room private modules are its own
        assert offences(tmp_path) == []
        return
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
        ("neurove_core/estimator.py", "import torch, numba\nfrom neurove_protocol import Events"),
        ("neurove_core/training/loop.py", "from neurove_core.training import dataset\nfrom . import dataset as d"),
        ("neurove_core/experiments/sine/a.py", "from neurove_core.training import loop"),
        ("service/transport.py", "import zenoh\nfrom neurove_protocol import Twist"),
        ("service/node/app.py", "from neurove_service.models.slot import ModelSlot"),
        ("service/cli/experiments.py", "def train():\n    from neurove_core.training import loop"),
        (
            "tests/live/test_a.py",
            "import zenoh, torch, neurove_service.cli.main\nfrom neurove_core.training import loop",
        ),
        ("tests/test_a.py", "from __future__ import annotations\nfrom neurove_protocol import __doc__\nimport _pytest"),
    ],
)
def test_what_a_room_may_import_is_not_caught(tmp_path, path, line):
    file = tmp_path / path
    file.parent.mkdir(parents=True)
    file.write_text(line + "\n")
    assert offences(tmp_path) == []
