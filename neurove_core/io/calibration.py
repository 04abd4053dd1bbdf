"""Calibration files of a camera: its lens from the file that a calibration tool wrote.

Layouts, chosen by content:

- ROS camera_info, as camera_calibration writes it and `ros2 topic echo` prints it: `image_width`, `image_height` (or
  `width`, `height`), `camera_matrix` (or `k`), `distortion_coefficients` (or `d`), `distortion_model`.
- OpenCV FileStorage, YAML or XML, as its calibration programs write it: the same names, with matrices of the type
  `opencv-matrix`; `fisheye_model` names the lens. One level below the top, each camera may have its own name.
- Kalibr camchain: `cam0`, `cam1`, ... with `camera_model`, `intrinsics`, `distortion_model`, `distortion_coeffs` and
  `resolution`.

A file with several cameras needs the name of one: FILE#cam1. Without a name, the only camera whose size is that of the
sensor is read.

Sources: sensor_msgs/CameraInfo (ROS), Kalibr wiki "yaml formats", OpenCV 4 documentation of cv::FileStorage.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Protocol

from neurove_core.extras import MissingExtra
from neurove_core.files import pointer_fault
from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.faults import Faults
from neurove_core.io.recording import Frame, Recording, Triggers
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

MAX_BYTES: Final = 256 << 10
"""Longest calibration file [bytes]; one of a camera has some 2 kB."""

_STREAM: Final = "recording"
_MATRIX: Final = ("cameramatrix", "k", "m", "m1", "intrinsicmatrix")
_COEFFICIENTS: Final = ("distortioncoefficients", "distcoeffs", "distortioncoeffs", "d", "d1")
_WIDTH: Final = ("imagewidth", "width")
_HEIGHT: Final = ("imageheight", "height")
_SIZE: Final = ("resolution", "imagesize", "calibrationimagesize")
_MODEL: Final = ("distortionmodel",)
_FISHEYE: Final = ("fisheyemodel", "usefisheyemodel")

_LENSES: Final[dict[str, Literal["pinhole", "equidistant"]]] = {
    "": "pinhole",
    "none": "pinhole",
    "plumbbob": "pinhole",
    "radtan": "pinhole",
    "rationalpolynomial": "pinhole",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}


def check_calibration(file: str) -> None:
    """Refuse a calibration file that no sensor can use.

    Args:
        file: as of `read_calibration`.

    Raises:
        InvalidField: the file cannot be read, or it has no such camera.
        MissingExtra: as `read_calibration`.
    """
    _named(*_place(file))


def read_calibration(file: str, sensor: Sensor) -> CameraInfo:
    """The lens in a calibration file.

    Args:
        file: path of the file, with #NAME for one of several cameras.
        sensor: size of the pixel array [px]; the calibration must be of this size.

    Returns:
        the lens, without a height.

    Raises:
        InvalidField: the file cannot be read, a field is missing or out of its bound, the lens model is not supported,
            or the calibration is of another size.
        MissingExtra: the library that reads YAML is not installed.
    """
    path, name = _place(file)
    cameras = _named(path, name)
    if name is not None:
        return _fitting(path, _lens(path, cameras[name]), sensor)
    if len(cameras) == 1:
        return _fitting(path, _lens(path, next(iter(cameras.values()))), sensor)
    sizes = {camera: _size(path, _Fields(path, fields)) for camera, fields in cameras.items()}
    fitting = [camera for camera, size in sizes.items() if size == sensor]
    if len(fitting) != 1:
        found = ", ".join(f"{camera} {size}" for camera, size in sizes.items())
        why = f"{len(fitting)} of its cameras ({found}) have the sensor's size {sensor}: give FILE#NAME"
        raise InvalidField(str(path), "camera", None, why)
    return _lens(path, cameras[fitting[0]])


class Source(Protocol):
    """What the lens of a recording or of a live source depends on."""

    @property
    def name(self) -> str:
        """Short name to display."""

    @property
    def sensor(self) -> Sensor:
        """The pixel array."""

    def camera(self, stream: str) -> CameraInfo | None:
        """The camera parameters of the source itself, or None."""


def lens_of(recording: Source, file: str | None, height_m: float | None) -> CameraInfo | None:
    """The lens to use for a recording: that of the file, else its own; at the given height, else at its own.

    Raises:
        InvalidField: as `read_calibration`; or a height is given, and neither the file nor the recording gives a lens.
        MissingExtra: as `read_calibration`.
    """
    own = recording.camera(_STREAM)
    lens = own if file is None else read_calibration(file, recording.sensor)
    if lens is None:
        if height_m is not None:
            why = f"a height needs a lens, and {recording.name} gives none: give --calibration FILE"
            raise InvalidField("camera", "--height", height_m, why)
        return None
    known = height_m if height_m is not None else lens.height_m or (own and own.height_m)
    return CameraInfo(**(lens.model_dump() | {"height_m": known}))


def with_lens(recording: Recording, file: str | None, height_m: float | None) -> Recording:
    """The recording with another lens or height; the recording itself if neither is given.

    Raises:
        InvalidField, MissingExtra: as `lens_of`.
    """
    if file is None and height_m is None:
        return recording
    lens = lens_of(recording, file, height_m)
    return recording if lens is None else _WithLens(recording, lens)


@dataclass(frozen=True, slots=True)
class _WithLens:
    """A recording whose lens the user gives; see `Recording`."""

    recording: Recording
    lens: CameraInfo

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def sensor(self) -> Sensor:
        return self.recording.sensor

    @property
    def endless(self) -> bool:
        return self.recording.endless

    @property
    def streams(self) -> tuple[str, ...]:
        return self.recording.streams

    @property
    def faults(self) -> Faults:
        return self.recording.faults

    def camera(self, stream: str) -> CameraInfo | None:
        return CameraInfo(**(self.lens.model_dump() | {"stream": stream}))

    def chunks(self) -> Iterator[Events]:
        return self.recording.chunks()

    def since(self, t_us: int) -> Iterator[Events]:
        return self.recording.since(t_us)

    def imu(self) -> Iterator[Imu]:
        return self.recording.imu()

    def triggers(self) -> Iterator[Triggers]:
        return self.recording.triggers()

    def frames(self) -> Iterator[Frame]:
        return self.recording.frames()

    def poses(self) -> Poses | None:
        return self.recording.poses()

    def twists(self) -> Twists | None:
        return self.recording.twists()


def _named(path: Path, name: str | None) -> dict[str, Mapping[str, Any]]:
    """The cameras of a file, by name; one of them has this name, if it is given."""
    cameras = dict(_cameras(_tree(path)))
    if not cameras:
        why = "it has no camera_matrix (ROS, OpenCV), intrinsics (Kalibr)"
        raise InvalidField(str(path), "camera_matrix", None, why)
    if name is not None and name not in cameras:
        raise InvalidField(str(path), "camera", name, f"its cameras are {', '.join(cameras)}")
    return cameras


def _place(file: str) -> tuple[Path, str | None]:
    path, separator, name = file.rpartition("#")
    return (Path(path), name) if separator and path and not Path(file).exists() else (Path(file), None)


def _tree(path: Path) -> Mapping[str, Any]:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InvalidField("calibration", "FILE", str(path), error.strerror or str(error)) from None
    if len(data) > MAX_BYTES:
        raise InvalidField("calibration", "FILE", str(path), f"a calibration file has at most {MAX_BYTES:,} bytes")
    if fault := pointer_fault(data):
        raise InvalidField("calibration", "FILE", str(path), fault)
    text = data.decode("utf-8-sig", errors="replace")
    found = _xml(path, text) if text.lstrip().startswith("<") else _yaml(path, text)
    if not isinstance(found, Mapping):
        raise InvalidField(str(path), "content", None, "it is neither YAML nor XML with named fields")
    return found


def _yaml(path: Path, text: str) -> Any:
    try:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError
    except ModuleNotFoundError:
        raise MissingExtra("ruamel.yaml", "recordings") from None
    plain = re.sub(r"\A%YAML[^\n]*", "", text)  # OpenCV writes %YAML:1.0, which is no YAML
    plain = re.sub(r"!!opencv-[\w-]+", "", plain)
    first = re.split(r"^---[ \t]*$", plain.lstrip().removeprefix("---"), maxsplit=1, flags=re.MULTILINE)[0]
    try:
        return YAML(typ="safe", pure=True).load(first)
    except (YAMLError, ValueError, RecursionError) as error:
        why = next(iter(str(error).splitlines()), "") or type(error).__name__
        raise InvalidField(str(path), "YAML", None, f"it cannot be parsed: {why}") from None


def _xml(path: Path, text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InvalidField(str(path), "XML", None, "a calibration file has no document type and no entities")
    try:
        return _of_element(ET.fromstring(text))
    except (ET.ParseError, RecursionError) as error:
        raise InvalidField(str(path), "XML", None, f"it cannot be parsed: {error}") from None


def _of_element(element: ET.Element) -> Any:
    if len(element):
        return {child.tag: _of_element(child) for child in element}
    words = (element.text or "").split()
    return words[0] if len(words) == 1 else words


def _cameras(tree: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The parts of the file that describe one camera, by name; the whole file has the name of none."""
    if _is_camera(tree):
        yield "", tree
        return
    for name, part in tree.items():
        if isinstance(part, Mapping) and _is_camera(part):
            yield str(name), part


def _is_camera(part: Mapping[str, Any]) -> bool:
    names = {_plain(name) for name in part}
    return "intrinsics" in names or any(name in names for name in _MATRIX)


def _plain(name: object) -> str:
    """A name without case and underscores: camera_matrix, Camera_Matrix and cameraMatrix are one."""
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


class _Fields:
    """The fields of one camera, by plain name."""

    def __init__(self, path: Path, fields: Mapping[str, Any]) -> None:
        self.path = path
        self._fields = {_plain(name): value for name, value in fields.items()}

    def get(self, names: tuple[str, ...]) -> Any:
        return next((self._fields[name] for name in names if name in self._fields), None)

    def numbers(self, names: tuple[str, ...], counts: tuple[int, ...], bound: str) -> list[float]:
        """Finite numbers, flat, as many as one of the counts.

        Raises:
            InvalidField: they are missing, not finite, or of another count.
        """
        value = self.get(names)
        flat = _flat(value)
        if flat is None or len(flat) not in counts:
            raise InvalidField(str(self.path), names[0], value, bound)
        return flat

    def text(self, names: tuple[str, ...]) -> str:
        value = self.get(names)
        return "" if value is None else str(value)


def _flat(value: Any) -> list[float] | None:
    """All numbers of a list, of a list of rows, or of a matrix with its data; None if something else is among them."""
    if isinstance(value, Mapping):
        value = next((part for name, part in value.items() if _plain(name) == "data"), None)
    if not isinstance(value, list | tuple):
        return None
    flat: list[float] = []
    for part in value:
        for one in part if isinstance(part, list | tuple) else (part,):
            try:
                number = float(one)
            except (TypeError, ValueError, OverflowError):
                return None
            if not math.isfinite(number):
                return None
            flat.append(number)
    return flat


class _Intrinsics(NamedTuple):
    fx: float
    fy: float
    cx: float
    cy: float


def _lens(path: Path, fields: Mapping[str, Any]) -> CameraInfo:
    known = _Fields(path, fields)
    intrinsics, size = _intrinsics(known), _size(path, known)
    model, distortion = _distortion(known)
    return CameraInfo(
        stream=_STREAM,
        width=size.width,
        height=size.height,
        lens=model,
        distortion=distortion,
        **intrinsics._asdict(),
    )


def _intrinsics(fields: _Fields) -> _Intrinsics:
    if fields.get(("intrinsics",)) is not None:
        model = _plain(fields.text(("cameramodel",)))
        if model not in ("", "pinhole"):
            raise InvalidField(
                str(fields.path), "camera_model", model, "pinhole is supported, with any distortion below"
            )
        found = _Intrinsics(*fields.numbers(("intrinsics",), (4,), "fx, fy, cx, cy in px, four finite numbers"))
    else:
        matrix = fields.numbers(_MATRIX, (9,), "a 3x3 matrix of finite numbers")
        if matrix[1] or any(matrix[i] for i in (3, 6, 7)) or matrix[8] != 1:
            raise InvalidField(str(fields.path), "camera_matrix", str(matrix), "must be fx 0 cx, 0 fy cy, 0 0 1")
        found = _Intrinsics(matrix[0], matrix[4], matrix[2], matrix[5])
    if not (found.fx > 0 and found.fy > 0):
        raise InvalidField(str(fields.path), "fx, fy", f"{found.fx:g}, {found.fy:g}", "must be above 0 px")
    return found


def _size(path: Path, fields: _Fields) -> Sensor:
    bound = "the image size in px, two whole numbers from 1 to 32768"
    width, height = fields.get(_WIDTH), fields.get(_HEIGHT)
    if width is None and height is None:
        pair = fields.numbers(_SIZE, (2,), bound)
    else:
        pair = _flat([width, height]) or [0.0, 0.0]
    if not all(one.is_integer() and 1 <= one <= 1 << 15 for one in pair):
        raise InvalidField(str(path), "image size", f"{width}x{height}", bound)
    return Sensor(int(pair[0]), int(pair[1]))


def _distortion(fields: _Fields) -> tuple[Literal["pinhole", "equidistant"], tuple[float, ...]]:
    named = fields.text(_MODEL)
    if _plain(fields.text(_FISHEYE)) in ("1", "true"):
        named = named or "fisheye"
    lens = _LENSES.get(_plain(named))
    if lens is None:
        known = "plumb_bob, radtan, rational_polynomial with zeros, equidistant, fisheye or none"
        raise InvalidField(str(fields.path), "distortion_model", named, f"must be {known}")
    if fields.get(_COEFFICIENTS) in (None, []):
        return lens, ()
    counts = (4,) if lens == "equidistant" else (0, 4, 5, 8, 12, 14)
    found = fields.numbers(_COEFFICIENTS, counts, f"{', '.join(map(str, counts))} finite coefficients of {lens}")
    if any(found[5:]):
        why = "only k1 k2 p1 p2 k3 are supported, so all further coefficients must be 0"
        raise InvalidField(str(fields.path), "distortion_coefficients", str(found), why)
    return lens, tuple(found[:5])


def _fitting(path: Path, lens: CameraInfo, sensor: Sensor) -> CameraInfo:
    if lens.sensor != sensor:
        raise InvalidField(str(path), "image size", str(lens.sensor), f"the events' sensor is {sensor}")
    return lens
