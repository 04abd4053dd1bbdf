"""Pictures of the live page of a demo, by a real Chromium: `python -m tests.long.page_picture`; --help has the options.

Without --all: one picture, service/pictures/page.png, with at most 250 kB. A machine that cannot simulate in real time
plays a recording of the simulator instead: `--source drive.mcap --loop`.
"""

import argparse
import io
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

FILE = Path("service/pictures/page.png")
MOST_BYTES = 250_000
FULL_S, LONGEST_S = 23.0, 600.0
ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
)
ALL = [
    (width, height, scheme) for width, height in ((390, 844), (820, 1100), (1440, 900)) for scheme in ("dark", "light")
]


def main() -> int:
    """Make the picture, or all of them in a folder."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--source", default="sim://street?seed=7")
    parser.add_argument("--loop", action="store_true", help="repeat the source")
    parser.add_argument("--all", type=Path, metavar="FOLDER", help="three widths, dark and light")
    args = parser.parse_args()
    command = [sys.executable, "-m", "neurove_service.cli", "demo", args.source, "--page", "--seconds", "3600"]
    demo = subprocess.Popen([*command, *(["--loop"] if args.loop else [])], stdout=subprocess.PIPE, text=True)
    try:
        found = re.search(r"http://\S+/", demo.stdout.readline() if demo.stdout else "")
        if found is None:
            return 1
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(ARGUMENTS))
            looks = ALL if args.all else [(1280, 640, "dark")]
            for width, height, scheme in looks:
                context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
                page = context.new_page()
                page.goto(found[0])
                settled(page)
                target = args.all / f"page-{width}-{scheme}.png" if args.all else FILE
                write_png(page.screenshot(full_page=True), target)
                context.close()
            browser.close()
    finally:
        demo.terminate()
        demo.wait(60)
    return 0


def settled(page: Page) -> None:
    """Wait until the plots are full and an image is there."""
    deadline = time.monotonic() + LONGEST_S
    since = None
    while time.monotonic() < deadline:
        page.wait_for_timeout(250)
        live = page.evaluate("Number(document.querySelector('.picture')?.dataset.images ?? 0) > 2")
        since = (since or time.monotonic()) if live else None
        age_s = page.evaluate("document.querySelector('.node .facts')?.innerText.match(/up\\s+(\\d+)/)?.[1] ?? 0")
        if since is not None and (float(age_s) > FULL_S + 6 or time.monotonic() - since > FULL_S):
            return
    raise TimeoutError(f"no full plots within {LONGEST_S:.0f} s")


def write_png(png: bytes, file: Path) -> None:
    """Write a picture with a palette."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    for colours in (256, 128, 64, 32):
        packed = io.BytesIO()
        picture.quantize(colours, dither=Image.Dither.NONE).save(packed, "PNG", optimize=True)
        if len(packed.getvalue()) <= MOST_BYTES:
            break
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(packed.getvalue())
    print(f"{file}: {len(packed.getvalue()):,} bytes")


if __name__ == "__main__":
    sys.exit(main())
