"""The files that browsers get: the vendored library is the published one, and nothing comes from elsewhere."""

import hashlib
import re
from pathlib import Path

import pytest

from neurove_service.page.web import static_files

STATIC = Path(__file__).parents[3] / "service/page/static"
VENDORED = {  # uPlot 1.6.32 of the npm registry
    "uPlot.iife.min.js": "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f",
    "uPlot.min.css": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
    "uPlot.LICENSE.txt": "8f989229699b4fe2f1a0432d0e9edc338a8a911e250e2d1b01ecd770a5f5b1bd",
}
OWN = sorted(path.name for path in STATIC.iterdir() if path.is_file())


def test_the_vendored_files_are_those_that_were_published():
    found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (STATIC / "vendor").iterdir()}
    assert found == VENDORED


def test_every_file_is_served_with_its_type():
    served = static_files()
    assert {path.rpartition("/")[2] for path in served if path != "/"} == {*OWN, *VENDORED}
    assert served["/"][1].startswith("text/html")
    assert served["/vendor/uPlot.iife.min.js"][1].startswith("text/javascript")


@pytest.mark.parametrize("name", OWN)
def test_no_file_loads_anything_from_another_host_or_makes_markup_of_text(name):
    text = (STATIC / name).read_text()
    addresses = set(re.findall(r"(?:https?:)?//[\w.-]+\.\w+", text))
    assert addresses <= {"http://www.w3.org"}  # the namespace of SVG, which is never loaded
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function", text)
    assert not re.search(r"<style|\sstyle=|\son\w+=\"|javascript:", text)
