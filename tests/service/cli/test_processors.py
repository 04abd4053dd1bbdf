import os
import subprocess
import sys

import pytest

from neurove_protocol.errors import InvalidField
from neurove_service.cli.processors import PROCESSORS, missing, settings_for, write_settings

KERNEL = """
from neurove_core.compiled import work
from neurove_core.engine import llvm, vectors
vectors.check()
print(work().compiled, work().loaded)
"""


def compiled_and_loaded(settings):
    env = os.environ | settings | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    out = subprocess.run([sys.executable, "-c", KERNEL], env=env, capture_output=True, text=True, check=True)
    return tuple(map(int, out.stdout.split()))


@pytest.mark.skipif(bool(missing(PROCESSORS["haswell"])), reason="this machine cannot run code for haswell")
def test_code_for_a_named_processor_is_used_by_a_process_that_names_it_and_by_no_other(tmp_path):
    settings = settings_for("haswell", tmp_path)
    assert compiled_and_loaded(settings) == (1, 0)
    read = dict(line.split("=", 1) for line in write_settings(settings, tmp_path).read_text().splitlines())
    assert compiled_and_loaded(read) == (0, 1)
    assert compiled_and_loaded(settings_for("x86-64-v2", tmp_path)) == (1, 0)


def test_code_that_this_machine_cannot_run_is_refused_with_what_it_lacks(tmp_path, monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(InvalidField, match="lacks cx16"):
        settings_for("x86-64-v2", tmp_path)


def test_an_unknown_processor_is_named_with_the_known_ones(run, tmp_path):
    code, _, err = run("warm-up", "--cpu", "pentium", "--out", tmp_path)
    assert code != 0
    assert "pentium" in err
    assert "haswell" in err


def test_a_named_processor_needs_a_folder(run, tmp_path):
    code, _, err = run("warm-up", "--cpu", "haswell")
    assert code != 0
    assert "--out" in err
    (tmp_path / "file").write_text("")
    code, _, err = run("warm-up", "--out", tmp_path / "file")
    assert code != 0
    assert "a folder to write" in err
