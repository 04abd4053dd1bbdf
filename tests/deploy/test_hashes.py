"""hashes.txt: the pins of constraints.txt, complete for every platform that `make` supports."""

import importlib.util
import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PINS = (ROOT / "constraints.txt").read_text(encoding="utf-8")
HASHES = (ROOT / "hashes.txt").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("hashes", ROOT / "deploy" / "hashes.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def requirements(text):
    """What pip reads: one requirement and its hashes per line that a backslash may continue."""
    lines = re.sub(r"\\\n", " ", text).splitlines()
    return {line.partition(" --hash=")[0].strip(): line for line in lines if line and not line.startswith("#")}


def test_every_pin_but_torch_has_hashes_and_nothing_else_has():
    wanted = {line for line in PINS.splitlines() if line and not line.startswith(("#", "torch=="))}
    found = requirements(HASHES)
    assert set(found) == wanted, "run deploy/hashes.py"
    for line in found.values():
        assert re.fullmatch(r"[^\\]+?( +--hash=sha256:[0-9a-f]{64})+", line)


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13"])
@pytest.mark.parametrize(("platform", "machine"), [("linux", "x86_64"), ("linux", "aarch64"), ("darwin", "arm64")])
def test_the_pins_are_all_that_the_tools_of_a_developer_need(python, platform, machine):
    """pip installs the list without dependencies, so each of them must be in it."""
    there = {"python_version": python, "python_full_version": f"{python}.0", "sys_platform": platform}
    there = default_environment() | there | {"platform_machine": machine, "platform_system": platform.capitalize()}
    pinned = {canonicalize_name(one.name) for one in map(Requirement, requirements(PINS)) if holds(one, there, "")}
    seen, todo = set(), [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"]]
    while todo:
        one = Requirement(todo.pop())
        name = canonicalize_name(one.name)
        if str(one) in seen or not holds(one, there, ""):
            continue
        seen.add(str(one))
        if name == "neurove":
            todo += [line for extra in one.extras for line in PROJECT["optional-dependencies"][extra]]
            continue
        assert name in pinned, f"{one} is not in constraints.txt"
        for line in metadata.requires(name) or []:
            needed = Requirement(line)
            if name != "torch" and any(holds(needed, there, extra) for extra in {"", *one.extras}):
                needed.marker = None
                todo.append(str(needed))
    assert len(seen) > 60


def holds(requirement, environment, extra):
    return requirement.marker is None or requirement.marker.evaluate(environment | {"extra": extra})


@pytest.mark.parametrize(
    ("filename", "theirs"),
    [
        ("ruamel.yaml-0.19.1-py3-none-any.whl", True),
        ("ruamel_yaml-0.19.1.tar.gz", True),
        ("RUAMEL-yaml-0.19.1.zip", True),
        ("ruamel.yaml-0.19.10-py3-none-any.whl", False),
        ("ruamel.yaml-0.19.1.post1.tar.gz", False),
        ("ruamel.yaml.clib-0.19.1.tar.gz", False),
        ("ruamel.yaml-0.19.1-py3-none-any.whl.metadata", False),
    ],
)
def test_only_files_of_the_pinned_version_are_listed(tool, filename, theirs):
    assert tool.belongs(filename, "ruamel.yaml", "0.19.1") == theirs
