"""`sim://SCENE?...`: a simulation named by a URL."""

import math
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from neurove_core.io.errors import UnknownSource
from neurove_core.io.format import UrlFormat
from neurove_core.io.recording import refuse_topic
from neurove_core.sim.motion.curves import Mounted, Trajectory
from neurove_core.sim.motion.trajectory import parse_trajectory
from neurove_core.sim.render.camera import DEFAULT_CAMERA, DEFAULT_HEIGHT_M, named_camera
from neurove_core.sim.render.pixels import PixelConfig
from neurove_core.sim.simulate import Simulation
from neurove_core.sim.world.scene import named_scene
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

DEFAULT_SCENE: Final = "street"
TRAJECTORY_OF: Final = {
    "street": "driving",
    "bare-street": "driving",
    "corridor": "driving",
    "room": "handheld",
    "plain-room": "handheld",
    "wall": "slider?vx=0.3",
}
"""What moves the camera where nothing else is said."""

_SEEDED: Final = ("driving", "handheld")
_FIELDS: Final = ("trajectory", "seed", "camera", "height", "pitch", "seconds")


def simulation_of(url: str, sensor: Sensor | None = None) -> Simulation:
    """The simulation of `sim://`, or `sim://room?seed=3&camera=davis240c&seconds=10`.

    A generated trajectory takes the simulation's seed where it names none of its own. Without `seconds` a generated
    trajectory is followed by the next, without end; any other lasts as long as it does.

    >>> simulation_of("sim://?seed=3&seconds=2").name
    'street driving 3 3'

    Args:
        url: with the scene as its host, and of trajectory, seed, camera, height [m], pitch [deg] and seconds what is to
            differ from the default. A trajectory's own parameters follow it, its `&` written `%26`.
        sensor: must be the camera's, where given.

    Raises:
        UnknownSource: the URL is none of a simulation. InvalidField: what it asks for does not exist or is out of its
            bound.
    """
    parts = urlsplit(url)
    query = dict(parse_qsl(parts.query, keep_blank_values=True))
    unknown = sorted(query.keys() - set(_FIELDS))
    if parts.scheme != "sim" or parts.path.strip("/") or unknown:
        why = f"unknown parameter {unknown[0]!r}" if unknown else "sim://SCENE?trajectory=...&seed=... is expected"
        raise UnknownSource(url, why)
    scene = parts.netloc or DEFAULT_SCENE
    make_scene = named_scene(scene)
    seed = _seed(url, query.get("seed", "0"))
    mount = (_number(url, query, "height", DEFAULT_HEIGHT_M), _number(url, query, "pitch", 5.0))
    camera = named_camera(query.get("camera", DEFAULT_CAMERA), *mount)
    if sensor not in (None, camera.info.sensor):
        raise InvalidField(url, "sensor", str(sensor), f"the camera's is {camera.info.sensor}: choose camera=...")
    seconds = _number(url, query, "seconds", math.inf)
    if not seconds > 0:
        raise InvalidField(url, "seconds", query["seconds"], "must be above 0")
    text = query.get("trajectory", TRAJECTORY_OF[scene])

    def trajectory(number: int) -> Trajectory:
        named = f"{text}?seed={seed + number}" if text in _SEEDED else text
        return Mounted(parse_trajectory(named, None if math.isinf(seconds) else seconds), *mount)

    first = trajectory(0)
    next_trajectory = trajectory if math.isinf(seconds) and text in _SEEDED else None
    duration_s = math.inf if next_trajectory else min(seconds, first.duration_s)
    return Simulation(scene, make_scene, first, camera, PixelConfig(), seed, duration_s, next_trajectory)


def _seed(url: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 10):
        raise InvalidField(url, "seed", text, "a whole number of at most 9 digits is expected")
    return int(text)


def _number(url: str, query: dict[str, str], field: str, default: float) -> float:
    try:
        value = float(query.get(field, default))
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise InvalidField(url, field, query[field], "a number is expected")
    return value


def _open(url: str, sensor: Sensor | None, topic: str | None) -> Simulation:
    refuse_topic(url, topic)
    return simulation_of(url, sensor)


FORMAT = UrlFormat("sim://SCENE?trajectory=...&seed=... (built-in simulator)", "sim", _open)
