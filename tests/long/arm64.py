"""The compiled code on arm64, emulated: `python -m tests.long.arm64 --folder DIR`; on a busy machine an hour.

It needs Debian with mmdebstrap, its mirror and PyPI. The run unpacks a Python for arm64 and the emulator of qemu-user
into the folder, without installing anything, and runs the same there and here: networks in float32 and int8, events to
windows, and the refinement of turning cameras and of one that drives over level ground. Potentials, look-up table,
counts and samples must be equal bit for bit. Twists may differ by the rounding of the cells, refined motions by that of
sums and of sin, cos and exp. The times mean nothing.
"""

import argparse
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

DEBIAN = "http://deb.debian.org/debian"
LIBRARIES = (
    "libpython3.11-stdlib libstdc++6 libgcc-s1 zlib1g libc6 libexpat1 libffi8 libssl3 libsqlite3-0 libbz2-1.0 liblzma5"
)
PACKAGES = (
    *("annotated-types", "llvmlite", "msgpack", "numba", "numpy", "pydantic", "pydantic_core", "safetensors"),
    *("typing-inspection", "typing_extensions"),
)
PLATFORMS = ("manylinux_2_28_aarch64", "manylinux_2_27_aarch64", "manylinux_2_17_aarch64", "manylinux2014_aarch64")
TOLERANCE = 1e-6  # of a twist, relative to the largest one
REFINED = 1e-3  # of a refined motion and its covariance, relative to the largest number of each
WINDOW_US = 50_000
ROOT = Path(__file__).parents[2]


def answers() -> dict[str, Any]:
    """Digest of the potentials and twists of three windows, for each precision."""
    import numpy as np

    from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
    from neurove_core.engine.array_runner import ArrayRunner
    from neurove_core.networks.arrays import Weights, shapes

    found: dict[str, Any] = {"machine": platform.machine()}
    for precision in ("float32", "int8"):
        net = NetworkConfig.model_validate(
            {"channels": (16, 32), "features": 32, "hidden": 16, "precision": precision, "v_th": 0.4}
        )
        config = ModelConfig(canonical=CanonicalConfig(width=33, height=21), network=net)
        rng = np.random.default_rng(20_510)
        tensors = {
            name: np.abs(rng.normal(0, 0.1, shape)).astype(np.float32)
            for name, shape in shapes(config, spread=False).items()
        }
        runner = ArrayRunner(Weights(config, tensors))
        state, twists = runner.initial_state(), []
        for _ in range(3):
            counts = rng.poisson(0.5, config.input_shape).astype(np.uint8)
            ((twist, state),) = runner.run([counts], [state])
            twists.append(twist.tolist())
        digest = _digest(*state.membranes)
        found[precision] = {"compiled": runner.is_compiled, "potentials": digest, "twists": twists}
    return found | {"windows": counted(), "refined": refined()}


def counted() -> dict[str, str]:
    """Digests on the way from events to windows: as columns and in the layout of a packet."""
    from neurove_core.config import CanonicalConfig, WindowConfig
    from neurove_core.geometry.tables import TABLES
    from neurove_core.ingest import windows
    from neurove_core.ingest.windows import WindowsState
    from neurove_core.warming import warm_camera, warm_events
    from neurove_protocol import Sensor

    sensor, canonical, config = Sensor(64, 48), CanonicalConfig(width=33, height=21), WindowConfig()
    lut = TABLES.of(canonical, sensor, warm_camera(sensor))
    found = {"look-up table": _digest(lut)}
    for name, events in zip(("columns", "packet"), warm_events(sensor, config.duration_us), strict=True):
        closed = windows.push(events, 4 * WINDOW_US, WindowsState(), lut, config, canonical, sampled=True).windows
        found[f"counts of {name}"] = _digest(*(one.counts for one in closed))
        found[f"sample of {name}"] = _digest(*(column for one in closed if one.sample for column in one.sample))
    return found


def refined() -> dict[str, list[Any]]:
    """Outcome and numbers of each window: of turning cameras, and of a camera that drives over level ground."""
    import numpy as np

    from neurove_core.ingest.sample import Sample
    from neurove_core.refine import ground, stages
    from neurove_core.refine.alignment import image, tiles
    from neurove_core.refine.ground import GroundState
    from neurove_core.refine.rotation import Given
    from neurove_core.refine.search import jacobian
    from neurove_core.refine.view import View
    from neurove_protocol import CameraInfo

    rng, events = np.random.default_rng(20_511), 3_000
    lens = {"width": 160, "height": 120, "fx": 130.0, "fy": 130.0, "cx": 80.0, "cy": 60.0, "height_m": 1.0}
    camera = CameraInfo(stream="cam0", lens="pinhole", **lens)
    view = View.of(camera)
    assert view is not None
    found: dict[str, list[Any]] = {"alignment": [], "rotation": [], "ground": []}

    def sampled(x: Any, y: Any, t_us: Any) -> Sample:
        column, row = (130 * x + 80).round(), (130 * y + 60).round()
        inside = (column >= 0) & (column < 160) & (row >= 0) & (row < 120)
        return Sample(t_us[inside], column[inside].astype(np.uint16), row[inside].astype(np.uint16))

    state = stages.State()
    for number in range(3):
        w = np.array([0.2, -0.5, 0.1]) * (1 + number)
        points = rng.uniform([-0.55, -0.4], [0.55, 0.4], (events // 12, 2))[rng.integers(0, events // 12, events)]
        t_us = np.sort(rng.integers(0, WINDOW_US, events)).astype(np.int32)
        flow = np.einsum("kia,a->ki", jacobian(*points.T), np.append(w, np.zeros(3)) * WINDOW_US / 1e6)
        sample = sampled(*(points - (t_us / WINDOW_US - 0.5)[:, None] * flow).T, t_us)
        twist, start_us = np.append(np.zeros(3), 0.6 * w), number * WINDOW_US
        given = Given(start_us, WINDOW_US, sample, view, twist, np.eye(6) * 0.04, low_activity=False, before=None)
        rays = view.rays_of(sample, WINDOW_US)
        smooth = image(rays, np.zeros(6), view.grid)
        sums = [np.asarray(one, np.float64).ravel().tolist() for one in tiles(rays, np.zeros(6), view.grid, smooth)]
        found["alignment"].append(["", smooth.ravel().astype(float).tolist(), *sums])
        answer = stages.refine(given, state)
        state, rate = answer.state, answer.turn.rate
        found["rotation"].append([answer.turn.outcome, rate.w_rad_s.tolist(), rate.covariance.ravel().tolist()])
    level = GroundState()
    for number in range(5):
        t_us = np.sort(rng.integers(0, WINDOW_US, events)).astype(np.int32)
        points = rng.uniform([-3.0, 1.2], [3.0, 9.0], (events // 12, 2))[rng.integers(0, events // 12, events)]
        depth = points[:, 1] - 2.0 * t_us / 1e6  # 2 m/s
        sample, start_us = sampled(points[:, 0] / depth, 1 / depth, t_us), number * WINDOW_US
        known = np.array([0.0, 0.0, 1.7, 0.0, 0.0, 0.0]), np.full(3, 0.05)
        rays_down = ground.events_of(view, sample, start_us)
        moved = ground.refine(rays_down, start_us, start_us + WINDOW_US, camera, *known, level)
        level = moved.state
        numbers = (
            [] if moved.motion is None else [moved.motion.twist.tolist(), moved.motion.covariance.ravel().tolist()]
        )
        found["ground"].append([moved.outcome, *numbers])
    return found


def _digest(*arrays: Any) -> str:
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def prepared(folder: Path) -> list[str]:
    """The command of an emulated Python, whose files lie in the folder afterwards."""
    folder.mkdir(parents=True, exist_ok=True)
    system, site, qemu = folder / "system", folder / "site", shutil.which("qemu-aarch64-static")
    if not system.exists():
        names = ",".join(["python3.11-minimal", *LIBRARIES.split()])
        made = [
            "mmdebstrap",
            "--arch=arm64",
            "--variant=extract",
            f"--include={names}",
            "bookworm",
            str(system),
            DEBIAN,
        ]
        subprocess.run(made, check=True)
    if qemu is None:
        subprocess.run(["apt-get", "download", "qemu-user-static"], cwd=folder, check=True)
        subprocess.run(
            ["dpkg", "-x", *map(str, folder.glob("qemu-user-static*.deb")), str(folder / "qemu")], check=True
        )
        qemu = str(folder / "qemu" / "usr" / "bin" / "qemu-aarch64-static")
    if not site.exists():
        pins = ROOT / "constraints.txt"
        where = [flag for one in PLATFORMS for flag in ("--platform", one)]
        fixed = ["--python-version", "3.11", "--only-binary=:all:", "--no-deps", "-c", str(pins), "--target", str(site)]
        subprocess.run([sys.executable, "-m", "pip", "install", "-q", *fixed, *where, *PACKAGES], check=True)
        for name, source in (("neurove_core", "neurove_core"), ("neurove_protocol", "protocol")):
            (site / name).symlink_to(ROOT / source)
    return [qemu, "-L", str(system), str(system / "usr" / "bin" / "python3.11")]


def emulated(folder: Path) -> dict[str, Any]:
    """The answers of the emulated machine."""
    env = os.environ | {
        "PYTHONPATH": str(folder / "site"),
        "PYTHONDONTWRITEBYTECODE": "1",
        "NUMBA_CACHE_DIR": str(folder / "cache"),
    }
    command = [*prepared(folder), str(Path(__file__)), "--answers"]
    found: dict[str, Any] = json.loads(subprocess.run(command, env=env, stdout=subprocess.PIPE, check=True).stdout)
    return found


def compare(here: dict[str, Any], there: dict[str, Any]) -> list[str]:
    """What differs, one sentence each."""
    found = []
    for precision in ("float32", "int8"):
        ours, theirs = here[precision], there[precision]
        if not theirs["compiled"]:
            found.append(f"{precision}: the compiled form does not work on {there['machine']}")
        if ours["potentials"] != theirs["potentials"]:
            found.append(f"{precision}: potentials differ")
        one, other = ([x for window in run["twists"] for row in window for x in row] for run in (ours, theirs))
        worst = max(abs(a - b) for a, b in zip(one, other, strict=True)) / max(map(abs, one))
        print(f"{precision}: largest difference of a twist {worst:.1e} of the largest twist")
        if worst > TOLERANCE:
            found.append(f"{precision}: twists differ by {worst:.1e}, more than {TOLERANCE:g}")
    found += [f"{what} differs" for what, digest in here["windows"].items() if there["windows"][what] != digest]
    for what, ours in here["refined"].items():
        theirs = there["refined"][what]
        outcomes = [one[0] for one in ours], [one[0] for one in theirs]
        print(f"{what}: outcomes {', '.join(outcomes[0])}" if any(outcomes[0]) else f"{what}:", end=" ")
        if outcomes[0] != outcomes[1]:
            found.append(f"{what}: outcomes differ: {outcomes[1]}")
            continue
        pairs = [pair for one, other in zip(ours, theirs, strict=True) for pair in zip(one, other, strict=True)]
        worst = max(_apart(a, b) for a, b in pairs if not isinstance(a, str))
        print(f"largest difference {worst:.1e} of the largest number")
        if worst > REFINED:
            found.append(f"{what}: numbers differ by {worst:.1e}, more than {REFINED:g}")
    return found


def _apart(ours: list[float], theirs: list[float]) -> float:
    """The largest difference of two lists, as a share of the largest absolute number."""
    return max(abs(a - b) for a, b in zip(ours, theirs, strict=True)) / (max(map(abs, ours)) or 1.0)


def main() -> int:
    """Compare; the exit code is 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("build/arm64"), help="keeps what was unpacked")
    parser.add_argument("--answers", action="store_true", help="only print the answers of this machine")
    given = parser.parse_args()
    if given.answers:
        print(json.dumps(answers()))
        return 0
    there = emulated(given.folder.resolve())
    differences = compare(answers(), there)
    equal = f"equal potentials, table, counts and samples, and refined motions within {REFINED:g}"
    print(f"{there['machine']}: {'; '.join(differences) or equal}")
    return bool(differences)


if __name__ == "__main__":
    raise SystemExit(main())
