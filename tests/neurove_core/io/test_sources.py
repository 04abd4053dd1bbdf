"""Formats declare themselves: those of this package, and those that another installed package adds."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import neurove_core.io
from neurove_core import sources
from neurove_core.sources import open_source, supported

PAGE = (Path(neurove_core.io.__file__).parent / "README.md").read_text()
TOY, *_ = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
LINES = "0 1 2 1\n5000 3 4 0\n120000 63 47 1\n"


def installed(folder: Path, module: str, entry: str) -> dict[str, str]:
    """The environment of a process that finds a package of its own with one entry point in this folder."""
    (folder / "my_package").mkdir(exist_ok=True)
    (folder / "my_package" / "__init__.py").touch()
    (folder / "my_package" / "toy.py").write_text(module)
    about = folder / "my_package-1.0.dist-info"
    about.mkdir(exist_ok=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{sources.GROUP}]\ntoy = {entry}\n")
    before = os.environ.get("PYTHONPATH", "")
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (str(folder), before)))}


def info(path: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "neurove_service.cli", "info", str(path), "--json"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)


def test_neurove_info_opens_the_format_of_another_installed_package(tmp_path):
    recording = tmp_path / "drive.toy"
    recording.write_text(LINES)
    shown = info(recording, installed(tmp_path, TOY, "my_package.toy:FORMAT"))
    assert shown.returncode == 0, shown.stderr
    summary = json.loads(shown.stdout)
    assert summary["events"] == 3
    assert summary["name"] == "drive.toy"


@pytest.mark.parametrize(
    ("entry", "why"),
    [
        ("my_package.toy:MISSING", "AttributeError"),
        ("my_package.gone:FORMAT", "ModuleNotFoundError"),
        ("json:dumps", "TypeError"),
    ],
)
def test_an_entry_point_that_fails_is_named_and_the_other_formats_open(tmp_path, entry, why):
    environment = installed(tmp_path, TOY, entry)
    recording = tmp_path / "drive.toy"
    recording.write_text(LINES)
    refused = info(recording, environment)
    assert refused.returncode == 2
    assert "unknown suffix '.toy'" in refused.stderr
    assert entry in refused.stderr
    assert why in refused.stderr
    text = tmp_path / "events.txt"
    text.write_text("0.000001 1 2 1\n0.100000 3 4 0\n")
    assert info(text, environment).returncode == 0


def test_every_format_says_what_it_reads_and_no_two_claim_a_suffix_without_looking():
    lines = supported()
    assert len(lines) == len(set(lines)) >= 12
    for name in (".aedat4", ".raw", ".mcap", ".bag", ".h5", ".zip", "sim://", "pattern://"):
        assert any(name in line for line in lines), name


def test_the_readers_of_other_formats_are_not_needed_for_a_url():
    program = (
        "import sys; from neurove_core.sources import open_source; open_source('pattern://'); "
        "print(sorted({'numba', 'h5py', 'torch', 'scipy'} & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert found.stdout.strip() == "[]"


def test_a_suffix_of_any_case_is_recognised(tmp_path):
    path = tmp_path / "EVENTS.TXT"
    path.write_text("0.000001 1 2 1\n0.100000 3 4 0\n")
    assert sum(events.n for events in open_source(str(path)).chunks()) == 2
