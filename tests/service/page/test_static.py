"""The files that browsers get: the vendored library is the published one, and nothing comes from elsewhere."""

import hashlib
import re
from pathlib import Path

import numpy as np
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


# What a person without one kind of cone sees, in linear RGB. Source: Machado, Oliveira and Fernandes 2009, severity 1.
SEEN = {
    "all cones": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
PAGE_CSS, CARDS_CSS = ((STATIC / name).read_text() for name in ("page.css", "cards.css"))
LIGHT, DARK = (dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", part)) for part in PAGE_CSS.split("@media", 1))
EVENTS = dict(re.findall(r"\.picture \.(on|off) \{ color: (#[0-9a-f]{6})", CARDS_CSS))
LEAST_DIFFERENCE = 20.0  # of CIE 1976; about 2 can be noticed


def linear(colour):
    """A colour in linear RGB, 0 to 1."""
    values = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """Linear RGB as CIE L*a*b* with the white of D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(np.clip(to_xyz @ np.clip(rgb, 0, 1) / [0.9505, 1.0, 1.089], 0.008856, 1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("sight", SEEN)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colours_that_differ_in_meaning_differ_for_every_kind_of_sight(scheme, sight):
    colours = {"light": LIGHT, "dark": LIGHT | DARK}[scheme]
    pairs = [(colours["linear"], colours["angular"]), (EVENTS["on"], EVENTS["off"])]
    pairs += [
        (colours[one], colours["card"]) for one in ("linear", "angular", "ok", "warn", "bad", "flag", "text", "soft")
    ]
    for one, other in pairs:
        difference = np.linalg.norm(np.subtract(*(lab(SEEN[sight] @ linear(colour)) for colour in (one, other))))
        assert difference > LEAST_DIFFERENCE, (one, other)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["text", "soft", "linear", "angular", "ok", "warn", "bad"])
def test_texts_have_the_contrast_that_wcag_demands(scheme, name):
    colours = {"light": LIGHT, "dark": LIGHT | DARK}[scheme]
    dark, light = sorted(linear(colours[one]) @ [0.2126, 0.7152, 0.0722] for one in (name, "card"))
    assert (light + 0.05) / (dark + 0.05) >= 4.5
