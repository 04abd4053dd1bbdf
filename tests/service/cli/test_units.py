"""neurove install-units: what is written, what is kept, and who may write."""

import re
import sys
from pathlib import Path

import pytest

from neurove_service.cli import units
from neurove_service.config import ServiceConfig, load

DEPLOY = Path(__file__).parents[3] / "deploy"
UNIT, SETTINGS = "etc/systemd/system/neurove.service", "etc/neurove/neurove.toml"


@pytest.fixture(autouse=True)
def _installed_in_opt(monkeypatch):
    monkeypatch.setattr(sys, "prefix", "/opt/elsewhere")


def test_a_dry_run_shows_every_file_and_writes_nothing(run, tmp_path):
    shown = run("install-units", "--dry-run", "--root", str(tmp_path))
    assert shown.code == 0
    for name in (UNIT, SETTINGS, "etc/systemd/system/zenoh-router.service", "etc/neurove/zenoh-router.json5"):
        assert f"would be new: {tmp_path / name}" in shown.out
    assert "systemctl enable --now zenoh-router neurove" in shown.out
    assert list(tmp_path.iterdir()) == []


def test_units_name_the_programs_of_this_installation_and_are_otherwise_those_of_deploy(run, tmp_path):
    assert run("install-units", "--root", str(tmp_path)).code == 0
    for name in ("neurove.service", "zenoh-router.service"):
        written = (tmp_path / "etc/systemd/system" / name).read_text()
        assert re.search(r"^ExecStart=/opt/elsewhere/bin/(neurove|python) ", written, re.MULTILINE)
        assert written.replace("/opt/elsewhere/bin/", "/opt/neurove/venv/bin/") == (DEPLOY / name).read_text()
    config, _ = load(ServiceConfig, {}, tmp_path / SETTINGS)
    assert config.mode == "client"


def test_settings_of_the_user_are_kept_and_an_old_unit_is_replaced(run, tmp_path):
    run("install-units", "--root", str(tmp_path))
    (tmp_path / SETTINGS).write_text('node = "mine"\n')
    (tmp_path / UNIT).write_text("[Unit]\n")
    again = run("install-units", "--root", str(tmp_path))
    assert f"kept: {tmp_path / SETTINGS}" in again.out
    assert f"replaced: {tmp_path / UNIT}" in again.out
    assert (tmp_path / SETTINGS).read_text() == 'node = "mine"\n'
    assert "ExecStart=" in (tmp_path / UNIT).read_text()


def test_without_the_router_only_the_service_is_installed(run, tmp_path):
    shown = run("install-units", "--no-router", "--root", str(tmp_path))
    assert "zenoh-router" not in shown.out
    assert not list(tmp_path.rglob("*router*"))


def test_only_root_writes_to_the_machine(run, monkeypatch):
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    refused = run("install-units")
    assert (refused.code, refused.out) == (2, "")
    assert refused.err == "neurove: only root may write units; --dry-run shows what would be written\n"
    assert run("install-units", "--dry-run").code == 0


@pytest.mark.parametrize("prefix", ["/home/robot/venv", "/root/venv"])
def test_an_installation_that_the_units_would_hide_is_refused(run, monkeypatch, tmp_path, prefix):
    monkeypatch.setattr(sys, "prefix", prefix)
    refused = run("install-units", "--root", str(tmp_path))
    assert (refused.code, list(tmp_path.iterdir())) == (2, [])
    assert "the units hide /home and /root" in refused.err
    assert "the units hide /home and /root" in run("install-units", "--dry-run", "--root", str(tmp_path)).err


def test_a_file_that_is_not_installed_is_named():
    with pytest.raises(units.InstallError, match="nothing.service is not part of this installation"):
        units.shipped("nothing.service")
