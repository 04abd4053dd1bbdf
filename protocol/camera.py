"""CameraInfo: the lens of a camera, so that one network can serve any camera."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from neurove_protocol.codec import Message, Name
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

SCHEMA = "application/msgpack;neurove.camera.1"
"""Zenoh Encoding of a CameraInfo."""

MAX_CAMERA_BYTES = 8192
"""Cap of a CameraInfo."""

MAX_FOCAL_PX = 1e6
MAX_HEIGHT_M = 1e4
"""Bounds of a focal length [px] and of the height above the ground [m]."""

Focal = Annotated[float, Field(ge=1, le=MAX_FOCAL_PX)]
Centre = Annotated[float, Field(ge=-MAX_FOCAL_PX, le=MAX_FOCAL_PX)]
Coefficient = Annotated[float, Field(ge=-MAX_FOCAL_PX, le=MAX_FOCAL_PX)]
Height = Annotated[float, Field(ge=1e-3, le=MAX_HEIGHT_M)]


class CameraInfo(Message):
    """Intrinsics of one stream's camera, in the optical frame (x right, y down, z forward), pixel centres at integers.

    `pinhole` takes the distortion k1 k2 p1 p2 [k3] (radial-tangential, as OpenCV and the Event Camera Dataset);
    `equidistant` takes k1 k2 k3 k4 (fisheye, as Kalibr and MVSEC). An empty list is a lens without distortion.
    """

    what: ClassVar[str] = "camera info"
    max_bytes: ClassVar[int] = MAX_CAMERA_BYTES

    stream: Name
    width: Annotated[int, Field(ge=1, le=1 << 15)]
    height: Annotated[int, Field(ge=1, le=1 << 15)]
    lens: Literal["pinhole", "equidistant"]
    fx: Focal
    fy: Focal
    cx: Centre
    cy: Centre
    distortion: Annotated[tuple[Coefficient, ...], Field(strict=False)] = ()
    height_m: Height | None = None  # height of the camera above the ground plane [m], if known

    @model_validator(mode="after")
    def _distortion_fits_the_lens(self) -> Self:
        allowed = (0, 4, 5) if self.lens == "pinhole" else (0, 4)
        if len(self.distortion) not in allowed:
            counts = ", ".join(map(str, allowed))
            raise InvalidField(self.what, "distortion", self.distortion, f"{self.lens} takes {counts} coefficients")
        return self

    @property
    def sensor(self) -> Sensor:
        """The pixel array these intrinsics belong to."""
        return Sensor(self.width, self.height)
