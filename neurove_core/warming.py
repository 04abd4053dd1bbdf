"""What compiles the code of a service ahead: made-up events and a camera, and the compilation in parts.

The parts share almost no code, so processes can compile them at the same time into one cache.
"""

import contextlib
import functools
import hashlib
import sys
from pathlib import Path
from typing import Any, Final

import numba
import numpy as np

from neurove_core.compiled import ahead, folder_of, work
from neurove_core.config import ModelConfig
from neurove_core.engine.fallback import vectors_work
from neurove_core.geometry.tables import TABLES
from neurove_core.ingest import windows
from neurove_core.ingest.channels import with_history
from neurove_core.ingest.windows import WindowsState
from neurove_core.ingest.wire import read_packet
from neurove_core.models.bundle import Bundle
from neurove_core.models.golden import Golden
from neurove_core.networks.arrays import Weights, shapes
from neurove_core.refine import ground, stages
from neurove_core.refine.view import View
from neurove_core.running import runner_of
from neurove_protocol import CameraInfo, Events, Sensor
from neurove_protocol.events import EventPacket, PacketLimits, WireEvents, encode_packet

PARTS: Final = ("network", "events", "refinement")
"""network: all forms of the engine. events: from packets to windows. refinement: of the answers."""

_FIRING: Final = 0.2  # share of the cells with events in made-up windows


def lacks_code(config: ModelConfig) -> bool:
    """Whether a part of the code is neither in the cache nor in the package; it compiles or loads one small kernel.

    The cache is complete where `note_complete` has noted so for the present sources.

    Args:
        config: of the model that is to run.

    Returns:
        False where there is no place for a cache, and in a process that has compiled or loaded code already.
    """
    before = work()
    if before.compiled + before.loaded or not vectors_work():
        return False
    if work().compiled == 0 and (_noted() == sources() or ahead.complete_for() == complete_for(config)):
        return False
    return _note() is not None


def note_complete() -> None:
    """Note in the cache that it has all code of the present sources, for `lacks_code`."""
    file = _note()
    if file is not None:
        with contextlib.suppress(OSError):  # then the next start finds out by itself
            file.write_text(sources())


def complete_for(config: ModelConfig) -> str:
    """The sources and the model whose code a package brings, as a digest."""
    shape = config.kind, config.window, config.network, config.canonical
    return hashlib.sha256(f"{sources()} {shape!r}".encode()).hexdigest()


@functools.cache
def sources() -> str:
    """The digest of all files from which the code of a service is compiled, and of what compiles them."""
    found = hashlib.sha256(f"{sys.implementation.cache_tag} {numba.__version__}".encode())
    package = Path(__file__).parent
    for folder in _FOLDERS:
        for file in sorted((package / folder).rglob("*.py")):
            found.update(file.relative_to(package).as_posix().encode())
            found.update(file.read_bytes())
    return found.hexdigest()


_FOLDERS: Final = ("engine", "geometry", "ingest", "networks", "refine", "spiking")


def _note() -> Path | None:
    from neurove_core.engine.spike_lists import fill_spikes

    folder = folder_of(fill_spikes)
    return folder / "complete" if folder else None


def _noted() -> str:
    file = _note()
    try:
        return file.read_text() if file else ""
    except (OSError, ValueError):
        return ""


def compile_part(part: str, config: ModelConfig) -> None:
    """Compile a part of the code that a model of this configuration runs, and run it once.

    Args:
        part: one of PARTS.
        config: of the model; its weights do not matter.
    """
    {"network": _network, "events": _events, "refinement": _refinement}[part](config)


def warm_events(sensor: Sensor, duration_us: int) -> tuple[Events, WireEvents]:
    """Made-up events of four windows, as columns and in the layout of a packet."""
    t = np.arange(0, 4 * duration_us, max(1, duration_us // 500))
    rng = np.random.default_rng(0)
    x, y, p = (rng.integers(0, high, t.size) for high in (sensor.width, sensor.height, 2))
    events = Events.from_columns(t, x, y, p)
    data = encode_packet(EventPacket("warm", 0, sensor, 0, events))
    return events, read_packet(data, PacketLimits(max_side_px=max(sensor.width, sensor.height))).events


def warm_camera(sensor: Sensor) -> CameraInfo:
    """A made-up lens of a sensor."""
    focal, middle_x, middle_y = float(sensor.width), sensor.width / 2, sensor.height / 2
    return CameraInfo(
        stream="warm",
        lens="pinhole",
        width=sensor.width,
        height=sensor.height,
        fx=focal,
        fy=focal,
        cx=middle_x,
        cy=middle_y,
    )


def compile_refinement(view: View, camera: CameraInfo) -> None:
    """Compile the kernels of both refinements."""
    stages.compile_kernels(view.grid)
    ground.compile_kernels(camera)


def _network(config: ModelConfig) -> None:
    rng = np.random.default_rng(0)
    tensors = {
        name: np.abs(rng.normal(0, 0.1, shape)).astype(np.float32)
        for name, shape in shapes(config, spread=False).items()
    }
    cells = (2, *config.window_shape)
    counts = (rng.random(cells) < _FIRING).astype(np.uint8) * rng.integers(1, 4, cells, dtype=np.uint8)
    weights: Any = Weights(config, tensors)  # and arrays where tensors are declared: see Bundle
    offset: Any = np.zeros(6, np.float32)
    golden = Golden(counts, np.zeros((2, config.window.bins, 6), np.float32))
    runner = runner_of(Bundle("compiling", False, "", config, weights, offset, offset + 1, golden=golden))
    runner.run([with_history(counts[0], (), config)], [runner.initial_state()])


def _events(config: ModelConfig) -> None:
    sensor = _sensor(config)
    for camera in (None, warm_camera(sensor)):
        lut = TABLES.of(config.canonical, sensor, camera)
        for given in warm_events(sensor, config.window.duration_us):
            windows.push(given, 0, WindowsState(), lut, config.window, config.canonical, sampled=True)


def _refinement(config: ModelConfig) -> None:
    camera = warm_camera(_sensor(config))
    view = View.of(camera)
    if view is not None:
        compile_refinement(view, camera)


def _sensor(config: ModelConfig) -> Sensor:
    return Sensor(config.canonical.width, config.canonical.height)
