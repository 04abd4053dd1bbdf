"""Draw a simulation: the image of the camera, its events, and the depth."""

import itertools
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.figures import blank_figure, write_figure
from neurove_core.sim.render.camera import as_image, rays_of
from neurove_core.sim.simulate import INTERVAL_US, Simulation
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor

EVENTS_US: Final = 60_000
"""Time in which the events of the picture are collected."""


def draw(simulation: Simulation, path: Path, t_s: float = 1.0) -> None:
    """Write a PNG with the image at a time, the events that follow, and the depth.

    Args:
        simulation: to draw.
        path: of the file.
        t_s: time of the image [s].

    Raises:
        MissingExtra: matplotlib is not installed. InvalidField: the file cannot be written.
    """
    figure = blank_figure(13, 3.8)
    view, rays, sensor = simulation.view(t_s), rays_of(simulation.lens.info), simulation.sensor
    steps = itertools.islice(simulation.steps(t_s), EVENTS_US // INTERVAL_US)
    events = Events.join([step.events for step in steps])
    shown = np.exp(as_image(rays, sensor, view.light)) ** 0.45  # gamma of a screen
    depth = as_image(rays, sensor, np.log10(np.where(np.isfinite(view.depth), view.depth, np.nan)))
    pictures = [
        (f"{simulation.name}, t = {t_s:g} s", shown, {"cmap": "gray", "vmin": 0, "vmax": 1}),
        (f"{events.n} events in {EVENTS_US // 1000} ms", event_image(events, sensor), {}),
        ("depth [m]", depth, {"cmap": "viridis_r", "vmin": 0, "vmax": 2}),
    ]
    for axes, (title, image, how) in zip(figure.subplots(1, 3), pictures, strict=True):
        drawn = axes.imshow(image, interpolation="nearest", **how)
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
    ticks = [0.0, 0.5, 1.0, 1.5, 2.0]
    figure.colorbar(drawn, ax=figure.axes[-1], ticks=ticks, shrink=0.8).ax.set_yticklabels(
        [f"{10**tick:.2g}" for tick in ticks]
    )
    try:
        write_figure(figure, path, dpi=120)
    except OSError as error:
        raise InvalidField("picture", "path", str(path), error.strerror or str(error)) from None


def event_image(events: Events, sensor: Sensor) -> NDArray[np.uint8]:
    """Events as an RGB image (H, W, 3) on white: the last event of a pixel is blue for ON and red for OFF."""
    image = np.full((sensor.height, sensor.width, 3), 255, np.uint8)
    image[events.y, events.x] = np.where(events.p[:, None] > 0, [40, 80, 220], [220, 50, 40])
    return image
