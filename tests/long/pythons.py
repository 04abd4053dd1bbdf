"""Tests with each Python from 3.11 to 3.14 at hand: `python -m tests.long.pythons --folder DIR`; some minutes each.

Looks for `python3.N` on the PATH, in pyenv's folder and among `--python PATH`, makes a virtual environment for each in
the folder (once), installs the pinned packages from PyPI, and runs tests. It names the versions that are missing. torch
from PyPI has several gigabytes on x86-64, because it computes on GPUs too; `--pip="--index-url ..."` chooses another
build, and `--without-torch` installs none: test files that need it then count as not run.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parents[2]
VERSIONS = ("3.11", "3.12", "3.13", "3.14")
TESTS = ("tests/protocol", "tests/neurove_core/ingest", "tests/neurove_core/engine", "tests/neurove_core/refine")
TOOLS = ("hypothesis", "pytest>=8", "pytest-xdist>=3.6")
LIGHT = "serve,recordings,ros2,page,metrics"
_VERSION = "import sys; print('%d.%d' % sys.version_info[:2])"


def interpreters(given: list[Path]) -> dict[str, str]:
    """A working interpreter for each version that has one; those that were given come first."""
    found: dict[str, str] = {}
    for path in [*map(str, given), *_known()]:
        ran = subprocess.run([path, "-c", _VERSION], capture_output=True, text=True, check=False)
        if ran.returncode == 0 and ran.stdout.strip() in VERSIONS:
            found.setdefault(ran.stdout.strip(), path)
    return found


def _known() -> Iterator[str]:
    for version in VERSIONS:
        if (path := shutil.which(f"python{version}")) is not None:
            yield path
        folder = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
        yield from map(str, sorted(folder.glob(f"{version}.*/bin/python")))


def prepared(python: str, folder: Path, pip: list[str], *, torch: bool) -> str:
    """The Python of a virtual environment with NeuroVE and what its tests need."""
    own = folder / "bin" / "python"
    if not (folder / "ready").exists():
        subprocess.run([python, "-m", "venv", str(folder)], check=True)
        what = ["-e", f"{ROOT}[dev]"] if torch else ["-e", f"{ROOT}[{LIGHT}]", *TOOLS]
        install = [str(own), "-m", "pip", "install", "-q", "-c", str(ROOT / "constraints.txt"), *pip]
        subprocess.run([*install, *what], check=True)
        (folder / "ready").touch()
    return str(own)


def ran(python: str, folder: Path, tests: list[str]) -> tuple[str, bool]:
    """Run tests: the counts as a sentence, and whether all passed."""
    results = folder / "results.xml"
    results.unlink(missing_ok=True)
    flags = ["-q", "-p", "no:cacheprovider", "--continue-on-collection-errors", f"--junitxml={results}"]
    subprocess.run([python, "-m", "pytest", *flags, *tests], cwd=ROOT, check=False)
    if not results.exists():
        return "pytest ended without results", False
    cases = list(ElementTree.parse(results).getroot().iter("testcase"))
    kinds = {kind: [one for one in cases if one.find(kind) is not None] for kind in ("skipped", "failure", "error")}
    lacking = [one for one in kinds["error"] if "No module named 'torch'" in (one.find("error").text or "")]
    bad = [one for one in (*kinds["failure"], *kinds["error"]) if one not in lacking]
    passed = len(cases) - sum(map(len, kinds.values()))
    need = f", {len(lacking)} files not run, which need torch" if lacking else ""
    return f"{passed} passed, {len(kinds['skipped'])} skipped, {len(bad)} failed{need}", passed > 0 and not bad


def main() -> int:
    """Run what can be run; the exit code is 1 where a test failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tests", nargs="*", default=TESTS, help=f"what pytest runs; default: {' '.join(TESTS)}")
    parser.add_argument("--folder", type=Path, default=Path("build/pythons"), help="keeps the environments")
    parser.add_argument("--python", type=Path, action="append", default=[], help="another interpreter; repeatable")
    parser.add_argument("--pip", default="", help="further arguments of pip install")
    parser.add_argument("--without-torch", action="store_true", help="install no torch")
    given = parser.parse_args()
    found, good = interpreters(given.python), True
    lines = []
    for version in VERSIONS:
        if version not in found:
            lines.append(f"{version}: not run, no interpreter at hand")
            continue
        folder = given.folder.resolve() / (f"{version}-light" if given.without_torch else version)
        try:
            python = prepared(found[version], folder, shlex.split(given.pip), torch=not given.without_torch)
        except subprocess.CalledProcessError as error:
            lines.append(f"{version}: not run, {shlex.join(map(str, error.cmd[:4]))} ... failed")
            good = False
            continue
        sentence, passed = ran(python, folder, list(given.tests))
        lines.append(f"{version}: {sentence} ({found[version]})")
        good = good and passed
    print("\n".join(lines))
    return not good


if __name__ == "__main__":
    sys.exit(main())
