"""Build the wheel and check it as a user sees it: its names, its metadata, and that it runs outside this checkout."""

import email
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from email.message import Message
from pathlib import Path

PACKAGES = {"neurove_core", "neurove_protocol", "neurove_service"}
BASE = {
    "eclipse-zenoh",
    "msgpack",
    "numpy",
    "pydantic",
    "pydantic-settings",
    "rich",
    "shtab",
    "structlog",
}
EXTRAS = {
    "serve", "recordings", "train", "experiments", "carla", "ros2", "camera", "page", "metrics", "foxglove", "docs",
    "cluster", "bench", "all", "dev",
}  # fmt: skip
HEAVY = {"torch", "zenoh", "numba"}
LIGHT_IMPORT = f"import sys, neurove_protocol; print(sorted({HEAVY} & set(sys.modules)))"
BESIDE_OTHERS = (
    "import protocol, service, neurove_protocol, neurove_service, neurove_core; "
    "print(protocol.OWNER, service.OWNER, neurove_service.__file__)"
)


def check_names(wheel: Path) -> None:
    """The wheel installs only names that are ours, with type marks, models and training configurations."""
    names = zipfile.ZipFile(wheel).namelist()
    top = {name.partition("/")[0] for name in names}
    assert {name for name in top if not name.endswith((".dist-info", ".data"))} == PACKAGES, top
    shipped = {name.partition(".data/data/share/neurove/")[2] for name in names if ".data/" in name}
    assert shipped == {"neurove.service", "neurove.toml", "zenoh-router.json5", "zenoh-router.service"}, shipped
    for needed in (
        *(f"{package}/py.typed" for package in PACKAGES),
        "neurove_core/models/default.safetensors",
        "neurove_core/training/configs/default.toml",
        "neurove_service/cli/__main__.py",
    ):
        assert needed in names, needed
    folders = {Path(name).parent.as_posix() for name in names if name.endswith(".py")}
    here = {"neurove_core": "neurove_core", "protocol": "neurove_protocol", "service": "neurove_service"}
    for folder, package in here.items():
        for path in Path(folder).rglob("__init__.py"):
            wanted = "/".join([package, *path.parent.parts[1:]])
            assert wanted in folders, f"{wanted} is missing: add it to packages in pyproject.toml"


def check_metadata(about: Message) -> None:
    """Licence, authors, keywords and classifiers are there; a URL is not, for there is none."""
    assert about["License-Expression"] == "Apache-2.0"
    assert about.get_all("License-File") == ["LICENSE"]
    assert about["Author"] == "NeuroVE developers"
    assert about.get_all("Project-URL") is None
    assert about["Home-page"] is None
    assert "event camera" in about["Keywords"]
    classifiers = about.get_all("Classifier") or []
    assert any(one.startswith("Programming Language :: Python :: 3.11") for one in classifiers)
    assert set(about.get_all("Provides-Extra") or []) == EXTRAS
    required = [one for one in about.get_all("Requires-Dist") or [] if "extra ==" not in one]
    assert {one.replace(">", " ").replace(",", " ").split()[0].split("<")[0] for one in required} == BASE, required


def run(code: list[str], folder: str, *path: Path) -> str:
    """What a Python process prints that imports from these folders first."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path))}
    command = [sys.executable, *code]
    return subprocess.run(
        command, cwd=folder, env=environment, check=True, capture_output=True, text=True, timeout=120
    ).stdout.strip()


def main() -> None:
    shutil.rmtree("build", ignore_errors=True)  # setuptools would add removed modules from it
    with tempfile.TemporaryDirectory() as folder:
        built, unpacked, others = Path(folder, "built"), Path(folder, "unpacked"), Path(folder, "others")
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", str(built), "."], check=True)
        (wheel,) = built.glob("neurove-*.whl")
        check_names(wheel)
        with zipfile.ZipFile(wheel) as archive:
            (metadata,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
            check_metadata(email.message_from_bytes(archive.read(metadata)))
        subprocess.run([*pip, "install", "--no-deps", "--target", str(unpacked), str(wheel)], check=True)

        assert "usage: neurove" in run(["-m", "neurove_service.cli", "--help"], folder, unpacked)
        assert run(["-c", LIGHT_IMPORT], folder, unpacked) == "[]"
        for name in ("protocol", "service"):  # packages of another project
            (others / name).mkdir(parents=True)
            (others / name / "__init__.py").write_text("OWNER = 'another project'\n")
        found = run(["-c", BESIDE_OTHERS], folder, others, unpacked)
        assert found == f"another project another project {unpacked / 'neurove_service' / '__init__.py'}", found
        print(f"{wheel.name}: {wheel.stat().st_size / 1e3:.0f} kB, runs")


if __name__ == "__main__":
    main()
