"""Machine code that is cached is compiled again after a change of anything that it was made of, in any file."""

import os
import subprocess
import sys

import pytest

CALLER = """
from neurove_core.compiled import compiled, work
import called
from called import STEP, TABLE, twice

@compiled
def run(x):
    return twice(x) + STEP + TABLE[0] + called.OTHER

@compiled
def outer(x):
    return run(x)

print(outer(10.0), work().compiled)
"""
CALLED = """
import numpy as np
from neurove_core.compiled import compiled

STEP = 1.0
OTHER = 0.0
TABLE = np.array([0.0])

@compiled
def twice(x):
    return 2 * x
"""


@pytest.fixture
def answer(tmp_path):
    (tmp_path / "called.py").write_text(CALLED)
    (tmp_path / "caller.py").write_text(CALLER)

    def run():
        env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
        env["PYTHONPATH"] = os.pathsep.join([str(tmp_path), *sys.path])
        done = subprocess.run(
            [sys.executable, "caller.py"], env=env, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        value, compiled = done.stdout.split()
        return float(value), int(compiled)

    return run


def test_cached_code_is_compiled_again_after_a_change_in_another_file(answer, tmp_path):
    assert answer() == (21.0, 3)
    assert answer() == (21.0, 0)
    file = tmp_path / "called.py"
    for old, new, wanted in [
        ("return 2 * x", "return 2.5 * x", 26.0),
        ("STEP = 1.0", "STEP = 2.0", 27.0),
        ("[0.0]", "[1.0]", 28.0),
        ("OTHER = 0.0", "OTHER = 4.0", 32.0),
    ]:
        file.write_text(file.read_text().replace(old, new))
        value, compiled = answer()
        assert value == wanted
        assert compiled > 0
    assert answer() == (32.0, 0)
