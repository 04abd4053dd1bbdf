"""Write hashes.txt: the pins of constraints.txt with the hashes of their files, for `pip install --require-hashes`.

Usage: python deploy/hashes.py INDEX. INDEX is the address of a package index that you trust, without the name of a
package (the address that `pip config get global.index-url` or the documentation of your index gives). The index must
offer JSON (PEP 691). Every file of a pinned version is listed, so the result does not depend on platform or Python
version. torch is left out, because its builds for CPU and GPU differ under one version.
"""

import json
import re
import sys
import urllib.error
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PINS = ROOT / "constraints.txt"
HASHES = ROOT / "hashes.txt"
WITHOUT_HASH = ("torch",)
HEADER = """\
# Written by deploy/hashes.py from constraints.txt: the same pins with the hashes of all their files.
"""
JSON = "application/vnd.pypi.simple.v1+json"


def pins(text: str) -> dict[str, str]:
    """The pins of a constraints file, by name of package: lines `name==version` with an optional marker."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return {line.partition("==")[0]: line for line in lines}


def belongs(filename: str, name: str, version: str) -> bool:
    """Whether a file of the index is of this package and version: a wheel, or a source archive."""
    stem = "[-_.]".join(re.split("[-_.]+", name))
    return re.match(rf"{stem}-{re.escape(version)}(-.*\.whl|\.tar\.gz|\.zip)$", filename, re.IGNORECASE) is not None


def hashes_of(index: str, name: str, version: str) -> list[str]:
    """The sha256 of every file of this version, sorted; ends the program if the index has none."""
    page = f"{index.rstrip('/')}/{re.sub('[-_.]+', '-', name).lower()}/"
    request = urllib.request.Request(page, headers={"Accept": JSON})
    try:
        with urllib.request.urlopen(request, timeout=60) as reply:
            files = json.load(reply)["files"]
    except (urllib.error.URLError, ValueError) as error:
        sys.exit(f"hashes.py: {page}: {error}")
    found = sorted(file["hashes"]["sha256"] for file in files if belongs(file["filename"], name, version))
    if not found:
        sys.exit(f"hashes.py: {page} has no file of {name} {version}")
    return found


def main() -> None:
    """Ask the index for every pin, then write hashes.txt as a whole."""
    if len(sys.argv) != 2 or not sys.argv[1].startswith("https://"):
        sys.exit("usage: python deploy/hashes.py INDEX (an https:// address)")
    blocks = []
    for name, line in pins(PINS.read_text(encoding="utf-8")).items():
        if name not in WITHOUT_HASH:
            version = line.partition(";")[0].partition("==")[2]
            hashes = [f"--hash=sha256:{one}" for one in hashes_of(sys.argv[1], name, version)]
            blocks.append(" \\\n    ".join([line, *hashes]))
    HASHES.write_text(HEADER + "\n".join(blocks) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
