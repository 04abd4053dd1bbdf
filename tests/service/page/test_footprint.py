"""What the process of the page loads: every package costs memory on a robot's computer."""

import subprocess
import sys

import pytest

LOADED = """
import sys
import neurove_service.page.server
from neurove_service import logs
logs.configure()
print(*sorted({name.partition(".")[0] for name in sys.modules}))
"""


@pytest.fixture(scope="module")
def loaded():
    done = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.parametrize("package", ["rich", "torch", "numba", "scipy", "PIL", "h5py", "mcap"])
def test_the_page_does_not_load_what_it_does_not_need(loaded, package):
    assert "structlog" in loaded
    assert package not in loaded


def test_rich_is_there_for_a_program_that_imports_it_after_the_logs():
    code = "from neurove_service import logs; import rich.console; print(rich.console.Console.__name__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "Console"
