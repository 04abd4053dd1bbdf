import subprocess
import sys

import pytest

CHECK = """
from neurove_service.limits import LimitTooLow, check_limits
try:
    check_limits()
except LimitTooLow as error:
    print(error)
"""


def checked(before, after=""):
    """Output of a process that checks its limits after `before`."""
    code = f"import resource\n{before}\n{CHECK}{after}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_the_limits_of_this_machine_are_enough():
    assert checked("") == ""


@pytest.mark.parametrize(
    ("limit", "value", "sentence"),
    [
        ("NOFILE", 16, "open files: the limit is 16, a node needs at least 128: raise it (ulimit -n, LimitNOFILE=)"),
        ("AS", 1 << 30, "address space [bytes]: the limit is 1,073,741,824, a node needs at least 4,294,967,296"),
    ],
)
def test_a_limit_that_is_too_low_is_one_sentence(limit, value, sentence):
    assert checked(f"resource.setrlimit(resource.RLIMIT_{limit}, ({value}, {value}))").startswith(sentence)


def test_the_number_of_open_files_is_raised_as_far_as_allowed():
    before = "resource.setrlimit(resource.RLIMIT_NOFILE, (16, 300))"
    assert checked(before, "print(resource.getrlimit(resource.RLIMIT_NOFILE))") == "(300, 300)"
