"""Commands on the base install: which work without the extras, and which name the extra that they need."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from neurove_protocol.errors import EXIT_FAILURE, EXIT_WRONG_USAGE
from neurove_service.cli.commands import COMMANDS
from neurove_service.cli.extras import EXTRAS, missing_extra

ROOT = Path(__file__).parents[3]
MODULE_OF = {"ruamel.yaml": "ruamel", "pillow": "PIL", "foxglove-sdk": "foxglove"}
NOWHERE = "tcp/127.0.0.1:9"  # the discard port: nothing listens there

BASE_INSTALL = f"""
import sys
from importlib.abc import MetaPathFinder

class Refuse(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted({module for modules in EXTRAS.values() for module in modules})!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Refuse())
from neurove_service.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def on_base_install(*arguments):
    """Run a command in a process that refuses every library of every extra."""
    command = [sys.executable, "-c", BASE_INSTALL, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (("serve",), "serve"),
        (("bundle", "new", "a.safetensors"), "serve"),
        (("bundle", "keygen"), "serve"),
        (("train", "default"), "train"),
        (("evaluate", "default", "sim://street?seconds=1"), "serve"),
        (("reproduce", "firing"), "experiments"),
        (("bench", "window"), "bench"),
        (("info", "a.aedat4"), "recordings"),
        (("watch", "--foxglove", "--connect", NOWHERE, "--wait", "0"), "foxglove"),
        (("drive", "camera://"), "camera"),
        (("drive", "camera://evk4"), "camera"),
        (("drive", "camera://davis240"), "camera"),
        (("metrics", "--connect", NOWHERE, "--wait", "0"), "metrics"),
    ],
)
def test_a_command_that_lacks_an_extra_names_it(tmp_path, monkeypatch, arguments, extra):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.aedat4").write_bytes(b"#!AER-DAT4.0\r\n")
    ran = on_base_install(*arguments)
    assert (ran.returncode, ran.stdout) == (EXIT_WRONG_USAGE, "")
    needs = f"neurove: this command needs the extra '{extra}': pip install 'neurove[{extra}]' ("
    assert ran.stderr.startswith(needs)
    assert ran.stderr.count("\n") == 1


@pytest.mark.parametrize("command", [one.name for one in COMMANDS])
def test_the_help_of_every_command_needs_no_extra(command):
    ran = on_base_install(command, "--help")
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.startswith(f"usage: neurove {command}")


@pytest.mark.parametrize("command", [["health"], ["models"], ["watch"], ["activate", "other"], ["rollback"]])
def test_a_client_without_extras_reports_that_no_service_answers(command):
    ran = on_base_install(*command, "--connect", NOWHERE, "--wait", "0")
    assert ran.returncode == EXIT_FAILURE
    assert ran.stderr.startswith("neurove: no service: ")


def test_a_network_stream_of_dv_needs_no_extra():
    ran = on_base_install("drive", "dv://127.0.0.1:9", "--wait", "0")
    assert (ran.returncode, ran.stdout) == (EXIT_FAILURE, "")
    assert ran.stderr.startswith("neurove: dv://127.0.0.1:9: no dv network stream at 127.0.0.1:9: ")


def test_cameras_without_its_libraries_names_the_extra():
    ran = on_base_install("cameras")
    assert (ran.returncode, ran.stderr) == (EXIT_FAILURE, "")
    assert "neuromorphic-drivers is not installed: pip install 'neurove[camera]'" in ran.stdout


def test_push_needs_no_extra(tmp_path):
    (tmp_path / "a.safetensors").write_bytes(b"any bytes")
    ran = on_base_install("push", tmp_path / "a.safetensors", "--connect", NOWHERE, "--wait", "0")
    assert (ran.returncode, ran.stderr.startswith("neurove: no service: ")) == (EXIT_FAILURE, True)


def test_drive_publishes_the_built_in_pattern_without_extras():
    ran = on_base_install("drive", "pattern://", "--connect", NOWHERE, "--wait", "0")
    assert ran.returncode == EXIT_FAILURE
    assert ran.stderr.startswith("neurove: no service: ")


def test_a_module_that_no_extra_installs_is_a_bug():
    assert missing_extra(ModuleNotFoundError(name="neurove_core.nothing"), "serve") is None
    assert missing_extra(ModuleNotFoundError(), "serve") is None


@pytest.mark.parametrize(
    ("module", "usual", "extra"),
    [
        ("numba", "recordings", "recordings"),
        ("numba.core", "serve", "serve"),
        ("numba", "", "serve"),
        ("torch", "train", "train"),
        ("h5py", "serve", "recordings"),
        ("carla", "recordings", "carla"),
    ],
)
def test_the_extra_of_the_command_is_named_if_it_installs_the_module(module, usual, extra):
    assert missing_extra(ModuleNotFoundError(name=module), usual).details["extra"] == extra


def test_the_table_of_extras_is_that_of_the_package():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra, modules in EXTRAS.items():
        names = [re.split(r"[<>=;\[ ]", requirement)[0] for requirement in declared[extra]]
        own = {MODULE_OF.get(name, name).replace("-", "_") for name in names if name != "neurove"}
        assert set(modules) == own, extra
