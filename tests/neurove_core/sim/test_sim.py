"""The simulator: geometry, truth, images and the events of a simulation."""

import itertools

import numpy as np
import pytest

from neurove_core.geometry.camera import distort
from neurove_core.geometry.motion import Poses
from neurove_core.geometry.rotations import exp, matrix_of
from neurove_core.io import UnknownSource
from neurove_core.io.recording import CHUNK_EVENTS
from neurove_core.sim.draw import draw
from neurove_core.sim.motion.trajectory import (
    Mounted,
    Trajectory,
    driving,
    from_poses,
    hand_held,
    parse_trajectory,
    rotation,
    slider,
    still,
)
from neurove_core.sim.render.camera import CAMERAS, as_image, named_camera, rays_of
from neurove_core.sim.render.pixels import QUIET, PixelConfig
from neurove_core.sim.render.reference import render_reference
from neurove_core.sim.render.render import render
from neurove_core.sim.render.views import World
from neurove_core.sim.simulate import MOTION_PX, Simulation, simulate
from neurove_core.sim.source import simulation_of
from neurove_core.sim.world.scene import SCENES, named_scene
from neurove_core.sim.world.textures import make_textures
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import check_events
from tests.recordings import shared

SMALL = named_camera("pinhole:86x65:75")
TRAJECTORIES = {
    "street": driving(3, 30),
    "bare-street": driving(3, 30),
    "corridor": slider(0, 0, 2, 30),
    "room": hand_held(1, 10),
    "plain-room": hand_held(1, 10),
    "wall": slider(0.3, 0, 0, 5),
}


def film(scene: str, trajectory: Trajectory, seconds: float, pixels: PixelConfig = QUIET, seed: int = 3) -> Simulation:
    return simulate(scene, trajectory, SMALL, pixels, seed=seed, seconds=seconds)


def everything(simulation: Simulation) -> Events:
    return Events.join(list(simulation.chunks()))


def world_at(scene: str, t_s: float, seed: int = 3) -> tuple[World, np.ndarray, np.ndarray]:
    mounted = Mounted(TRAJECTORIES[scene], SMALL.height_m, SMALL.pitch_deg)
    built = named_scene(scene)(mounted, seed)
    position, turned = mounted.pose(np.array([t_s]))
    return World(built.near(t_s), make_textures(seed), built.sky), position[0], turned[0]


# --- pictures -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", SCENES)
def test_every_scene_can_be_simulated_by_its_name(scene):
    events = Events.join(list(simulation_of(f"sim://{scene}?camera=pinhole:24x18:75&seconds=0.5").chunks()))
    assert events.n > 100


@pytest.mark.parametrize("scene", SCENES)
def test_the_compiled_renderer_agrees_with_the_reference(scene):
    world, position, turned = world_at(scene, 1.7)
    rays = rays_of(named_camera("pinhole:28x21:80").info)
    light, depth = render(world, rays, position, turned, 1e-3)
    plain, plain_depth = render_reference(world, rays, position, turned, 1e-3)
    # rounding may assign a pixel on an edge to another panel, but change nothing else
    same = np.isclose(depth, plain_depth, rtol=1e-5)
    assert same.mean() > 0.995
    assert (np.abs(light - plain)[same] < 2e-3).mean() > 0.998
    assert light.std() > 0.1


@pytest.mark.parametrize("scene", SCENES)
def test_a_tile_with_only_its_candidates_shows_the_same_as_with_all_panels(scene):
    mounted = named_camera("davis346-half")  # a lens with distortion, and tiles truncated by the border of the sensor
    simulation = simulate(scene, TRAJECTORIES[scene], mounted, QUIET, seed=3)
    view = simulation.view(1.7)
    built = named_scene(scene)(simulation.trajectory, 3)
    position, turned = simulation.trajectory.pose(np.array([1.7]))
    world = World(built.near(1.7), make_textures(3), built.sky)
    light, depth = render(world, rays_of(mounted.info), position[0], turned[0], QUIET.eps)
    same = view.depth == depth  # except single pixels at the edge of a panel that is seen edge-on
    assert same.mean() > 0.998
    assert (np.abs(view.light - light)[same] < 1e-6).mean() > 0.998


@pytest.mark.parametrize("name", CAMERAS)
def test_every_ray_projects_to_its_pixel(name):
    info = named_camera(name).info
    rays = rays_of(info)
    x, y = distort(rays.x, rays.y, info)
    np.testing.assert_allclose(x * info.fx + info.cx, rays.column, atol=1e-3)
    np.testing.assert_allclose(y * info.fy + info.cy, rays.row, atol=1e-3)
    assert rays.x.size == info.width * info.height
    assert (rays.box[:, 0] < rays.box[:, 2]).all()


@pytest.mark.parametrize("scene", ["street", "corridor", "room"])
@pytest.mark.parametrize("seed", range(3))
def test_a_scene_has_texture_and_depth(scene, seed):
    view = film(scene, TRAJECTORIES[scene], 5, seed=seed).view(2.0)
    assert 0.2 < view.light.std() < 1.5
    near = view.depth[np.isfinite(view.depth)]
    assert near.size > 0.5 * view.depth.size
    assert near.min() > 0.2
    assert np.percentile(near, 90) > 1.2 * np.percentile(near, 10)


def test_the_depth_of_the_ground_matches_the_height_of_the_camera():
    camera = named_camera("pinhole:86x65:75", height_m=2.0, pitch_deg=10.0)
    simulation = simulate("street", slider(0, 0, 5, 9), camera, QUIET, seed=1)
    rays, view = rays_of(camera.info), simulation.view(0.5)
    i = int(np.flatnonzero((rays.row == 62) & (rays.column == 43))[0])
    down = np.tan(np.arctan(rays.y[i]) + np.radians(10))
    along = 2.0 / np.sin(np.arctan(down))
    assert view.depth[i] == pytest.approx(along / np.hypot(1, rays.y[i]), rel=2e-2)
    assert simulation.camera("cam0").height_m == 2.0
    assert simulation.camera("cam0").stream == "cam0"


# --- truth ----------------------------------------------------------------------------------------------------------


def flow_px_s(rays, depth, twist, info):
    """Motion of each pixel from the true twist, by the standard motion-field equation."""
    x, y, near = rays.x, rays.y, 1 / depth
    vx, vy, vz, wx, wy, wz = twist
    dx = (x * vz - vx) * near + x * y * wx - (1 + x * x) * wy + y * wz
    dy = (y * vz - vy) * near + (1 + y * y) * wx - x * y * wy - x * wz
    return np.stack([dx * info.fx, dy * info.fy])


@pytest.mark.parametrize("scene", ["street", "corridor", "room"])
def test_flow_from_truth_and_depth_matches_the_motion_of_the_points(scene):
    simulation = film(scene, TRAJECTORIES[scene], 5)
    rays, info, dt = rays_of(SMALL.info), SMALL.info, 2e-3
    depth = simulation.view(3.0).depth.astype(np.float64)
    seen = np.isfinite(depth)
    (here, there), (turned, later) = simulation.trajectory.pose(np.array([3.0, 3.0 + dt]))
    points = (np.stack([rays.x, rays.y, np.ones_like(depth)], 1) * depth[:, None])[seen] @ turned.T + here
    moved = (points - there) @ later
    went = np.stack(
        [(moved[:, 0] / moved[:, 2] - rays.x[seen]) * info.fx, (moved[:, 1] / moved[:, 2] - rays.y[seen]) * info.fy]
    )
    flow = flow_px_s(rays, depth, simulation.trajectory.twist(np.array([3.0 + dt / 2]))[0], info)[:, seen] * dt
    assert np.percentile(np.abs(flow), 90) > 0.02
    assert np.abs(flow - went).max() < 0.02 * np.abs(flow).max() + 1e-3


@pytest.mark.parametrize("scene", ["street", "corridor", "room", "plain-room", "wall"])
def test_the_image_moves_with_the_flow_of_the_truth(scene):
    simulation, info, rays = film(scene, TRAJECTORIES[scene], 5), SMALL.info, rays_of(SMALL.info)
    at, dt = 3.0, 4e-3
    views = [simulation.view(t) for t in (at, at + dt)]
    first, second = (blurred(as_image(rays, info.sensor, view.light)) for view in views)
    flow = flow_px_s(rays, views[0].depth, simulation.trajectory.twist(np.array([at + dt / 2]))[0], info) * dt
    u, v = (as_image(rays, info.sensor, part) for part in flow)
    gy, gx = np.gradient((first + second) / 2)
    change, expected = second - first, -(gx * u + gy * v)
    inner = np.s_[6:-6, 6:-6]
    assert np.median(np.abs(change - expected)[inner]) < 0.5 * np.median(np.abs(change)[inner])


def blurred(image):
    """Remove the finest detail, for which the difference of neighbours is not a gradient."""
    for axis in (0, 1):
        for _ in range(2):
            image = sum(
                weight * np.roll(image, shift, axis)
                for shift, weight in zip(range(-2, 3), np.array([1, 4, 6, 4, 1]) / 16, strict=True)
            )
    return image


def test_a_pure_rotation_warps_the_image_by_a_homography():
    rate = (0.3, -0.5, 0.4)
    simulation, info, rays = film("room", rotation(*rate, 5), 5), SMALL.info, rays_of(SMALL.info)
    dt = 0.1
    first, second = (as_image(rays, info.sensor, simulation.view(t).light) for t in (1.0, 1.0 + dt))
    turned = Mounted(rotation(*rate, 5), 1.5, 5.0).twist(1.0)[3:] * dt
    ray = (
        np.stack([rays.x, rays.y, np.ones_like(rays.x)], 1) @ matrix_of(exp(turned)).T
    )  # rays of the second image in the first
    column, row = ray[:, 0] / ray[:, 2] * info.fx + info.cx, ray[:, 1] / ray[:, 2] * info.fy + info.cy
    inside = (column > 1) & (column < info.width - 2) & (row > 1) & (row < info.height - 2)
    left, top = np.floor(column[inside]).astype(int), np.floor(row[inside]).astype(int)
    du, dv = column[inside] - left, row[inside] - top
    warped = (first[top, left] * (1 - du) + first[top, left + 1] * du) * (1 - dv) + (
        first[top + 1, left] * (1 - du) + first[top + 1, left + 1] * du
    ) * dv
    target, unwarped = second[rays.row, rays.column][inside], first[rays.row, rays.column][inside]
    assert np.median(np.abs(warped - target)) < 0.35 * np.median(np.abs(unwarped - target))


def test_the_truth_is_the_trajectory_in_the_optical_frame():
    simulation = film("street", driving(3, 30), 2.0)
    truth = simulation.twists()
    assert truth.t[0] == 0
    assert truth.t[-1] == 2_000_000
    np.testing.assert_array_equal(truth.twist, simulation.trajectory.twist(truth.t / 1e6))
    for step in itertools.islice(simulation.steps(), 5):
        assert step.start_us < step.twists.t[0] <= step.twists.t[-1] == step.stop_us
        np.testing.assert_allclose(step.twists.twist[-1], simulation.trajectory.twist(step.stop_us / 1e6), atol=1e-9)


def test_no_pixel_moves_more_than_the_bound_between_two_renders():
    simulation, rays = film("street", slider(0, 0, 8, 5), 1.0), rays_of(SMALL.info)
    twist = simulation.trajectory.twist(0.5)
    fastest = np.hypot(*flow_px_s(rays, simulation.view(0.5).depth, twist, SMALL.info)).max()
    step = next(step for step in simulation.steps() if step.start_us == 500_000)
    longest_us = np.diff(np.append(step.start_us, step.twists.t)).max()
    assert fastest * longest_us * 1e-6 <= 1.02 * MOTION_PX
    assert step.renders < 0.6 * step.twists.t.size  # because most of the image moves less


# --- events ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", SCENES)
def test_a_simulation_is_a_recording_like_any_other(scene):
    simulation = film(scene, TRAJECTORIES[scene], 0.3, PixelConfig())
    last, n = 0, 0
    for chunk in simulation.chunks():
        assert 0 < chunk.n <= CHUNK_EVENTS
        assert [column.dtype for column in chunk] == [np.int64, np.uint16, np.uint16, np.uint8]
        check_events(chunk, simulation.sensor, last)
        last, n = int(chunk.t[-1]), n + chunk.n
    assert last <= 300_000
    assert n > 500
    assert simulation.streams == ("events", "twists")
    assert not simulation.endless


def test_a_seed_determines_the_simulation():
    first, again, other = (everything(film("street", driving(3, 30), 0.3, PixelConfig(), seed)) for seed in (1, 1, 2))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert first.n != other.n or (first.t != other.t).any()


def test_a_stationary_camera_sees_only_noise_at_the_configured_rate():
    config, seconds = PixelConfig(leak_hz=0, shot_noise_hz=3.0, hot_fraction=0), 1.0
    n, expected = everything(film("street", still(9), seconds, config)).n, 3.0 * 86 * 65 * seconds
    assert abs(n - expected) < 5 * np.sqrt(expected) + 0.002 * expected
    assert everything(film("street", still(9), 0.2)).n == 0


def test_events_add_up_to_the_change_of_the_image():
    simulation, rays = film("room", hand_held(1, 10), 0.4), rays_of(SMALL.info)
    events = everything(simulation)
    total = np.zeros((65, 86))
    np.add.at(total, (events.y, events.x), np.where(events.p > 0, 0.2, -0.2))
    before, after = (as_image(rays, SMALL.info.sensor, simulation.view(t).light) for t in (0.0, 0.4))
    assert np.abs(total).max() > 0.5
    assert np.abs(total - (after - before)).max() <= 0.4 + 1e-4


def test_the_render_step_changes_only_the_resolution_in_time(monkeypatch):
    events = [everything(film("street", slider(0, 0, 6, 5), 0.4))]
    monkeypatch.setattr("neurove_core.sim.simulate.MOTION_PX", MOTION_PX / 4)
    events.append(everything(film("street", slider(0, 0, 6, 5), 0.4)))
    assert events[0].n == pytest.approx(events[1].n, rel=0.05)


# --- worlds ---------------------------------------------------------------------------------------------------------


def test_no_object_stands_on_the_path_of_a_drive():
    for seed in range(3):
        mounted = Mounted(driving(seed, 60), 1.5, 5)
        street = named_scene("street")(mounted, seed)
        for t in np.arange(0, 60, 1.5):
            panels = street.near(float(t))
            position = mounted.pose(t)[0]
            upright = np.abs(panels.v[:, 1]) > 0.5
            away = position[[0, 2]] - panels.centre[upright][:, [0, 2]]
            along = panels.u[upright][:, [0, 2]]
            on = np.clip((away * along).sum(1), -panels.half[upright, 0], panels.half[upright, 0])
            assert np.linalg.norm(away - on[:, None] * along, axis=1).min() > 0.8


def test_a_street_of_kilometres_holds_only_what_is_near():
    street = named_scene("street")(Mounted(slider(0, 0, 50.0), 1.5, 5), 1)
    counts = [street.near(float(t)).n for t in range(0, 100, 2)]  # 5 km
    assert max(counts) < 1500
    assert min(counts) > 50


# --- by name --------------------------------------------------------------------------------------------------------


def test_a_url_names_a_simulation():
    simulation = open_source("sim://room?trajectory=rotation%3Fwy=0.5&seed=4&camera=davis240c&height=1.2&seconds=0.5")
    assert isinstance(simulation, Simulation)
    assert simulation.sensor == Sensor(240, 180)
    assert simulation.camera("c").height_m == 1.2
    assert simulation.twists().t[-1] == 500_000
    assert simulation.name == "room rotation 4"
    np.testing.assert_allclose(np.linalg.norm(simulation.twists().twist[:, 3:], axis=1), 0.5)


def test_a_simulation_without_seconds_never_ends():
    simulation = open_source("sim://?seed=3&camera=pinhole:86x65:75")
    assert simulation.endless
    assert simulation.sensor == Sensor(86, 65)
    assert simulation.twists() is None
    assert simulation.streams == ("events",)
    assert next(simulation.chunks()).n > 0


def test_a_simulation_continues_along_the_next_trajectory():
    mounted = [Mounted(slider(0, 0, speed, 0.1), 1.5, 5) for speed in (4.0, 6.0, 8.0)]
    simulation = Simulation(
        "street", named_scene("street"), mounted[0], SMALL, QUIET, 3, float("inf"), lambda number: mounted[number % 3]
    )
    steps = list(itertools.islice(simulation.steps(), 12))
    assert [step.start_us for step in steps] == [20_000 * k for k in range(12)]
    speeds = [float(np.linalg.norm(step.twists.twist[-1, :3])) for step in steps]
    np.testing.assert_allclose(speeds, [4.0] * 5 + [6.0] * 5 + [8.0] * 2)
    check_events(Events.join([step.events for step in steps]), simulation.sensor)


@pytest.mark.parametrize(
    ("url", "field"),
    [
        ("sim://desert", "scene"),
        ("sim://street?camera=eye", "camera"),
        ("sim://street?camera=pinhole:4x4:90", "sensor"),
        ("sim://street?camera=pinhole:400x400:170", "hfov_deg"),
        ("sim://street?trajectory=flying", "name"),
        ("sim://street?seed=-1", "seed"),
        ("sim://street?seed=many", "seed"),
        ("sim://street?height=0", "height_m"),
        ("sim://street?height=nan", "height"),
        ("sim://street?pitch=90", "pitch_deg"),
        ("sim://street?seconds=0", "seconds"),
        ("sim://street?seconds=soon", "seconds"),
    ],
)
def test_an_unknown_name_or_value_is_refused_with_its_field_and_bound(url, field):
    with pytest.raises(InvalidField) as caught:
        simulation_of(url)
    assert caught.value.details["field"] == field
    assert caught.value.details["bound"]


@pytest.mark.parametrize("url", ["sim://street?colour=red", "sim://street/left"])
def test_a_url_that_is_not_a_simulation_is_refused(url):
    with pytest.raises(UnknownSource):
        simulation_of(url)


def test_a_sensor_other_than_that_of_the_camera_is_refused():
    with pytest.raises(InvalidField):
        simulation_of("sim://street", Sensor(640, 480))
    assert simulation_of("sim://street?camera=prophesee", Sensor(640, 480)).sensor == Sensor(640, 480)


@pytest.mark.parametrize(("seed", "seconds", "field"), [(-1, 1.0, "seed"), (0, 0.0, "seconds"), (0, 99.0, "seconds")])
def test_invalid_seeds_and_durations_are_refused(seed, seconds, field):
    with pytest.raises(InvalidField) as caught:
        simulate("street", parse_trajectory("driving", 10), SMALL, seed=seed, seconds=seconds)
    assert caught.value.details["field"] == field


def test_a_picture_of_a_simulation_is_written_atomically(tmp_path):
    pytest.importorskip("matplotlib")
    simulation = film("street", driving(3, 30), 5, PixelConfig())
    draw(simulation, tmp_path / "street.png", 1.0)
    assert (tmp_path / "street.png").read_bytes().startswith(b"\x89PNG")
    assert [file.name for file in tmp_path.iterdir()] == ["street.png"]
    with pytest.raises(InvalidField):
        draw(simulation, tmp_path / "no" / "street.png", 1.0)


# --- against a real recording ---------------------------------------------------------------------------------------


def test_a_simulated_slider_has_the_statistics_of_the_real_one():
    real = Events.join(list(open_source(str(shared("slider_depth/events_chunk.txt"))).chunks()))
    rows = np.loadtxt(shared("slider_depth/groundtruth.txt"))
    poses = Poses((rows[:, 0] * 1e6).astype(np.int64), rows[:, 1:4], rows[:, 4:8])
    camera = named_camera("davis240c-slider", height_m=0.3, pitch_deg=0)
    simulated = everything(simulate("wall", from_poses(poses), camera, seed=0, seconds=0.17))
    for name, value in statistics(real).items():
        assert 0.5 < statistics(simulated)[name] / value < 2, name


def test_a_real_drive_of_mvsec_runs_through_a_simulated_street():
    pytest.importorskip("h5py", reason="h5py is not installed: pip install 'neurove[recordings]'")
    drive = parse_trajectory(f"{shared('mvsec/outdoor_day1_odom.h5')}?start=20", 3.0)
    simulation = simulate("street", drive, SMALL, seed=3, seconds=1.0)
    events, truth = everything(simulation), simulation.twists()
    per_window = np.bincount(events.t // 100_000, minlength=10)[:10]
    assert per_window.min() > 100, per_window
    speed = np.linalg.norm(truth.twist[:, :3], axis=1)
    position = drive.pose(truth.t / 1e6)[0]
    went = np.linalg.norm(np.diff(position, axis=0), axis=1) / (np.diff(truth.t) * 1e-6)
    assert speed.min() > 1.0  # it does drive
    np.testing.assert_allclose((speed[1:] + speed[:-1]) / 2, went, rtol=1e-3)


def statistics(events: Events) -> dict[str, float]:
    """Rate per pixel [Hz], share of ON, and quartiles of the time between two events of a pixel [us]."""
    pixel = events.y.astype(np.int64) * 240 + events.x
    order = np.lexsort((events.t, pixel))
    between = np.diff(events.t[order])[np.diff(pixel[order]) == 0]
    quartiles = dict(zip(("q25", "q50", "q75"), np.percentile(between, [25, 50, 75]).tolist(), strict=True))
    rate_hz = events.n / (int(events.t[-1] - events.t[0]) * 1e-6) / (240 * 180)
    return quartiles | {"rate": rate_hz, "on": float(events.p.mean()), "off": float(1 - events.p.mean())}
