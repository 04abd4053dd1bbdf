"""Pictures of the documentation site: `python -m tests.long.docs_pictures [NAME ...]`; part of `make picture`.

A real service with the default model, two drivers of simulated streets, and a page with an operator are run. A real
Chromium makes the pictures of the page, rich those of the terminal. Every picture has a name in PICTURES; a test holds
these names, the files in deploy/docs/pictures and the pages together.
"""

import argparse
import contextlib
import io
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neurove_core.models import bundle, find
from neurove_service.clients import ask
from tests.live.conftest import START_S, Process, free_endpoint, running, service, wait_until
from tests.long.page_picture import ARGUMENTS, LONGEST_S, write_png

FOLDER = Path("deploy/docs/pictures")
STREAMS = {"front": "sim://street?seed=20101&seconds=12", "rear": "sim://street?seed=20102&seconds=12"}
FULL_S = 32.0
COLUMNS, ROWS = 100, 40


@dataclass
class Scene:
    """What runs: a browser, the address of a page with its operator's token, the drivers, and the service."""

    browser: Any
    url: str
    token: str
    endpoint: str
    drivers: dict[str, Process]
    serving: Process

    @contextlib.contextmanager
    def tab(self, width: int, height: int, scheme: str = "dark") -> Iterator[Any]:
        """A tab with the page."""
        context = self.browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
        try:
            tab = context.new_page()
            tab.goto(self.url)
            until(tab, "document.querySelectorAll('.chart canvas').length >= 12")
            yield tab
        finally:
            context.close()


def until(tab: Any, script: str) -> None:
    """Wait until a script is true in the page."""
    deadline = time.monotonic() + LONGEST_S
    while not tab.evaluate(script):
        if time.monotonic() > deadline:
            raise TimeoutError(f"not true within {LONGEST_S:.0f} s: {script}")
        tab.wait_for_timeout(100)


def verdict(name: str) -> str:
    """The script that reads the verdict of a stream."""
    return f"document.querySelector('#stream-{name} .verdict').innerText"


def live(scene: Scene) -> None:
    """Two streams, when the plots are full."""
    with scene.tab(1280, 860) as tab:
        tab.wait_for_timeout(1000 * FULL_S)
        until(tab, "[...document.querySelectorAll('.picture')].every(one => one.dataset.images > 2)")
        write_png(tab.screenshot(), FOLDER / "page-live.png")


def phone(scene: Scene) -> None:
    """The same on a telephone."""
    with scene.tab(390, 844, "light") as tab:
        until(tab, "document.querySelector('.picture').dataset.images > 2")
        tab.wait_for_timeout(500)
        write_png(tab.screenshot(), FOLDER / "page-phone.png")


def models(scene: Scene) -> None:
    """An operator has activated a model and rolled back."""
    with scene.tab(1000, 700) as tab:
        tab.click("#operate")
        tab.fill("#token", scene.token)
        tab.click("#token-ok")
        until(tab, "!!document.querySelector('.operator:not([hidden]) option')")
        name = "[...document.querySelectorAll('.operator option')].find(o => o.text.startsWith('robot-7')).value"
        tab.select_option(".operator select", tab.evaluate(name))
        for button, model in (("Activate", "robot-7"), ("Roll back", "default")):
            tab.click(f".operator button:has-text('{button}')")
            tab.click("#confirm-ok")
            until(tab, f"document.querySelector('.history li b').innerText === '{model}'")
            until(tab, "!document.querySelector('.operator button:last-of-type').disabled")
        write_png(tab.locator(".node").screenshot(), FOLDER / "page-models.png")


def watch(scene: Scene) -> None:
    """The live table in a terminal."""
    write_terminal(("watch",), scene.endpoint, FOLDER / "watch.svg", seconds=8.0)


def health(scene: Scene) -> None:
    """The verdicts in a terminal."""
    write_terminal(("health",), scene.endpoint, FOLDER / "health.svg")


def idle(scene: Scene) -> None:
    """The driver of one stream has stopped."""
    with scene.tab(1000, 700) as tab:
        tab.locator("#stream-rear").scroll_into_view_if_needed()
        until(tab, "document.querySelector('#stream-rear .picture').dataset.images > 2")
        scene.drivers["rear"].child.send_signal(signal.SIGSTOP)
        try:
            until(tab, verdict("rear") + " === 'idle'")
            tab.wait_for_timeout(3000)
            write_png(tab.locator("#stream-rear").screenshot(), FOLDER / "page-idle.png")
        finally:
            scene.drivers["rear"].child.send_signal(signal.SIGCONT)


def gone(scene: Scene) -> None:
    """The service was killed: the last picture, because nothing serves afterwards."""
    with scene.tab(1000, 560) as tab:
        until(tab, "document.querySelector('#stream-front .picture').dataset.images > 2")
        scene.serving.child.kill()
        until(tab, verdict("front") + " === 'no service'")
        tab.wait_for_timeout(2000)
        write_png(tab.screenshot(), FOLDER / "page-gone.png")


PICTURES: dict[str, Callable[[Scene], None]] = {
    "page-live.png": live,
    "page-phone.png": phone,
    "watch.svg": watch,
    "health.svg": health,
    "page-idle.png": idle,
    "page-models.png": models,
    "page-gone.png": gone,
}


def write_terminal(arguments: tuple[str, ...], endpoint: str, file: Path, seconds: float = 0.0) -> None:
    """What a command prints on a terminal, as SVG; with `seconds`, Ctrl-C ends it, and its last table is taken."""
    from rich.console import Console
    from rich.text import Text

    ours, theirs = pty.openpty()
    size = {"COLUMNS": str(COLUMNS), "LINES": str(ROWS), "TERM": "xterm-256color", "COLORTERM": "truecolor"}
    command = [sys.executable, "-m", "neurove_service.cli", *arguments, "--connect", endpoint]
    child = subprocess.Popen(command, stdout=theirs, stdin=subprocess.DEVNULL, env=os.environ | size)
    os.close(theirs)
    if seconds:
        threading.Timer(seconds, child.send_signal, (signal.SIGINT,)).start()
    printed = b""
    with contextlib.suppress(OSError):  # the end of a terminal
        while part := os.read(ours, 65536):
            printed += part
    os.close(ours)
    child.wait()
    console = Console(record=True, width=COLUMNS, file=io.StringIO(), force_terminal=True)
    last = printed.decode().replace("\r\n", "\n").rpartition("\x1b[2K")[2]  # a live table erases the one before
    shown = re.sub(r"\x1b\[\?25[lh]", "", last).strip("\n")
    console.print(Text.from_ansi(shown), soft_wrap=True)
    svg = console.export_svg(title=" ".join(("neurove", *arguments)), unique_id=file.stem)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL))  # fonts of another host
    print(f"{file}: {file.stat().st_size:,} bytes")


@contextlib.contextmanager
def scene() -> Iterator[Scene]:
    """Everything that runs."""
    from playwright.sync_api import sync_playwright

    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name, source in STREAMS.items():  # simulated ahead: the machine may not keep up
            stack.enter_context(running("convert", source, str(folder / f"{name}.mcap"))).child.wait()
        bundle.save(replace(find("default"), name="robot-7"), folder / "robot-7.safetensors")
        flags = ("--models-dir", str(folder), "--model", "default", "--refine", "off")
        serving, transport, config = stack.enter_context(service(endpoint, *flags))
        drivers = {}
        for name in STREAMS:
            flags = ("--stream", name, "--connect", endpoint, "--wait", "120", "--loop", "--height", "1.6")
            drivers[name] = stack.enter_context(running("drive", str(folder / f"{name}.mcap"), *flags))
        wait_until(lambda: len(ask.health(transport, config)[0].streams) == len(STREAMS), START_S)
        page = stack.enter_context(running("page", "--connect", endpoint, "--listen", "0", "--operator"))
        assert page.child.stdout is not None
        url = page.child.stdout.readline().split()[1]
        token = page.child.stdout.readline().split("token=")[1].split()[0]
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(ARGUMENTS))
        stack.callback(browser.close)
        yield Scene(browser, url, token, endpoint, drivers, serving)


def main() -> int:
    """Make the pictures that are named, or all."""
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)}; default: all")
    names = parser.parse_args().names or list(PICTURES)
    if unknown := set(names) - set(PICTURES):
        parser.error(f"no such picture: {', '.join(sorted(unknown))}")
    with scene() as now:
        for name, make in PICTURES.items():
            if name in names:
                make(now)
    return 0


if __name__ == "__main__":
    sys.exit(main())
