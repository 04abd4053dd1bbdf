"""The image that the events of a search over the ground are moved into."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine.ground_kernels import Image, Rays
from neurove_protocol import CameraInfo

FAR_UP: Final = 0.4
"""Greatest -y/z of far events."""

_CELLS: Final = 100.0  # cells per focal length, at most one per pixel
_MARGIN: Final = 0.25  # of the image, on each side, as a share of the sensor's side
_NARROW, _WIDE = 1.0, 2.0  # smoothings [cells]
_REACH: Final = 2.5  # of a smoothing [sigma]
_DRAWN: Final = 4 / 9  # mean square of the weights of an event that is drawn into four cells, two axes


def image_of(camera: CameraInfo) -> Image:
    """The image of moved events: what the camera sees of the ground and ahead, with a margin."""
    focal = min(_CELLS, camera.fx)
    half_x = max(camera.cx, camera.width - camera.cx) / camera.fx * (1 + _MARGIN)
    half_y = max(camera.cy, camera.height - camera.cy) / camera.fy
    bottom, top = half_y * (1 + _MARGIN), -min(FAR_UP, half_y) - 0.1
    width, height = int(2 * half_x * focal), max(int((bottom - top) * focal), 1) + 1
    return Image(focal, half_x * focal, -top * focal, width, height, _bell(_NARROW), _bell(_WIDE))


def own_sharpness(rays: Rays, image: Image) -> float:
    """The logarithm of the part of the sharpness that each event has by itself."""
    middle = (float(kernel[kernel.size // 2]) ** 2 for kernel in (image.narrow, image.wide))
    return math.log(float((rays.weight**2).sum()) * (next(middle) - next(middle)) * _DRAWN)


def _bell(sigma: float) -> NDArray[np.float32]:
    reach = math.ceil(_REACH * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(weights / weights.sum(), np.float32)
