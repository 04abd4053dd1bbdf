"""Pixels of an event camera: events from log intensity, by the principle of ESIM.

Source: Rebecq, Gehrig, Scaramuzza, ESIM (CoRL 2018), section 4: between two renders the log intensity of a pixel
changes linearly, and the pixel makes an event each time it differs by a threshold from the level of the previous event.
Mismatch, leak, shot noise, bandwidth and the defaults are those of the command line of v2e (Hu, Liu, Delbruck, CVPRW
2021).
Differs: bandwidth and shot noise do not depend on the brightness; a shot noise event does not change the pixel's level.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from neurove_core.config import Config
from neurove_core.sim.render.compile import exact
from neurove_protocol.errors import InvalidField, TimeBackwards
from neurove_protocol.events import Events, Sensor

LEAST_THRESHOLD: Final = 0.01
"""Lower bound of a threshold with mismatch (ESIM) [log intensity]."""

LONGEST_US: Final = 10_000_000
"""Greatest time between two frames [us]."""


class PixelConfig(Config):
    """Configuration of the pixels."""

    threshold_on: float = Field(0.2, gt=0, le=10, description="Rise of log intensity for an ON event (v2e).")
    threshold_off: float = Field(0.2, gt=0, le=10, description="Fall of log intensity for an OFF event (v2e).")
    threshold_sigma: float = Field(0.03, ge=0, le=1, description="Standard deviation of both between pixels (v2e).")
    refractory_us: int = Field(
        500, ge=0, le=1_000_000, description="Time after an event in which the pixel makes no other (v2e) [us]."
    )
    leak_hz: float = Field(0.01, ge=0, le=1000, description="Rate of ON events of a pixel without change (v2e) [Hz].")
    shot_noise_hz: float = Field(
        0.001, ge=0, le=1000, description="Rate of random events of a pixel, ON or OFF (v2e) [Hz]."
    )
    hot_fraction: float = Field(5e-5, ge=0, le=1, description="Share of hot pixels (evbench's DAVIS240: 2 of 43,200).")
    hot_hz: float = Field(100.0, ge=0, le=10_000, description="Rate of events of a hot pixel (our choice) [Hz].")
    cutoff_hz: float = Field(
        300.0, ge=0, le=1e6, description="Cutoff of the first-order low pass of log intensity; 0: none (v2e) [Hz]."
    )
    eps: float = Field(0.001, gt=0, le=1, description="L = log(I + eps), I from 0 to 1 (ESIM, CARLA).")


USUAL: Final = PixelConfig()
"""The default pixels."""

QUIET: Final = PixelConfig(
    threshold_sigma=0, refractory_us=0, leak_hz=0, shot_noise_hz=0, hot_fraction=0, hot_hz=0, cutoff_hz=0
)
"""Ideal pixels: only thresholds."""


class Mismatch(NamedTuple):
    """Mismatch of N pixels: the parameters of each."""

    on: NDArray[np.float64]  # (N,) threshold of each [log intensity]
    off: NDArray[np.float64]  # (N,)
    leak: NDArray[np.float64]  # (N,) rate at which its level sinks [log intensity / us]


class Pixels(NamedTuple):
    """N pixels of one configuration."""

    config: PixelConfig
    seed: int
    mismatch: Mismatch
    hot: NDArray[np.int64]  # indices of the hot pixels

    @property
    def n(self) -> int:
        """Number of pixels."""
        return int(self.mismatch.on.size)


class PixelState(NamedTuple):
    """State of N pixels between renders."""

    light: NDArray[np.float32]  # (N,) log intensity at the last render
    seen: NDArray[np.float64]  # (N,) the same after the low pass
    level: NDArray[np.float64]  # (N,) level after the last event
    last_us: NDArray[np.int64]  # (N,) time of the last event


class EventBuffer(NamedTuple):
    """Buffer for the events of one interval; the first `n` of M rows are valid."""

    t: NDArray[np.int32]  # (M,) from the start of the interval [us]
    pixel: NDArray[np.int32]  # (M,)
    p: NDArray[np.uint8]  # (M,)
    n: int

    @classmethod
    def empty(cls, rows: int) -> "EventBuffer":
        """Create an empty buffer of this many rows."""
        return cls(np.empty(rows, np.int32), np.empty(rows, np.int32), np.empty(rows, np.uint8), 0)


def make_pixels(config: PixelConfig, n: int, seed: int) -> Pixels:
    """Create `n` pixels with the mismatch of a seed."""
    rng = np.random.default_rng((seed, 106))
    spread = config.threshold_sigma
    on = np.maximum(config.threshold_on + spread * rng.standard_normal(n), LEAST_THRESHOLD)
    off = np.maximum(config.threshold_off + spread * rng.standard_normal(n), LEAST_THRESHOLD)
    leak = np.full(n, config.leak_hz * config.threshold_on * 1e-6)
    return Pixels(config, seed, Mismatch(on, off, leak), np.flatnonzero(rng.uniform(size=n) < config.hot_fraction))


def settled_state(pixels: Pixels, light: NDArray[np.float32]) -> PixelState:
    """State of settled pixels for a first render (N,): each level is random between the thresholds."""
    rng = np.random.default_rng((pixels.seed, 107))
    level = light + rng.uniform(-0.999, 0.999, light.size) * np.minimum(pixels.mismatch.on, pixels.mismatch.off)
    never = np.full(light.size, np.iinfo(np.int64).min // 2)
    return PixelState(light.astype(np.float32), light.astype(np.float64), level, never)


def low_pass(cutoff_hz: float, span_us: float) -> tuple[float, float, float]:
    """Weights of the last output, the last input and the new input in the new output of the low pass.

    They give the exact response of a first-order low pass to an input that changes linearly.

    >>> low_pass(0, 100)
    (0.0, 0.0, 1.0)
    """
    if cutoff_hz <= 0:
        return 0.0, 0.0, 1.0
    ratio = 2 * math.pi * cutoff_hz * span_us * 1e-6
    kept = math.exp(-ratio)
    new = 1 + math.expm1(-ratio) / ratio
    return kept, 1 - kept - new, new


@exact
def find_crossings(
    mismatch: Mismatch,
    state: PixelState,
    light: NDArray[np.float32],
    first: int,
    done: int,
    weights: tuple[float, float, float],
    start_us: float,
    stop_us: float,
    found: EventBuffer,
) -> tuple[int, int]:  # pragma: no cover (machine code)
    """Apply a new render to pixels and store their events, until all pixels are done or the buffer is full.

    Args:
        mismatch: of all pixels.
        state: of all pixels; changed in place.
        light: (K,) new log intensity of the pixels from `first` on.
        first: index of the pixel of light[0].
        done: number of the K pixels that are already done.
        weights: of low_pass, for this time.
        start_us: time of the last render, from the start of the interval [us].
        stop_us: time of the new render.
        found: buffer for the events.

    Returns:
        the number of pixels that are done, and the number of events in the buffer.
    """
    n, size = found.n, found.t.size
    span = stop_us - start_us
    for k in range(done, light.size):
        i = first + k
        seen = state.seen[i]
        now = weights[0] * seen + weights[1] * state.light[i] + weights[2] * light[k]
        level, leak = state.level[i], mismatch.leak[i] * span
        before, after = seen - level, now - level + leak
        events = 0
        if after >= mismatch.on[i]:
            step = mismatch.on[i]
            events = int(after / step)
        elif after <= -mismatch.off[i]:
            step = -mismatch.off[i]
            events = int(after / step)
        if events:
            if n + events > size:
                return k, n
            for e in range(1, events + 1):
                part = min(max((e * step - before) / (after - before), 0.0), 1.0)
                found.t[n] = int(start_us + part * span)
                found.pixel[n] = i
                found.p[n] = 1 if step > 0 else 0
                n += 1
            level += events * step
        state.level[i] = level - leak
        state.seen[i] = now
        state.light[i] = light[k]
    return light.size, n


def find_crossings_reference(
    mismatch: Mismatch,
    state: PixelState,
    light: NDArray[np.float32],
    weights: tuple[float, float, float],
    start_us: float,
    stop_us: float,
) -> tuple[list[tuple[int, int, int]], PixelState]:
    """Reference implementation of find_crossings for all pixels: (t, pixel, p) of each event, and the new state."""
    rows, levels, seens = [], [], []
    span = stop_us - start_us
    for i, (was, new) in enumerate(zip(state.light.tolist(), light.tolist(), strict=True)):
        seen, on, off, leak = (
            float(state.seen[i]),
            float(mismatch.on[i]),
            float(mismatch.off[i]),
            float(mismatch.leak[i]),
        )
        now = weights[0] * seen + weights[1] * was + weights[2] * new
        level = float(state.level[i])
        before, after = seen - level, now - level + leak * span
        step = on if after >= on else -off
        count = int(after / step) if after >= on or after <= -off else 0
        for e in range(1, count + 1):
            part = min(max((e * step - before) / (after - before), 0.0), 1.0)
            rows.append((int(start_us + part * span), i, int(step > 0)))
        levels.append((level + count * step if count else level) - leak * span)
        seens.append(now)
    return rows, PixelState(light, np.array(seens), np.array(levels), state.last_us)


def add_noise(pixels: Pixels, start_us: int, stop_us: int, found: EventBuffer) -> EventBuffer:
    """Add shot noise and the events of hot pixels; the same times and seed give the same noise."""
    config, span = pixels.config, stop_us - start_us
    rng = np.random.default_rng((pixels.seed, 108, start_us & ((1 << 63) - 1)))
    shots = rng.poisson(config.shot_noise_hz * pixels.n * span * 1e-6)
    hot = rng.poisson(config.hot_hz * span * 1e-6, pixels.hot.size)
    where = np.concatenate([rng.integers(pixels.n, size=shots), np.repeat(pixels.hot, hot)])
    t, p = rng.integers(span, size=where.size), rng.integers(2, size=where.size)
    n = found.n
    return EventBuffer(
        np.append(found.t[:n], t.astype(np.int32)),
        np.append(found.pixel[:n], where.astype(np.int32)),
        np.append(found.p[:n], p.astype(np.uint8)),
        n + where.size,
    )


@exact
def sort_events(
    found: EventBuffer, start_us: int, span_us: int, refractory_us: int, last_us: NDArray[np.int64]
) -> EventBuffer:  # pragma: no cover (machine code)
    """Sort the events by time, without those within the refractory time of their pixel.

    A lost event has changed the level of its pixel nevertheless, as in ESIM.

    Args:
        found: with times from 0 to span_us.
        start_us: sensor time of the start of the interval.
        span_us: duration of the interval.
        refractory_us: refractory time of a pixel.
        last_us: (N,) sensor time of the last event of each pixel; changed in place.
    """
    begin = np.zeros(span_us + 2, np.int64)
    for i in range(found.n):
        begin[found.t[i] + 1] += 1
    for t in range(span_us + 1):
        begin[t + 1] += begin[t]
    order = np.empty(found.n, np.int64)
    for i in range(found.n):
        order[begin[found.t[i]]] = i
        begin[found.t[i]] += 1
    out_t, out_pixel, out_p = np.empty(found.n, np.int32), np.empty(found.n, np.int32), np.empty(found.n, np.uint8)
    n = 0
    for k in range(found.n):
        i = order[k]
        pixel = found.pixel[i]
        t = start_us + found.t[i]
        if t - last_us[pixel] < refractory_us:
            continue
        last_us[pixel] = t
        out_t[n], out_pixel[n], out_p[n] = found.t[i], pixel, found.p[i]
        n += 1
    return EventBuffer(out_t, out_pixel, out_p, n)


def events_of(
    pixels: Pixels,
    state: PixelState,
    light: NDArray[np.float32],
    start_us: int,
    stop_us: int,
    sensor: Sensor,
) -> tuple[Events, PixelState]:
    """Make the events of a whole sensor between two frames.

    Args:
        pixels: of the sensor, row by row.
        state: after the frame at start_us.
        light: (H, W) log intensity at stop_us, such as log(I + eps).
        start_us: time of the last frame.
        stop_us: time of this frame.
        sensor: the pixel array.

    Returns:
        the events from start_us to stop_us, sorted by time, and the state after this frame.

    Raises:
        InvalidField: the frame has another size, contains nan or inf, or comes too late after the last frame.
        TimeBackwards: the frame is not later than the last one.
    """
    if light.shape != (sensor.height, sensor.width) or pixels.n != light.size:
        raise InvalidField("frame", "shape", light.shape, f"the sensor is {sensor}, rows first")
    if not np.isfinite(light).all():
        raise InvalidField("frame", "light", "nan or inf", "every log intensity must be finite")
    if stop_us <= start_us:
        raise TimeBackwards(0, start_us, stop_us)
    if stop_us - start_us > LONGEST_US:
        raise InvalidField("frame", "t", stop_us, f"at most {LONGEST_US} us after the last frame")
    columns: list[Any] = [column.copy() for column in state]
    state = PixelState(*columns)
    weights = low_pass(pixels.config.cutoff_hz, stop_us - start_us)
    flat, span = np.ascontiguousarray(light, np.float32).ravel(), float(stop_us - start_us)
    found, done = EventBuffer.empty(4 * flat.size), 0
    while True:
        done, n = find_crossings(pixels.mismatch, state, flat, 0, done, weights, 0.0, span, found)
        found = found._replace(n=n)
        if done == flat.size:
            break
        found = with_double_size(found)
    found = add_noise(pixels, start_us, stop_us, found)
    found = sort_events(found, start_us, stop_us - start_us, pixels.config.refractory_us, state.last_us)
    y, x = np.divmod(found.pixel[: found.n], sensor.width)
    return Events.from_columns(found.t[: found.n] + np.int64(start_us), x, y, found.p[: found.n]), state


def with_double_size(found: EventBuffer) -> EventBuffer:
    """The same events in a buffer of twice the size."""
    more = EventBuffer.empty(found.t.size)
    return EventBuffer(
        np.concatenate((found.t, more.t)),
        np.concatenate((found.pixel, more.pixel)),
        np.concatenate((found.p, more.p)),
        found.n,
    )
