"""Draw the Mermaid diagrams of the pages as SVG, so that the site loads nothing from elsewhere.

Usage: python deploy/docs/diagrams.py MERMAID_JS, the file dist/mermaid.min.js of the npm package mermaid (made with
11.12.0: `npm pack mermaid@11.12.0`). It needs Chromium and playwright. Each diagram becomes an SVG in
deploy/docs/diagrams/, named by the SHA-256 of its text, so a diagram that changed has no picture, and the build of the
site says so.
"""

import hashlib
import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(__file__).with_name("diagrams")
FENCE = re.compile(r"^```mermaid\n(.*?)^```$", re.MULTILINE | re.DOTALL)

DRAW = """async (text) => {
  mermaid.initialize({
    startOnLoad: false, theme: "neutral", htmlLabels: true, flowchart: { wrappingWidth: 600 },
    themeCSS: ".cluster-label div { display: block !important; white-space: nowrap !important }"
      + " .cluster-label foreignObject { overflow: visible }",
  });
  return (await mermaid.render("diagram", text)).svg;
}"""


def file_of(text: str) -> Path:
    """Where the picture of a diagram is."""
    return FOLDER / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.svg"


def diagrams() -> dict[Path, str]:
    """Every diagram of the repository: the file of its picture, and its text."""
    pages = [path for path in ROOT.rglob("*.md") if not {"build", ".venv"} & set(path.relative_to(ROOT).parts)]
    return {file_of(text): text for page in pages for text in FENCE.findall(page.read_text(encoding="utf-8"))}


def draw(mermaid: Path) -> None:
    """Write the picture of every diagram, and remove those of diagrams that are gone."""
    from playwright.sync_api import sync_playwright

    wanted = diagrams()
    FOLDER.mkdir(exist_ok=True)
    for old in set(FOLDER.glob("*.svg")) - set(wanted):
        old.unlink()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page()
        page.add_script_tag(path=mermaid)
        for file, text in wanted.items():
            svg: str = page.evaluate(DRAW, text)
            svg = svg.replace("<br>", "<br/>").replace('style="', 'style="background: white; ', 1)  # on a dark page too
            file.write_text(svg + "\n", encoding="utf-8")
        browser.close()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    draw(Path(sys.argv[1]))
