"""Benchmark of the refinement of one window against its budget's parts: the kernels, and their plain numpy form."""

from collections.abc import Callable

import numpy as np

from neurove_core.bench import Row, interleaved, rows
from neurove_core.ingest.sample import CAPACITY, Sample
from neurove_core.refine.alignment import image, image_reference, tiles, tiles_reference
from neurove_core.refine.rotation import Given, refine
from neurove_core.refine.search import jacobian
from neurove_core.refine.view import View
from neurove_protocol import CameraInfo

EVENTS = 100_000
"""Events of the window."""

_CAMERA = CameraInfo(
    stream="bench", lens="pinhole", width=240, height=180, fx=200.0, fy=200.0, cx=120.0, cy=90.0, height_m=1.0
)
_W = np.array([0.2, -0.5, 0.1])
_SECONDS = 0.05


def refinement(rounds: int, *, quick: bool) -> list[Row]:
    """A window of a turning camera: one alignment, compiled and plain, and the whole refinement."""
    view = View.of(_CAMERA)
    assert view is not None
    given = _window(view, EVENTS // 20 if quick else EVENTS)
    rays, grid, motion = view.rays_of(given.sample, given.window_us), view.grid, np.zeros(6)
    smooth = image(rays, motion, grid)
    runs: dict[str, Callable[[], object]] = {
        "ours": lambda: tiles(rays, motion, grid, image(rays, motion, grid)),
        "plain numpy": lambda: tiles_reference(rays, motion, grid, image_reference(rays, motion, grid)),
        "refinement": lambda: refine(given),
    }
    times = interleaved(runs, rounds)
    equal = np.allclose(smooth, image_reference(rays, motion, grid), atol=1e-3)
    name = f"of a window of {EVENTS // 20 if quick else EVENTS:,} events"
    whole = {"ours": times["refinement"], "one alignment in plain numpy": times["plain numpy"]}
    return [
        *rows(f"alignment {name}", times, {"plain numpy": equal}),
        *rows(f"refinement {name}", whole, {"one alignment in plain numpy": None}),
    ]


def _window(view: View, events: int) -> Given:
    """The window of a camera that turns in front of many points, with a network that is 40 % too slow."""
    rng = np.random.default_rng(0)
    stride = 1
    while -(-events // stride) > CAPACITY:
        stride *= 2
    n = -(-events // stride)
    points = rng.uniform([-0.55, -0.4], [0.55, 0.4], (n // 12, 2))[rng.integers(0, n // 12, n)]
    t_us = np.sort(rng.integers(0, 50_000, n)).astype(np.int32)
    time = t_us / 50_000 - 0.5
    flow = np.einsum("kia,a->ki", jacobian(*points.T), np.append(_W, np.zeros(3)) * _SECONDS)
    at = (points - time[:, None] * flow) * 200 + [120, 90]
    x, y = at.round().clip(0, [239, 179]).astype(np.uint16).T
    sample = Sample(t_us, np.ascontiguousarray(x), np.ascontiguousarray(y))
    twist = np.append(np.zeros(3), 0.6 * _W)
    return Given(0, 50_000, sample, view, twist, np.eye(6) * 0.04, low_activity=False, before=None)
