"""A tiny model that was trained and calibrated once, for the commands that make and evaluate models."""

import pytest

from neurove_service.cli import main

CONFIG = """
name = "tiny"
[model.canonical]
width = 22
height = 16
[model.network]
channels = [4, 8]
features = 16
hidden = 16
[data]
sequences = 2
seconds = 0.5
[data.cameras]
"pinhole:24x18" = 1.0
[recipe]
steps = 8
batch = 2
segment_windows = 4
chunk_windows = 2
"""


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A folder with tiny.toml and the results of its training in out/; no test changes them."""
    folder = tmp_path_factory.mktemp("train")
    (folder / "tiny.toml").write_text(CONFIG)
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
