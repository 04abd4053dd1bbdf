"""A real child process that compiles into the cache on disk, and a process that reads it."""

import os
import subprocess
import sys
import threading

import pytest

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
from neurove_core.warming import PARTS, compile_part, is_cold
from neurove_service.models import precompile
config = ModelConfig.model_validate_json(sys.argv[1])
precompile.at_start(config, lambda: None)
before = work().compiled
for part in PARTS:
    compile_part(part, config)
print(before, work().compiled)
"""


def test_what_children_compiled_is_not_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))  # the cache is by path
    command = [sys.executable, "-P", "-c", FIRST_START, CONFIG.model_dump_json()]
    for expected in ("1 1", "0 0"):  # one small kernel shows that the cache is empty
        out = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600).stdout
        assert out.split("\n")[-2] == expected
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")}
    assert before
    assert precompile.in_child(CONFIG, threading.Event(), timeout_s=120)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")} == before
