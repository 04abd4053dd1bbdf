"""Which event cameras are on USB, as Linux lists them, and what is missing in words."""

import pytest

from neurove_core.live.camera import MODELS, cameras, open_camera
from neurove_core.live.found import Found
from neurove_core.live.source import NoCamera
from neurove_core.live.usb import KNOWN, udev_rule, usb_cameras
from neurove_protocol import Sensor
from neurove_protocol.errors import InvalidField, NeuroVEError


@pytest.fixture
def bus(tmp_path):
    """Folders as /sys/bus/usb/devices and /dev/bus/usb, and a function that plugs a device in."""
    devices, nodes = tmp_path / "devices", tmp_path / "nodes"
    devices.mkdir()
    (nodes / "002").mkdir(parents=True)
    (devices / "2-1:1.0").mkdir()  # an interface: without numbers

    def plug(vendor, product, *, node=True):
        number = len(list(devices.iterdir()))
        device = devices / f"2-{number}"
        device.mkdir()
        for name, value in (("idVendor", vendor), ("idProduct", product), ("busnum", 2), ("devnum", number)):
            (device / name).write_text(f"{value}\n")
        if node:
            (nodes / "002" / f"{number:03}").touch()

    return devices, nodes, plug


def test_event_cameras_are_found_among_other_devices(bus):
    devices, nodes, plug = bus
    plug("046d", "c52b")  # a mouse
    plug("152A", "841a")
    plug("04b4", "00f5", node=False)
    found = usb_cameras(devices, nodes)
    assert [(one.vendor, one.product, one.accessible) for one in found] == [
        ("04b4", "00f5", False),
        ("152a", "841a", True),
    ]


def test_a_machine_without_a_usb_bus_says_so(tmp_path):
    assert usb_cameras(tmp_path / "none", tmp_path) is None
    listed = cameras(tmp_path / "none", tmp_path)
    assert any("this machine has no USB bus" in one for one in listed.missing)
    assert listed.usable == ()


def test_a_missing_permission_gives_the_line_of_udev(bus):
    devices, nodes, plug = bus
    plug("31f7", "0003", node=False)
    listed = cameras(devices, nodes)
    assert listed.rules == (udev_rule("31f7", "0003"),)
    assert any("no permission to use 31f7:0003 (CenturyArks SilkyEvCam)" in one for one in listed.missing)


def test_nothing_plugged_in_is_said_in_words(bus):
    devices, nodes, _ = bus
    assert any("no event camera is plugged in" in one for one in cameras(devices, nodes).missing)


def test_a_found_camera_has_the_url_that_opens_it():
    assert Found("evk4", "Prophesee EVK4", "0005", "USB", None, "x").url == "camera://evk4?serial=0005"
    assert Found("davis240", "DAVIS", None, "USB", None, "x").url == "camera://davis240"


@pytest.mark.parametrize(
    ("url", "error", "why"),
    [
        ("camera://evk5", InvalidField, f"the models are {', '.join(MODELS)}"),
        ("camera://evk4/left", NeuroVEError, "expected camera://, camera://MODEL"),
        ("camera://evk4?port=3", NeuroVEError, "expected camera://, camera://MODEL"),
    ],
)
def test_a_wrong_url_names_the_part(url, error, why):
    with pytest.raises(error) as refused:
        open_camera(url)
    assert why in refused.value.message


def test_a_sensor_is_refused_because_a_camera_knows_its_own():
    with pytest.raises(InvalidField, match="a camera knows the size"):
        open_camera("camera://evk4", Sensor(640, 480))


@pytest.mark.parametrize("model", MODELS)
def test_a_model_that_is_not_plugged_in_is_one_sentence(model):
    with pytest.raises(NoCamera) as refused:
        open_camera(f"camera://{model}?serial=none-has-this-number")
    assert refused.value.message.startswith(f"camera://{model}")
    assert "\n" not in refused.value.message


def test_no_camera_has_the_numbers_of_another():
    assert len({(vendor, product) for vendor, product, _ in KNOWN}) == len(KNOWN)
