"""Recorder for a running CARLA server: an event camera on a car with autopilot."""

import contextlib
import queue
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurove_core.extras import MissingExtra
from neurove_core.io.errors import NoCarlaServer
from neurove_core.io.formats.carla import RECORD, CarlaPoses, write
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

STEP_S = 0.01
"""Simulated time of one step [s]. CARLA computes events between the images of two steps."""


def record(
    out: Path,
    seconds: float,
    *,
    host: str = "127.0.0.1",
    port: int = 2000,
    timeout_s: float = 10.0,
    sensor: Sensor = Sensor(640, 480),  # noqa: B008 an immutable value
    fov_deg: float = 90.0,
    mount_m: tuple[float, float, float] = (1.5, 0.0, 1.6),
    seed: int = 0,
) -> int:
    """Drive a car on autopilot through the loaded town and write the events and poses of its camera.

    During the recording this client steps the world. Afterwards it restores the settings of the world.

    Args:
        out: the .npz to write; it is written atomically.
        seconds: length of the recording in simulated time [s].
        host: host of the server.
        port: port of the server.
        timeout_s: limit for each answer of the server [s].
        sensor: the camera's pixel array.
        fov_deg: the camera's horizontal field of view [deg].
        mount_m: position of the camera on the car: forward, right, up [m].
        seed: selects the car, its start position and the traffic.

    Returns:
        The number of events written.

    Raises:
        MissingExtra: CARLA's client package is not installed.
        NoCarlaServer: no server answers, or it stops answering.
        InvalidField: `seconds` or `fov_deg` is out of its range.
    """
    if not seconds > 0:
        raise InvalidField("carla recording", "seconds", seconds, "must be above 0")
    if not 0 < fov_deg < 180:
        raise InvalidField("carla recording", "fov_deg", fov_deg, "must lie between 0 and 180")
    try:
        import carla
    except ImportError:
        raise MissingExtra("carla", "carla") from None
    try:
        client = carla.Client(host, port)
        client.set_timeout(timeout_s)
        world = client.get_world()
        with _stepped(carla, client, world, seed), _camera(carla, world, sensor, fov_deg, mount_m, seed) as camera:
            poses: list[tuple[int, list[float], list[float]]] = []
            return write(out, _drive(world, camera, seconds, poses), sensor, fov_deg, lambda: _columns(poses))
    except RuntimeError as error:  # the client raises it for every failure of its server
        raise NoCarlaServer(host, port, timeout_s, str(error)) from None


@contextlib.contextmanager
def _stepped(carla: Any, client: Any, world: Any, seed: int) -> Iterator[None]:
    """Make the world move only when this client steps it, with traffic that repeats for the same seed."""
    before, settings = world.get_settings(), world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, STEP_S
    traffic = client.get_trafficmanager()
    world.apply_settings(settings)
    try:
        traffic.set_synchronous_mode(True)
        traffic.set_random_device_seed(seed)
        yield
    finally:
        with contextlib.suppress(RuntimeError):  # do not hide the error of a server that is gone
            traffic.set_synchronous_mode(False)
            world.apply_settings(before)


@contextlib.contextmanager
def _camera(
    carla: Any, world: Any, sensor: Sensor, fov_deg: float, mount_m: tuple[float, float, float], seed: int
) -> Iterator[Any]:
    """An event camera on a car with autopilot; both are destroyed afterwards."""
    rng = np.random.default_rng(seed)
    cars, places = world.get_blueprint_library().filter("vehicle.*"), world.get_map().get_spawn_points()
    actors: list[Any] = []
    try:
        car = world.spawn_actor(cars[int(rng.integers(len(cars)))], places[int(rng.integers(len(places)))])
        actors.append(car)
        blueprint = world.get_blueprint_library().find("sensor.camera.dvs")
        for name, value in (("image_size_x", sensor.width), ("image_size_y", sensor.height), ("fov", fov_deg)):
            blueprint.set_attribute(name, str(value))
        x, y, z = mount_m
        camera = world.spawn_actor(blueprint, carla.Transform(carla.Location(x=x, y=y, z=z)), attach_to=car)
        actors.append(camera)
        car.set_autopilot(True)
        yield camera
    finally:
        for actor in reversed(actors):
            with contextlib.suppress(RuntimeError):
                actor.destroy()


def _drive(
    world: Any, camera: Any, seconds: float, poses: list[tuple[int, list[float], list[float]]]
) -> Iterator[NDArray[np.void]]:
    """Step the world and yield the events of each step as RECORD. Append the camera's pose of each step to `poses`."""
    received: queue.SimpleQueue[NDArray[np.void]] = queue.SimpleQueue()
    camera.listen(lambda data: received.put(np.frombuffer(bytes(data.raw_data), RECORD)))
    try:
        for _ in range(round(seconds / STEP_S)):
            world.tick()
            snapshot = world.get_snapshot()
            at = snapshot.find(camera.id).get_transform()
            location, rotation = at.location, at.rotation
            poses.append(
                (
                    round(snapshot.timestamp.elapsed_seconds * 1e9),
                    [location.x, location.y, location.z],
                    [rotation.roll, rotation.pitch, rotation.yaw],
                )
            )
            while not received.empty():  # never wait: a step without events does not call the listener
                yield received.get()
    finally:
        camera.stop()
    while not received.empty():
        yield received.get()


def _columns(poses: list[tuple[int, list[float], list[float]]]) -> CarlaPoses:
    t_ns, location, rotation_deg = zip(*poses, strict=True)
    return CarlaPoses(np.array(t_ns, np.int64), np.array(location), np.array(rotation_deg))
