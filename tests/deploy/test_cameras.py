"""The udev rules and the unit of a camera driver: the cameras that are known, a command that exists, USB allowed."""

import configparser
import re
import shlex
from pathlib import Path

import pytest

from neurove_core.live.camera import RULES_FILE
from neurove_core.live.usb import KNOWN, udev_rule
from neurove_service.cli.commands import build_parser

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
RULES = DEPLOY / "70-neurove-cameras.rules"
SOURCES = ("camera://", "camera://evk4?serial=00051234", "dv://192.168.7.9:7777?imu=7778")


def unit():
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.read(DEPLOY / "neurove-driver@.service")
    return parser


def test_the_rules_are_those_that_the_command_prints_for_each_known_camera():
    lines = [line for line in RULES.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    assert lines == [udev_rule(vendor, product) for vendor, product, _ in KNOWN]


def test_the_rules_come_before_the_one_that_gives_access_to_who_sits_at_the_machine():
    assert Path(RULES_FILE).name == RULES.name
    assert int(RULES.name.partition("-")[0]) < 73  # 73-seat-late.rules of systemd reads uaccess


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("options", ["", "--calibration /etc/neurove/cam0.yaml --height 1.2"])
def test_the_unit_runs_a_command_that_exists(source, options):
    line = unit()["Service"]["ExecStart"].replace("$OPTIONS", options).replace("%i", "cam0")
    program, *words = [word.replace("${SOURCE}", source) for word in shlex.split(line)]
    parser = build_parser({words[0]})
    parser.check_words(words)
    args = parser.parse_args(words)
    assert Path(program).name == "neurove"
    assert (args.source, args.stream) == (source, "cam0")


def test_the_unit_reads_its_settings_and_tries_again():
    service = unit()["Service"]
    assert service["EnvironmentFile"] == "/etc/neurove/driver-%i.env"
    assert service["Restart"] == "on-failure"
    assert unit()["Unit"]["StartLimitIntervalSec"] == "0"
    assert {"MemoryMax", "TasksMax"} <= service.keys()


def test_the_unit_may_use_usb_and_no_other_device():
    service = unit()["Service"]
    assert (service["DevicePolicy"], service["DeviceAllow"]) == ("closed", "char-usb_device rw")
    assert "PrivateDevices" not in service
    groups = set(re.findall(r'GROUP="(\w+)"', RULES.read_text(encoding="utf-8")))
    assert groups == set(service["SupplementaryGroups"].split())
