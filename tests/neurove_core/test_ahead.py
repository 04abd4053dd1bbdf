"""Compiled code that a package brings: found for the same sources anywhere, and for nothing else."""

import os
import subprocess
import sys

import pytest

from neurove_service.cli.processors import PROCESSORS, missing

CALLER = """
import sys
from pathlib import Path
from neurove_core.compiled import ahead
ahead.FOLDER = Path(sys.argv[1])
from neurove_core.compiled import compiled, work, write_ahead
from called import STEP, twice

@compiled
def run(x):
    return twice(x) + STEP

print(run(10.0), work().compiled, work().loaded)
if len(sys.argv) > 2:
    print(write_ahead("this", "all of it", ahead.FOLDER))
print(ahead.complete_for())
"""
CALLED = """
from neurove_core.compiled import compiled

STEP = 1.0

@compiled
def twice(x):
    return 2 * x
"""


@pytest.fixture
def process(tmp_path):
    """Run the code from a folder of its own with an empty cache; returns its output, split into words."""
    count = iter(range(100))

    def run(*more, called=CALLED, **environment):
        place = tmp_path / f"place{next(count)}"
        place.mkdir()
        (place / "called.py").write_text(called)
        (place / "caller.py").write_text(CALLER)
        env = os.environ | {"NUMBA_CACHE_DIR": str(place / "cache"), "NEUROVE_AHEAD": ""} | environment
        env["PYTHONPATH"] = os.pathsep.join([str(place), *sys.path])
        command = [sys.executable, "caller.py", str(tmp_path / "ahead"), *more]
        done = subprocess.run(command, env=env, cwd=place, capture_output=True, text=True, check=True)
        return done.stdout.split(), done.stderr

    return run


def test_code_is_found_in_another_folder_with_an_empty_cache_and_without_any(process, tmp_path):
    assert process("write")[0][:3] == ["21.0", "2", "0"]
    assert process()[0] == ["21.0", "0", "1", "all", "of", "it"]
    assert process(NUMBA_CACHE_LOCATOR_CLASSES="ZipCacheLocator")[0][:3] == ["21.0", "0", "1"]  # nowhere to write
    assert process(NEUROVE_AHEAD="off")[0] == ["21.0", "2", "0"]


def test_code_of_other_sources_or_for_another_processor_is_not_used(process):
    process("write")
    assert process(called=CALLED.replace("STEP = 1.0", "STEP = 2.0"))[0][:3] == ["22.0", "2", "0"]
    assert process(called=CALLED.replace("2 * x", "3 * x"))[0][:3] == ["31.0", "2", "0"]
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "+sse2"}
    assert process(**generic)[0] == ["21.0", "2", "0"]


@pytest.mark.skipif(bool(missing(PROCESSORS["x86-64-v3"])), reason="this machine cannot run code for x86-64-v3")
def test_code_for_a_level_is_used_by_processors_with_more_features(process):
    def as_env(features):
        return {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ",".join(f"+{one}" for one in features)}

    v3 = PROCESSORS["x86-64-v3"]
    process("write", **as_env(v3))
    assert process(**as_env((*v3, "adx")))[0][1] == "0"
    assert process(**as_env(v3[:-1]))[0][1] == "2"


def test_damaged_code_is_reported_and_compiled_instead(process, tmp_path):
    process("write")
    for file in (tmp_path / "ahead").rglob("*.code"):
        file.write_bytes(file.read_bytes()[:100])
    (value, compiled, *_), err = process()
    assert (value, compiled) == ("21.0", "2")
    assert "compiled code in the package is not used: function=run" in err
