"""A tiny model that was trained and calibrated once, for the commands that make and evaluate models."""

import pytest

from neurove_service.cli import main
from tests import tiny


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A folder with tiny.toml and the results of its training in out/; no test changes them."""
    folder = tmp_path_factory.mktemp("train")
    (folder / "tiny.toml").write_text(tiny.toml())
    arguments = [
        "train",
        str(folder / "tiny.toml"),
        "--out",
        str(folder / "out"),
        "--calibration-sequences",
        "16",
        "--json",
    ]
    assert main.main(arguments) == 0
    return folder
