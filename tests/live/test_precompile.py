"""Real child processes that compile into the cache on disk, and a process that reads it."""

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import neurove_core
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_service.models import precompile

pytestmark = pytest.mark.live

CONFIG = ModelConfig(
    canonical=CanonicalConfig(width=24, height=16), network=NetworkConfig(channels=(8,), features=8, hidden=8)
)
FIRST_START = """
import sys
from neurove_core.compiled import work
from neurove_core.config import ModelConfig
from neurove_core.warming import PARTS, compile_part
from neurove_service.models import precompile
config = ModelConfig.model_validate_json(sys.argv[1])
precompile.at_start(config, lambda: None)
before = work().compiled
for part in PARTS:
    compile_part(part, config)
print(before, work().compiled)
"""


def test_what_children_compiled_is_not_compiled_again_and_what_is_stale_is_theirs_too(tmp_path, monkeypatch):
    package = tmp_path / "neurove_core"
    shutil.copytree(Path(neurove_core.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__", "ahead"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, sys.path)]))  # the cache is by path
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    command = [sys.executable, "-P", "-c", FIRST_START, CONFIG.model_dump_json()]

    def start():
        out = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600).stdout
        return out.split("\n")[-2]

    def code():
        return {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.nb*")}

    assert start() == "1 1"  # one small kernel shows that the cache is empty
    assert start() == "0 0"
    before = code()
    assert before
    changed = package / "engine" / "cells.py"
    changed.write_text(changed.read_text() + "\n# an update\n")
    assert start() == "0 0"
    after = code()
    assert {path for path in after if after[path] != before.get(path)}
    assert start() == "0 0"
    assert code() == after


def test_a_child_compiles_a_network_once(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert precompile.in_child(CONFIG, threading.Event(), timeout_s=300)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")}
    assert before
    assert precompile.in_child(CONFIG, threading.Event(), timeout_s=300)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")} == before
