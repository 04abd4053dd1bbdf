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
AGAIN = """
import sys
from numba.core import event
from neurove_service.models import precompile
compiled = []
class Listener(event.Listener):
    def on_start(self, one): compiled.append(one)
    def on_end(self, one): pass
event.register("numba:compile", Listener())
precompile.main()
print(len(compiled))
"""


def test_what_the_child_compiled_is_not_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert precompile.in_child(CONFIG, threading.Event(), timeout_s=120)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")}
    assert before
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))  # the cache is by path
    command = [sys.executable, "-P", "-c", AGAIN, CONFIG.model_dump_json()]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert int(out) < len(before) / 2  # small helpers have no cache
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")} == before
