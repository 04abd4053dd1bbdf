"""Build a wheel that brings compiled code, so that its first start compiles nothing: `make wheel`.

Usage: python deploy/wheel.py [DIST [PROCESSOR...]]. DIST is the folder of the wheel, `dist` by default. The code is for
x86-64-v3 by default, which this machine must be able to run, or for the processors that are named (`neurove warm-up
--help` lists them). It is used where Python, numba, llvmlite and numpy have the versions of this environment, and is
ignored elsewhere: there the first start compiles. Takes a minute for each processor.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"neurove_core": "neurove_core", "protocol": "neurove_protocol", "service": "neurove_service"}
WITHOUT = shutil.ignore_patterns("__pycache__", "ahead")


def main() -> None:
    """Compile into a copy of the sources, and build the wheel from it."""
    dist, *processors = sys.argv[1:] or ["dist"]
    with tempfile.TemporaryDirectory() as folder:
        copy, packages = Path(folder, "sources"), Path(folder, "packages")
        packages.mkdir()
        for name in (*PACKAGES, "deploy"):
            shutil.copytree(ROOT / name, copy / name, ignore=WITHOUT)
        for name in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy2(ROOT / name, copy)
        for name, package in PACKAGES.items():
            (packages / package).symlink_to(copy / name)
        for processor in processors or ["x86-64-v3"]:
            command = [sys.executable, "-m", "neurove_service.cli", "warm-up", "--ahead", "--cpu", processor]
            subprocess.run(command, cwd=folder, env=os.environ | {"PYTHONPATH": str(packages)}, check=True)
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        command = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(Path(dist).resolve()), "."]
        subprocess.run(command, cwd=copy, check=True)
    for wheel in Path(dist).glob("neurove-*.whl"):
        print(f"{wheel}: {wheel.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
