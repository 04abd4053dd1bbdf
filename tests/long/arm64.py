"""The compiled engine on arm64, emulated: `python -m tests.long.arm64 --folder DIR`; minutes, on a busy machine ten.

It needs Debian with mmdebstrap, its mirror and PyPI. The run unpacks a Python for arm64 and the emulator of qemu-user
into the folder, without installing anything, and runs networks in float32 and int8 there and here. Potentials must be
equal bit for bit. Twists may differ by the rounding of the cells. The times mean nothing.
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
        digest = hashlib.sha256(b"".join(maps.tobytes() for maps in state.membranes)).hexdigest()
        found[precision] = {"compiled": runner.is_compiled, "potentials": digest, "twists": twists}
    return found


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
    return found


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
    print(f"{there['machine']}: {'; '.join(differences) or 'equal potentials in float32 and int8'}")
    return bool(differences)


if __name__ == "__main__":
    raise SystemExit(main())
