"""The documentation site: no broken link, a complete navigation, a reference with what the docstrings say.

tests/test_readme.py checks commands, links and language of its pages, as of every other page.
"""

import contextlib
import functools
import http.server
import io
import re
import shutil
import subprocess
import sys
import threading
from html.parser import HTMLParser
from pathlib import Path

import pytest
from PIL import Image

from tests.long.docs_pictures import FOLDER, PICTURES

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "deploy" / "docs"
NAVIGATION = re.findall(r": ([\w./-]+\.md)$", (DOCS / "mkdocs.yml").read_text(), re.MULTILINE)


class Page(HTMLParser):
    """The links and the text of a page."""

    def __init__(self, text):
        super().__init__()
        self.links, self.text = [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.links += [given[name] for name in ("href", "src") if given.get(name)]

    def handle_data(self, data):
        self.text += data


def run_build(out):
    command = [sys.executable, str(DOCS / "build.py"), str(out)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("zensical", reason="zensical is not installed: pip install 'neurove[docs]'")
    out = tmp_path_factory.mktemp("docs")
    built = run_build(out)
    assert built.returncode == 0, built.stdout + built.stderr
    return out / "site"


def html_of(site, page):
    name = page.replace("README.md", "index.md") if page.endswith("README.md") else page
    return (site / name).with_suffix(".html").read_text()


def test_every_page_of_the_navigation_is_built_and_every_guide_is_in_it(site):
    for page in NAVIGATION:
        assert len(Page(html_of(site, page)).text) > 500, page
    guides = {path.relative_to(ROOT).as_posix() for path in DOCS.glob("*.md")}
    guides |= {path.relative_to(ROOT).as_posix() for path in (ROOT / "deploy").glob("*.md")}
    assert guides <= set(NAVIGATION)


def test_links_and_pictures_of_the_built_pages_lead_to_files(site):
    missing = set()
    for page in NAVIGATION:
        name = page.replace("README.md", "index.md")
        for link in Page(html_of(site, page)).links:
            target = link.partition("#")[0].partition("?")[0]
            if target and not re.match(r"[a-z]+:|//|/", target):
                path = (site / name).parent / target
                if not (path.is_file() or (path / "index.html").is_file()):
                    missing.add((page, link))
    assert missing == set()


def test_the_reference_has_shapes_units_and_errors_from_the_docstrings(site):
    estimator = Page(html_of(site, "reference/neurove_core.md")).text
    for said in ("class Estimator(", "Estimator.push", "Args", "Raises", "InvalidField"):
        assert said in estimator
    messages = Page(html_of(site, "reference/neurove_protocol.md")).text
    for said in ("linear [m/s], then angular [rad/s]", "upper bounds of the buckets", "height of the camera above the"):
        assert said.lower() in messages.lower()
    assert "object at 0x" not in estimator + messages


@pytest.mark.parametrize("symptom", ["Speed is 0", "Flagged uncertain", "Packets are lost", "wrong scale"])
def test_the_page_of_symptoms_has_a_section_for(symptom):
    headings = re.findall(r"^## (.*)$", (DOCS / "troubleshooting.md").read_text(), re.MULTILINE)
    assert any(symptom.lower() in heading.lower() for heading in headings)


def test_every_picture_of_the_guides_is_made_by_the_script_and_shown_with_a_description():
    shown = {}
    for page in DOCS.glob("*.md"):
        shown |= {name: about for about, name in re.findall(r"!\[([^\]]*)\]\(pictures/([\w.-]+)\)", page.read_text())}
    assert set(shown) == set(PICTURES) == {path.name for path in (DOCS / "pictures").iterdir()}
    assert min(map(len, shown.values())) > 30
    assert (ROOT / FOLDER).resolve() == DOCS / "pictures"


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_small_and_loads_nothing(name):
    data = (DOCS / "pictures" / name).read_bytes()
    assert len(data) < 120_000
    if name.endswith(".svg"):
        addresses = set(re.findall(r"https?://[\w.-]+", data.decode()))
        assert addresses <= {"http://www.w3.org", "https://www.textualize.io"}  # a namespace and a comment
        assert len(re.sub(r"<[^>]*>", "", data.decode().rpartition("</style>")[2]).strip()) > 200  # text is in it
    else:
        with Image.open(io.BytesIO(data)) as picture:
            assert picture.width in (390, 968, 1000, 1280)
            assert len(picture.getcolors(1 << 20)) > 20  # not an empty page


def test_no_page_loads_anything_from_another_host(site):
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed")
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    asked = []
    with local(site) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", "--disable-gpu"], timeout=120_000
        )
        page = browser.new_page()
        page.set_default_timeout(120_000)
        page.on("request", lambda request: asked.append(request.url))
        for name in (
            "protocol/index.html",
            "index.html",
            "deploy/docs/start.html",
            "deploy/docs/troubleshooting.html",
            "reference/spiking.html",
        ):
            page.goto(f"{address}/{name}", wait_until="networkidle")
            assert page.evaluate("[...document.images].every(one => one.complete && one.naturalWidth > 0)"), name
        browser.close()
    assert len(asked) > 8
    assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []


@contextlib.contextmanager
def local(folder):
    """The site on a free port of this machine."""
    handler = functools.partial(Quiet, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Without a line for each request."""

    def log_message(self, *_):
        pass
