"""A built-in moving pattern: a source of events without a recording or a camera."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self
from urllib.parse import parse_qsl, urlsplit

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.errors import UnknownSource
from neurove_core.io.format import UrlFormat
from neurove_core.io.recording import EventsOnly, in_chunks, refuse_topic
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor

HALF_DAVIS346 = Sensor(173, 130)
FRAME_US = 2500  # between two frames the brightness of a pixel changes linearly
CHUNK_FRAMES = 4
CONTRAST = 0.25  # change of log intensity that makes an event
PERIOD_PX = 256  # period of the texture
DETAIL_PX = 3.0  # standard deviation of the blur that smooths it
SLOPE = 0.055  # its root mean square gradient in x and in y, log intensity per px
SPEED_PX_S = (120.0, 80.0)  # peak image velocity in x and y
SWING_S = 7.0  # period of the velocity; x and y differ by a quarter period, so it never stops


@dataclass(frozen=True, slots=True)
class Pattern(EventsOnly):
    """A smooth random texture that slides over the sensor without end, in changing directions; see `Recording`."""

    seed: int = 0
    sensor: Sensor = HALF_DAVIS346
    endless: bool = True

    @classmethod
    def from_url(cls, url: str, sensor: Sensor | None = None) -> Self:
        """The pattern of `pattern://` or `pattern://?seed=3`.

        >>> Pattern.from_url("pattern://?seed=3").name
        'pattern 3'

        Raises:
            UnknownSource: the URL has other parts. InvalidField: the seed is not a whole number of at most 9 digits.
        """
        parts = urlsplit(url)
        query = dict(parse_qsl(parts.query, keep_blank_values=True))
        if parts.netloc or parts.path or query.keys() - {"seed"}:
            raise UnknownSource(url, "its only parameter is seed, as in pattern://?seed=3")
        seed = query.get("seed", "0")
        if not (seed.isascii() and seed.isdecimal() and len(seed) < 10):
            raise InvalidField(url, "seed", seed, "expected a whole number of at most 9 digits")
        return cls(int(seed), sensor or HALF_DAVIS346)

    @property
    def name(self) -> str:
        """`pattern` and the seed."""
        return f"pattern {self.seed}"

    def camera(self, stream: str) -> CameraInfo:
        """An ideal, centred pinhole with the field of view of MVSEC's DAVIS346."""
        width, height = self.sensor.width, self.sensor.height
        f = 226.38 / 346 * width
        cx, cy = (width - 1) / 2, (height - 1) / 2
        return CameraInfo(stream=stream, width=width, height=height, lens="pinhole", fx=f, fy=f, cx=cx, cy=cy)

    def chunks(self) -> Iterator[Events]:
        """Endless events from t = 0 on, the same for the same seed; about 100 to 400 k events per second."""
        texture = _texture(self.seed, self.sensor)
        before = _view(texture, self.sensor, 0)
        # random levels, as if the texture had moved for a long time before t = 0
        offset = np.random.default_rng(self.seed).uniform(-CONTRAST, CONTRAST, before.size)
        level = before + offset.astype(np.float32)
        frame = 0
        while True:
            parts = []
            for _ in range(CHUNK_FRAMES):
                frame += 1
                after = _view(texture, self.sensor, frame * FRAME_US)
                events, level = _crossings(before, after, level, (frame - 1) * FRAME_US, self.sensor)
                parts.append(events)
                before = after
            yield from in_chunks(Events.join(parts))


def shift_px(t_us: int) -> tuple[float, float]:
    """Displacement of the texture at this time, in x and y [px].

    Its velocity is SPEED_PX_S[0] * cos(w t) in x and SPEED_PX_S[1] * sin(w t) in y, w = 2 pi / SWING_S.
    """
    w = 2 * math.pi / SWING_S
    phase = w * t_us * 1e-6
    return SPEED_PX_S[0] / w * math.sin(phase), SPEED_PX_S[1] / w * (1 - math.cos(phase))


def _texture(seed: int, sensor: Sensor) -> NDArray[np.float32]:
    """Log intensity (PERIOD_PX + H, PERIOD_PX + W), periodic: a window of the sensor's size fits at every offset."""
    noise = np.random.default_rng(seed).standard_normal((PERIOD_PX, PERIOD_PX))
    wave = 2 * np.pi * np.fft.fftfreq(PERIOD_PX)
    blur = np.exp(-0.5 * (DETAIL_PX * wave) ** 2)
    texture = np.fft.ifft2(np.fft.fft2(noise) * blur[:, None] * blur).real
    texture *= SLOPE / np.std(np.diff(texture, axis=1))
    return np.pad(texture, ((0, sensor.height), (0, sensor.width)), mode="wrap").astype(np.float32)


def _view(texture: NDArray[np.float32], sensor: Sensor, t_us: int) -> NDArray[np.float32]:
    """The image on the sensor at a time: log intensity (H * W,), interpolated bilinearly."""
    (fx, left), (fy, top) = (math.modf(-shift % PERIOD_PX % PERIOD_PX) for shift in shift_px(t_us))
    h, stride = sensor.height, sensor.width + 1
    window = texture[int(top) : int(top) + h + 1, int(left) : int(left) + stride].ravel()
    rows = window[:-stride] + np.float32(fy) * (window[stride:] - window[:-stride])
    rows[:-1] += np.float32(fx) * (rows[1:] - rows[:-1])  # mixes rows only in the last column, which is dropped below
    return rows.reshape(h, stride)[:, :-1].ravel()


def _crossings(
    before: NDArray[np.float32], after: NDArray[np.float32], level: NDArray[np.float32], t0_us: int, sensor: Sensor
) -> tuple[Events, NDArray[np.float32]]:
    """Events where a pixel differs by CONTRAST from the level (H * W,) of its last event, and the new levels.

    A pixel has at most one event per frame: in FRAME_US its brightness changes by less than half of CONTRAST.
    """
    away = after - level
    pixels = np.flatnonzero(np.abs(away) >= CONTRAST)
    brighter = away[pixels] > 0
    crossed = level[pixels] + np.where(brighter, np.float32(CONTRAST), np.float32(-CONTRAST))
    start = before[pixels]
    part = np.clip((crossed - start) / (after[pixels] - start), 0, 1)
    t = t0_us + (part * FRAME_US).astype(np.int64)
    order = np.argsort(t, kind="stable")
    y, x = np.divmod(pixels[order], sensor.width)
    level = level.copy()
    level[pixels] = crossed
    return Events.from_columns(t[order], x, y, brighter[order]), level


def _open(url: str, sensor: Sensor | None, topic: str | None) -> Pattern:
    refuse_topic(url, topic)
    return Pattern.from_url(url, sensor)


FORMAT = UrlFormat("pattern:// (built-in sliding texture)", "pattern", _open)
