"""Calibration files of ROS, Kalibr and OpenCV: the lens that they hold, and what is refused."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.io.calibration import MAX_BYTES, lens_of, read_calibration, with_lens
from neurove_core.io.formats.pattern import Pattern
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo, Sensor
from neurove_protocol.errors import InvalidField, NeuroVEError
from tests.builders import make_packets
from tests.recordings import ecd_text

pytest.importorskip("ruamel.yaml")

DAVIS = Sensor(346, 260)

ROS = """image_width: 346
image_height: 260
camera_name: davis
camera_matrix:
  rows: 3
  cols: 3
  data: [226.4, 0.0, 173.6, 0.0, 226.1, 133.7, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.3, 0.1, 0.001, -0.002, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""

ECHO = """header:
  frame_id: davis
height: 260
width: 346
distortion_model: equidistant
d:
- -0.048
- 0.011
- -0.055
- 0.0215
k:
- 226.4
- 0.0
- 173.6
- 0.0
- 226.1
- 133.7
- 0.0
- 0.0
- 1.0
---
height: 1
"""

CAMCHAIN = """# a comment
T_cam0_lidar:
  - [1.0, 0.0, 0.0, 0.0]
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.048, 0.011,
    -0.055, 0.0215]
  distortion_model: equidistant
  intrinsics: [226.4, 226.1, 173.6, 133.7]
  resolution: [346, 260]
  rostopic: /davis/left/image_raw
cam1:
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.2, 0.3, 0.4]
  distortion_model: radtan
  intrinsics: [400.0, 401.0, 376.0, 240.0]
  resolution: [752, 480]
"""

OPENCV = """%YAML:1.0
---
calibration_time: "Sun 29 Nov"
image_width: 346
image_height: 260
flags: 0
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 2.2640000000000001e+02, 0., 1.7360e+02, 0.,
       2.2610e+02, 1.3370e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -3.0e-01, 1.0e-01, 1.0e-03, -2.0e-03, 0. ]
"""

OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<DAVIS346_00000123>
  <image_width>346</image_width>
  <image_height>260</image_height>
  <use_fisheye_model>1</use_fisheye_model>
  <camera_matrix type_id="opencv-matrix">
    <rows>3</rows><cols>3</cols><dt>d</dt>
    <data>226.4 0. 173.6 0. 226.1 133.7 0. 0. 1.</data></camera_matrix>
  <distortion_coefficients type_id="opencv-matrix">
    <rows>4</rows><cols>1</cols><dt>d</dt>
    <data>-0.048 0.011 -0.055 0.0215</data></distortion_coefficients>
</DAVIS346_00000123>
</opencv_storage>
"""

PINHOLE = (-0.3, 0.1, 0.001, -0.002, 0.0)
FISHEYE = (-0.048, 0.011, -0.055, 0.0215)


@pytest.fixture
def write(tmp_path):
    numbers = itertools.count()

    def written(text, suffix=".yaml"):
        path = tmp_path / f"lens{next(numbers)}{suffix}"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return str(path)

    return written


@pytest.mark.parametrize(
    ("text", "lens", "distortion"),
    [
        (ROS, "pinhole", PINHOLE),
        (ECHO, "equidistant", FISHEYE),
        (CAMCHAIN, "equidistant", FISHEYE),
        (OPENCV, "pinhole", PINHOLE),
        (OPENCV_XML, "equidistant", FISHEYE),
        ("\ufeff" + ROS.replace("\n", "\r\n"), "pinhole", PINHOLE),
        (
            ROS.replace("plumb_bob", "rational_polynomial").replace("0.0]\nrect", "0.0, 0, 0, 0]\nrect"),
            "pinhole",
            PINHOLE,
        ),
        (CAMCHAIN.replace("equidistant", "none").replace("[-0.048, 0.011,\n    -0.055, 0.0215]", "[]"), "pinhole", ()),
    ],
    ids=["ros", "echo", "kalibr", "opencv", "opencv-xml", "windows", "rational-zeros", "none"],
)
def test_every_layout_gives_the_lens(write, text, lens, distortion):
    found = read_calibration(write(text), DAVIS)
    assert (found.lens, found.distortion, found.sensor) == (lens, distortion, DAVIS)
    assert (found.fx, found.fy, found.cx, found.cy) == (226.4, 226.1, 173.6, 133.7)
    assert found.height_m is None


def test_one_of_several_cameras_is_named_or_the_only_one_of_the_size_is_taken(write):
    file = write(CAMCHAIN)
    assert read_calibration(file, Sensor(752, 480)).fx == 400
    assert read_calibration(f"{file}#cam0", DAVIS).fx == 226.4
    with pytest.raises(InvalidField, match="its cameras are cam0, cam1"):
        read_calibration(f"{file}#cam7", DAVIS)
    with pytest.raises(InvalidField, match=r"image size='752x480': the events' sensor is 346x260"):
        read_calibration(f"{file}#cam1", DAVIS)
    alike = write(CAMCHAIN.replace("[752, 480]", "[346, 260]"))
    with pytest.raises(InvalidField, match=r"2 of its cameras \(cam0 346x260, cam1 346x260\) .*: give FILE#NAME"):
        read_calibration(alike, DAVIS)
    assert read_calibration(f"{alike}#cam1", DAVIS).fx == 400


def test_a_file_whose_name_has_a_number_sign_is_read(write, tmp_path):
    path = tmp_path / "left#1.yaml"
    path.write_text(ROS)
    assert read_calibration(str(path), DAVIS).fx == 226.4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (ROS.replace("346", "640"), "image size='640x260': the events' sensor is 346x260"),
        (ROS.replace("image_width: 346\n", ""), "image size"),
        (ROS.replace("226.4", "-1"), "fx, fy='-1, 226.1': must be above 0 px"),
        (ROS.replace("226.4, 0.0,", "226.4, 3.0,"), "must be fx 0 cx"),
        (ROS.replace("226.4", ".nan"), "a 3x3 matrix of finite numbers"),
        (ROS.replace("226.4,", ""), "a 3x3 matrix of finite numbers"),
        (ROS.replace("plumb_bob", "thin_prism"), "distortion_model='thin_prism': must be plumb_bob"),
        (ROS.replace("-0.002, 0.0]", "-0.002]").replace("0.1, 0.001", "0.001"), "finite coefficients of pinhole"),
        (ROS.replace("0.0]\nrect", "0.0, 0.1, 0, 0]\nrect"), "all further coefficients must be 0"),
        (CAMCHAIN.replace("camera_model: pinhole", "camera_model: omni"), "camera_model='omni': pinhole"),
        (CAMCHAIN.replace("intrinsics: [226.4,", "intrinsics: [0.5, 226.4,"), "four finite numbers"),
        ("a: 1\n", "it has no camera_matrix"),
        ("a: [1, 2\n", "it cannot be parsed"),
        ("just words", "with named fields"),
        ("", "with named fields"),
        ("<a><b></a>", "it cannot be parsed"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "no document type and no entities"),
        ("[" * 5000, "YAML"),
        (b"\x00\xff\x00" * 30, "YAML"),
        (b"x" * (MAX_BYTES + 1), "at most 262,144 bytes"),
    ],
)
def test_what_is_not_a_calibration_of_this_sensor_is_refused_with_the_field(write, text, words):
    with pytest.raises(InvalidField) as raised:
        read_calibration(write(text), DAVIS)
    assert words in str(raised.value)


def test_a_file_that_is_missing_is_one_error(tmp_path):
    with pytest.raises(InvalidField, match="No such file"):
        read_calibration(str(tmp_path / "nowhere.yaml"), DAVIS)


@given(
    which=st.sampled_from([ROS, CAMCHAIN, OPENCV, OPENCV_XML]),
    place=st.floats(0, 1),
    length=st.integers(0, 12),
    data=st.binary(max_size=12),
)
def test_a_damaged_file_gives_a_lens_or_a_declared_error(tmp_path_factory, which, place, length, data):
    text = which.encode()
    at = int(place * len(text))
    path = tmp_path_factory.getbasetemp() / "damaged.yaml"
    path.write_bytes(text[:at] + data + text[at + length :])
    try:
        found = read_calibration(str(path), DAVIS)
    except NeuroVEError:
        return
    assert found.sensor == DAVIS


def test_a_recording_takes_the_lens_of_the_file_and_the_height(write):
    recording = Pattern(sensor=DAVIS)
    used = with_lens(recording, write(ROS), 0.4)
    camera = used.camera("left")
    assert isinstance(camera, CameraInfo)
    assert (camera.stream, camera.fx, camera.height_m) == ("left", 226.4, 0.4)
    assert (used.name, used.sensor, used.endless) == (recording.name, recording.sensor, recording.endless)
    assert next(used.chunks()).n == next(recording.chunks()).n


def test_a_height_replaces_that_of_the_recording_and_keeps_its_lens():
    recording = open_source("sim://street?seconds=1&height=1.5")
    own, found = recording.camera("cam0"), lens_of(recording, None, 0.3)
    assert (own.height_m, found.height_m) == (1.5, 0.3)
    assert found.fx == own.fx
    assert with_lens(recording, None, None) is recording


def test_a_height_needs_a_lens(tmp_path):
    (tmp_path / "events.txt").write_bytes(ecd_text(make_packets(1)[0].events))
    bare = open_source(str(tmp_path), Sensor(64, 48))
    with pytest.raises(InvalidField, match=r"--height=0.4: a height needs a lens, .* give --calibration FILE"):
        lens_of(bare, None, 0.4)
    assert lens_of(bare, None, None) is None
