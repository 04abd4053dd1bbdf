"""Build the wheel, and run `neurove --help` from it and not from this checkout."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path


def main() -> None:
    shutil.rmtree("build", ignore_errors=True)  # a module that is gone would come back from it
    with tempfile.TemporaryDirectory() as folder:
        built, unpacked = Path(folder, "built"), Path(folder, "unpacked")
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", str(built), "."], check=True)
        (wheel,) = built.glob("neurove-*.whl")
        subprocess.run([*pip, "install", "--no-deps", "--target", str(unpacked), str(wheel)], check=True)
        check = "import neurove_service.cli.main as cli; print(cli.__file__); cli.main(['--help'])"
        told = subprocess.run(
            [sys.executable, "-c", check],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(unpacked)},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        if not told.startswith(str(unpacked)) or "usage: neurove" not in told:
            sys.exit(f"the wheel's neurove does not run: {told}")
        print(f"{wheel.name}: {wheel.stat().st_size / 1e3:.0f} kB, runs")


if __name__ == "__main__":
    main()
