"""Frames to events: our pixels against the algorithm of v2e, and the speed of the simulator against real time.

v2e (Hu, Liu, Delbruck, CVPRW 2021) is in no package index. Its algorithm is implemented here from section 4 of the
paper, in PyTorch as v2e's own code: all pixels of a frame at once, one pass for each event that a pixel may emit since
the last frame, evenly spaced in time. Our pixels compute the threshold crossings of a linear interpolation.
"""

import time
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.bench import Row, interleaved
from neurove_core.sim.motion.generated import driving
from neurove_core.sim.render.camera import as_image, named_camera, rays_of
from neurove_core.sim.render.pixels import QUIET, events_of, make_pixels, settled_state
from neurove_core.sim.simulate import Simulation, simulate

FRAME_US: Final = 2_000
FRAMES: Final = 50
THRESHOLD: Final = QUIET.threshold_on


def rows(rounds: int, *, quick: bool) -> list[Row]:
    """Frames to events, and a second of driving through a street against real time."""
    return [*compare(rounds, 10 if quick else FRAMES), real_time(0.1 if quick else 4.0)]


def real_time(seconds: float, camera: str = "davis346-half") -> Row:
    """CPU time per simulated second, averaged over `seconds`, against real time; without compilation."""
    simulation = simulate("street", driving(3, seconds), named_camera(camera), seed=3)
    next(iter(simulation.steps()))  # compiles
    began = time.thread_time()
    events = sum(step.events.n for step in simulation.steps())
    spent_ms = 1e3 * (time.thread_time() - began) / seconds
    name = f"simulate a second of {camera}, {events / seconds / 1e3:.0f} k events"
    return Row(name, spent_ms, "real time", 1e3, 1e3 / spent_ms, None, None)


def compare(rounds: int = 5, frames: int = FRAMES) -> list[Row]:
    """The same frames through both; more than 90 % of the pixels must have the same number of events.

    Both compare frames with a level that moves by whole thresholds. Some pixels may differ, because v2e computes in
    float32. The total numbers of events must agree within 1 %.
    """
    camera = named_camera("davis346-half")
    simulation = simulate("street", driving(3, 2.0), camera, seed=3)
    pictures = _pictures(simulation, frames)
    times = interleaved({"ours": lambda: _ours(simulation, pictures), "v2e": lambda: _v2e(pictures)}, rounds)
    ours, theirs = _ours(simulation, pictures), _v2e(pictures)
    equal = bool((ours == theirs).mean() > 0.9 and abs(int(ours.sum()) - int(theirs.sum())) < 0.01 * ours.sum())
    ratio = times["v2e"] / times["ours"]
    return [Row("simulate frames to events", times["ours"], "v2e's algorithm", times["v2e"], ratio, None, equal)]


def _pictures(simulation: Simulation, frames: int) -> list[NDArray[np.float32]]:
    """Log intensity (H, W) every FRAME_US."""
    rays, sensor = rays_of(simulation.lens.info), simulation.sensor
    views = (simulation.view(k * FRAME_US * 1e-6).light for k in range(frames + 1))
    return [np.ascontiguousarray(as_image(rays, sensor, light), np.float32) for light in views]


def _ours(simulation: Simulation, pictures: list[NDArray[np.float32]]) -> NDArray[np.int64]:
    """Number of events of each pixel (H * W,)."""
    pixels = make_pixels(QUIET, pictures[0].size, 0)
    state = settled_state(pixels, pictures[0].ravel())
    state = state._replace(level=pictures[0].ravel().astype(np.float64))
    parts = []
    for k, picture in enumerate(pictures[1:]):
        events, state = events_of(pixels, state, picture, k * FRAME_US, (k + 1) * FRAME_US, simulation.sensor)
        parts.append(events.y.astype(np.int64) * simulation.sensor.width + events.x)
    return np.bincount(np.concatenate(parts), minlength=pixels.n)


def _v2e(pictures: list[NDArray[np.float32]]) -> NDArray[np.int64]:
    """Number of events of each pixel (H * W,), by the emulator of v2e without its noise, only with thresholds."""
    frames = [torch.from_numpy(picture) for picture in pictures]
    level = frames[0].clone()
    events: list[Tensor] = []
    for k, frame in enumerate(frames[1:]):
        change = frame - level
        on = torch.div(change.clamp(min=0), THRESHOLD, rounding_mode="floor")
        off = torch.div((-change).clamp(min=0), THRESHOLD, rounding_mode="floor")
        most = int(torch.maximum(on, off).max())
        for i in range(most):
            t_us = k * FRAME_US + FRAME_US * (i + 1) // most
            for polarity, counts in ((1, on), (0, off)):
                y, x = torch.nonzero(counts > i, as_tuple=True)
                rows = torch.stack((torch.full_like(x, t_us), x, y, torch.full_like(x, polarity)), dim=1)
                events.append(rows[torch.randperm(len(rows))])
        level += THRESHOLD * (on - off)
    table = torch.cat(events)
    return np.bincount((table[:, 2] * pictures[0].shape[1] + table[:, 1]).numpy(), minlength=pictures[0].size)
