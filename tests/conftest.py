"""One thread and bounded property tests, so that a run depends neither on cores nor, in CI, on randomness; fixtures."""

import logging
import os
import signal
from typing import NamedTuple

import pytest
import structlog
from hypothesis import settings

from neurove_core.extras import installed
from neurove_service.cli import main

if installed("torch"):  # tests.long.pythons also runs what needs none
    import torch

    torch.set_num_threads(1)
os.environ.setdefault("NEUROVE_AHEAD", "off")  # tests count what is compiled, also where `make wheel` has run


def pytest_collection_modifyitems(items):
    """For `--dist loadgroup`: tests of a file stay together; live tests run one by one in one process.

    Live tests come first, because they take longest and mostly wait.
    """
    for item in items:
        group = "live" if item.get_closest_marker("live") else str(item.path)
        item.add_marker(pytest.mark.xdist_group(group))
    items.sort(key=lambda item: item.get_closest_marker("live") is None)


settings.register_profile("dev", max_examples=25, deadline=None)
settings.register_profile("ci", max_examples=50, deadline=None, derandomize=True, database=None)
settings.load_profile("ci" if os.environ.get("CI") else "dev")


@pytest.fixture(autouse=True)
def logging_as_before():
    """Each test begins with the logging of pytest, whatever a command in a test or in a wider fixture configured."""
    _forget_logging()
    yield
    _forget_logging()


def _forget_logging():
    root = logging.getLogger()
    root.handlers[:] = [one for one in root.handlers if not type(one).__module__.startswith("neurove")]
    root.setLevel(logging.WARNING)
    structlog.reset_defaults()


@pytest.fixture
def signals_as_before():
    handlers = {
        number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
    }
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


class Ran(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def run(capsys, logging_as_before, signals_as_before):
    """Runs one command in this process: its exit code, output and errors."""

    def call(*arguments):
        code = main.main([str(argument) for argument in arguments])
        return Ran(code, *capsys.readouterr())

    return call
