"""`sim://SCENE?...`: open a simulation by its URL."""

import math
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from neurove_core.io.errors import UnknownSource
from neurove_core.io.format import UrlFormat
from neurove_core.io.recording import refuse_topic
from neurove_core.sim.inertial import ImuConfig
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
"""Default trajectory of each scene."""

_SEEDED: Final = ("driving", "handheld")
_UNIT: Final = ("imu", "gyro_bias", "gyro_noise", "imu_offset_ms")
_FIELDS: Final = ("trajectory", "seed", "camera", "height", "pitch", "seconds", *_UNIT)


def simulation_of(url: str, sensor: Sensor | None = None) -> Simulation:
    """Create the simulation of a URL such as `sim://` or `sim://room?seed=3&camera=davis240c&seconds=10`.

    A generated trajectory uses the seed of the simulation unless it has its own. Without `seconds`, generated
    trajectories follow each other without end; a simulation on any other trajectory ends with it.

    >>> simulation_of("sim://?seed=3&seconds=2").name
    'street driving 3 3'

    Args:
        url: its host is the scene; its parameters are trajectory, seed, camera, height [m], pitch [deg] and seconds,
            each with a default. With imu=HZ the camera has an inertial unit of that rate, with gyro_bias and gyro_noise
            [rad/s] and a clock that is late by imu_offset_ms. Parameters of the trajectory follow its name, with `&`
            written as `%26`.
        sensor: if given, it must be that of the camera.

    Raises:
        UnknownSource: the URL is not that of a simulation.
        InvalidField: a name is unknown, or a value is out of bounds.
    """
    parts = urlsplit(url)
    query = dict(parse_qsl(parts.query, keep_blank_values=True))
    unknown = sorted(query.keys() - set(_FIELDS))
    if parts.scheme != "sim" or parts.path.strip("/") or unknown:
        known = f"unknown parameter {next(iter(unknown), '')!r}; known parameters: {', '.join(_FIELDS)}"
        why = known if unknown else "sim://SCENE?trajectory=...&seed=... is expected"
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
    unit = _unit(url, query)
    return Simulation(scene, make_scene, first, camera, PixelConfig(), seed, duration_s, next_trajectory, unit)


def _unit(url: str, query: dict[str, str]) -> ImuConfig | None:
    """The inertial unit of a URL; None without the parameter imu."""
    given = [field for field in _UNIT if field in query]
    if "imu" not in query:
        if given:
            raise InvalidField(url, given[0], query[given[0]], "it needs imu=HZ, the rate of the inertial unit")
        return None
    usual = ImuConfig()
    values = {}
    for field, default, low, high in (
        ("imu", usual.rate_hz, 10.0, 10_000.0),
        ("gyro_bias", usual.gyro_bias_rad_s, 0.0, 1.0),
        ("gyro_noise", usual.gyro_noise_rad_s, 0.0, 1.0),
        ("imu_offset_ms", 0.0, -1000.0, 1000.0),
    ):
        value = values[field] = _number(url, query, field, default)
        if not low <= value <= high:
            raise InvalidField(url, field, query[field], f"must be {low:g} to {high:g}")
    offset_us = round(values["imu_offset_ms"] * 1000)
    return usual._replace(
        rate_hz=values["imu"],
        gyro_bias_rad_s=values["gyro_bias"],
        gyro_noise_rad_s=values["gyro_noise"],
        offset_us=offset_us,
    )


def _seed(url: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 10):
        raise InvalidField(url, "seed", text, "a whole number of at most 9 digits is expected")
    return int(text)


def _number(url: str, query: dict[str, str], field: str, default: float) -> float:
    try:
        value = float(query.get(field, default))
    except ValueError:
        value = math.nan
    if math.isnan(value) or (math.isinf(value) and field != "seconds"):
        raise InvalidField(url, field, query[field], "a finite number is expected")
    return value


def _open(url: str, sensor: Sensor | None, topic: str | None) -> Simulation:
    refuse_topic(url, topic)
    return simulation_of(url, sensor)


FORMAT = UrlFormat("sim://SCENE?trajectory=...&seed=... (built-in simulator)", "sim", _open)
