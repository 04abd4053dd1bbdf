"""Simulated cameras: real cameras by name, any pinhole, and the ray of each pixel."""

import math
import re
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.camera import undistort
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

STREAM: Final = "sim"
TILE: Final = 8
"""Side of a tile [px]; all pixels of a tile are rendered at one rate."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A lens on its mount: `info` has the intrinsics and the height above the ground."""

    name: str
    info: CameraInfo
    pitch_deg: float = 5.0  # downwards

    @property
    def height_m(self) -> float:
        """Height above the ground [m]."""
        return self.info.height_m or DEFAULT_HEIGHT_M


DEFAULT_HEIGHT_M: Final = 1.5
DEFAULT_CAMERA: Final = "davis346-half"

_DAVIS346: Final = CameraInfo(  # MVSEC, camchain-imucam-indoor_flying.yaml, cam0 (the left DAVIS)
    stream=STREAM,
    width=346,
    height=260,
    lens="equidistant",
    fx=226.38018519795807,
    fy=226.15002947047415,
    cx=173.6470807871759,
    cy=133.73271487507847,
    distortion=(-0.048031442223833355, 0.011330957517194437, -0.055378166304281135, 0.021500973881459395),
)
_DAVIS240C: Final = CameraInfo(  # Event Camera Dataset (Mueggler 2017), calib.txt of shapes_rotation and its siblings
    stream=STREAM,
    width=240,
    height=180,
    lens="pinhole",
    fx=199.092366542,
    fy=198.82882047,
    cx=132.192071378,
    cy=110.712660011,
    distortion=(-0.368436311798, 0.150947243557, -0.000296130534385, -0.000759431726241, 0.0),
)
_DAVIS240C_SLIDER: Final = (
    CameraInfo(  # calib.txt of the slider recordings in the same data set, which have a longer lens
        stream=STREAM,
        width=240,
        height=180,
        lens="pinhole",
        fx=335.419462958,
        fy=335.352935612,
        cx=129.924663379,
        cy=99.1864303447,
        distortion=(-0.138592767408, 0.0933736664192, -0.000335586987532, 0.000173720158228, 0.0),
    )
)


def _halved(full: CameraInfo) -> CameraInfo:
    """The same lens with pixels of twice the size: pixel i covers 2i and 2i + 1, with their centre at 2i + 0.5."""
    half = {"width": full.width // 2, "height": full.height // 2, "fx": full.fx / 2, "fy": full.fy / 2}
    return full.model_copy(update=half | {"cx": (full.cx - 0.5) / 2, "cy": (full.cy - 0.5) / 2})


def pinhole(sensor: Sensor, focal_px: float) -> CameraInfo:
    """An ideal lens of this focal length [px], centred on the sensor."""
    return CameraInfo(
        stream=STREAM,
        width=sensor.width,
        height=sensor.height,
        lens="pinhole",
        fx=focal_px,
        fy=focal_px,
        cx=(sensor.width - 1) / 2,
        cy=(sensor.height - 1) / 2,
    )


CAMERAS: Final = {
    "davis346": _DAVIS346,
    "davis346-half": _halved(_DAVIS346),
    "davis240c": _DAVIS240C,
    "davis240c-slider": _DAVIS240C_SLIDER,
    # Gen3.1 VGA: 15 um pixels (Prophesee, PPS3MVCD) behind an 8 mm lens: 8 / 0.015 = 533 px, 62 deg across.
    "prophesee": pinhole(Sensor(640, 480), 8 / 0.015),
}
"""Cameras by name."""

_PINHOLE = re.compile(r"pinhole:([0-9]{1,4})x([0-9]{1,4}):([0-9]{1,3}(?:\.[0-9]{1,6})?)")


def named_camera(name: str, height_m: float = DEFAULT_HEIGHT_M, pitch_deg: float = 5.0) -> Camera:
    """Create a camera by its name, with its mount.

    >>> round(named_camera("pinhole:320x240:90").info.fx, 3)
    160.0

    Args:
        name: one of CAMERAS, or `pinhole:WIDTHxHEIGHT:HFOV` with the horizontal field of view in degrees.
        height_m: height above the ground [m].
        pitch_deg: pitch downwards [deg].

    Raises:
        InvalidField: the camera is unknown, or its mount or field of view is out of bounds.
    """
    if not 0.05 <= height_m <= 100:
        raise InvalidField("camera", "height_m", height_m, "must be 0.05 to 100 m")
    if not -60 <= pitch_deg <= 60:
        raise InvalidField("camera", "pitch_deg", pitch_deg, "must be -60 to 60 deg")
    info = CAMERAS.get(name) or _any_pinhole(name)
    return Camera(name, info.model_copy(update={"height_m": height_m}), pitch_deg)


def _any_pinhole(name: str) -> CameraInfo:
    match = _PINHOLE.fullmatch(name)
    if match is None:
        known = ", ".join(CAMERAS)
        raise InvalidField("camera", "camera", name, f"known cameras: {known}, and pinhole:WIDTHxHEIGHT:HFOV_DEG")
    width, height, hfov_deg = int(match[1]), int(match[2]), float(match[3])
    if not 1 <= hfov_deg <= 150:
        raise InvalidField("camera", "hfov_deg", hfov_deg, "must be 1 to 150 deg")
    if not (8 <= width <= 2048 and 8 <= height <= 2048):
        raise InvalidField("camera", "sensor", f"{width}x{height}", "each side must be 8 to 2048 px")
    return pinhole(Sensor(width, height), width / 2 / math.tan(math.radians(hfov_deg) / 2))


class Rays(NamedTuple):
    """The ray (x, y, 1) of each pixel in the optical frame; N pixels in M tiles, tile by tile.

    Pixels without a ray in front of the camera are left out; they have no events.
    """

    x: NDArray[np.float64]  # (N,) of the ray
    y: NDArray[np.float64]  # (N,)
    step_x: NDArray[np.float64]  # (N,) change of x from a pixel to the next one in its row
    step_y: NDArray[np.float64]  # (N,) change of y from a pixel to the next one in its column
    column: NDArray[np.uint16]  # (N,) of the pixel
    row: NDArray[np.uint16]  # (N,)
    first: NDArray[np.int64]  # (M + 1,) tile m has pixels first[m] to first[m + 1] - 1
    tile_row: NDArray[np.int64]  # (M,) of the tile in the grid of tiles
    tile_column: NDArray[np.int64]  # (M,)
    box: NDArray[np.float64]  # (M, 4) least x, least y, greatest x, greatest y of the rays, half a pixel wider


def rays_of(info: CameraInfo) -> Rays:
    """Compute the ray of each pixel of a camera."""
    row, column = np.divmod(np.arange(info.width * info.height), info.width)
    x, y = _ray(info, column, row)
    step_x = _ray(info, column + 0.5, row)[0] - _ray(info, column - 0.5, row)[0]
    step_y = _ray(info, column, row + 0.5)[1] - _ray(info, column, row - 0.5)[1]
    seen = np.flatnonzero(np.isfinite(x + y + step_x + step_y))
    tile = row[seen] // TILE * -(-info.width // TILE) + column[seen] // TILE
    order = seen[np.argsort(tile, kind="stable")]
    names, first = np.unique(np.sort(tile), return_index=True)
    edge_x, edge_y = step_x[order] / 2, step_y[order] / 2
    low = [np.minimum.reduceat(values[order] - edge, first) for values, edge in ((x, edge_x), (y, edge_y))]
    high = [np.maximum.reduceat(values[order] + edge, first) for values, edge in ((x, edge_x), (y, edge_y))]
    tile_row, tile_column = np.divmod(names, -(-info.width // TILE))
    return Rays(
        x[order],
        y[order],
        step_x[order],
        step_y[order],
        column[order].astype(np.uint16),
        row[order].astype(np.uint16),
        np.append(first, order.size),
        tile_row,
        tile_column,
        np.stack([*low, *high], 1),
    )


def _ray(info: CameraInfo, column: NDArray[np.float64], row: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    return undistort((column - info.cx) / info.fx, (row - info.cy) / info.fy, info)


def as_image(rays: Rays, sensor: Sensor, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Arrange values (N,) of the rays as an image (H, W); nan where a pixel has no ray."""
    image = np.full((sensor.height, sensor.width), np.nan, np.float32)
    image[rays.row, rays.column] = values
    return image
