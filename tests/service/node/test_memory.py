import sys

import numba
import numpy as np
import pytest

from neurove_core import models
from neurove_core.estimator import Estimator
from neurove_service.node.memory import CompilerPages, release_compiler

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

HEAD = "7f0000000000-7f0000100000 {access} 00000000 08:01 42 {path}\n"
BODY = "Size: 1024 kB\nRss: 1024 kB\nAnonymous: {written} kB\n"


def test_the_code_of_the_compiler_leaves_memory_and_still_compiles():
    estimator = Estimator(models.find("default"))
    estimator.warm_up()
    numba.njit(lambda x: x + 1)(1)
    assert release_compiler() > 1024
    assert release_compiler() < 1024
    assert numba.njit(lambda x: 3 * x)(np.float32(2)) == 6
    estimator.warm_up()
    assert release_compiler() > 1024


@pytest.mark.parametrize(
    ("access", "path", "written"),
    [
        ("r--p", "/lib/libllvmlite.so", 4),
        ("rw-p", "/lib/libllvmlite.so", 0),
        ("r-xp", "/lib/libc.so.6", 0),
        ("r-xp", "", 0),
    ],
)
def test_pages_that_were_written_or_belong_to_others_stay(tmp_path, access, path, written):
    smaps = tmp_path / "smaps"
    smaps.write_text(HEAD.format(access=access, path=path) + BODY.format(written=written))
    assert release_compiler(smaps) == 0


def test_a_system_without_these_figures_keeps_its_pages(tmp_path):
    assert release_compiler(tmp_path / "none") == 0


def test_pages_return_to_the_system_each_time_that_code_was_loaded():
    pages = CompilerPages()
    Estimator(models.find("default"))
    pages.release()
    numba.njit(lambda x: x + 2)(1)
    pages.release()  # numba compiled this, not the project: nothing to do
    assert release_compiler() > 1024
