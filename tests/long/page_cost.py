"""Memory and processor time of the page: `python -m tests.long.page_cost`; about a minute, not part of `make test`.

A real node serves streams, a `neurove page` process shows them, and viewers do what browsers do: each follows the
events and the images of every stream as the page's script does. The node has a small network, so that
it keeps up on a busy machine; what it publishes has the usual rate and size. The figures are the resident size of the
page's process and its processor time. The exit code is 1 if one of them is above its bound.
"""

import argparse
import contextlib
import http.client
import json
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlencode

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.models import bundle
from neurove_service.page.images import HEAD
from tests.live.conftest import START_S, free_endpoint, running, service, wait_until

MAX_MIB, MAX_CORE = 80e6 / 2**20, 0.10
SMALL = ModelConfig(
    canonical=CanonicalConfig(width=24, height=16), network=NetworkConfig(channels=(4, 4), features=8, hidden=8)
)


class Usage(NamedTuple):
    """What a process has used."""

    cpu_s: float
    rss_mib: float
    peak_mib: float

    @classmethod
    def of(cls, pid: int) -> "Usage":
        """From /proc, all threads together."""
        parts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        sizes = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith("Vm")}
        return cls((int(parts[11]) + int(parts[12])) / 100, int(sizes["VmRSS"]) / 1024, int(sizes["VmHWM"]) / 1024)


class Viewer:
    """One browser: the events on one connection, the images on another."""

    def __init__(self, host: str, streams: list[str], images: bool) -> None:
        self.host, self.streams = host, streams
        self.messages = self.images = self.bytes = 0
        self.done = threading.Event()
        self._work = [threading.Thread(target=self._follow)]
        if images:
            self._work.append(threading.Thread(target=self._look))
        for thread in self._work:
            thread.start()

    def close(self) -> None:
        """End both connections."""
        self.done.set()
        for thread in self._work:
            thread.join()

    def _follow(self) -> None:
        connection = http.client.HTTPConnection(self.host, timeout=60)
        with contextlib.closing(connection):
            connection.request("GET", "/feed")
            answer = connection.getresponse()
            while not self.done.is_set():
                line = answer.readline()
                self.messages += line.startswith(b"data: ")
                self.bytes += len(line)

    def _look(self) -> None:
        connection = http.client.HTTPConnection(self.host, timeout=60)
        with contextlib.closing(connection):
            connection.request("GET", "/images?" + urlencode({"s": self.streams}, doseq=True))
            answer = connection.getresponse()
            while not self.done.is_set():
                _, _, size = HEAD.unpack(answer.read(HEAD.size))
                self.images += len(answer.read(size)) > 0


def main() -> int:
    """Run; print one JSON object."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--streams", type=int, default=4)
    parser.add_argument("--viewers", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--source", default="sim://street?seed=20018&seconds=4", help="repeated by every driver")
    parser.add_argument("--no-images", action="store_true", help="viewers that show no image")
    args = parser.parse_args()
    names = [f"cam{number}" for number in range(args.streams)]
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        source = args.source
        if source.startswith("sim://"):  # simulated once
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            source = str(Path(folder) / "drive.mcap")
            stack.enter_context(running("convert", args.source, source)).child.wait()
        models = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        bundle.save(bundle.untrained(1, SMALL, "small"), models / "small.safetensors")
        stack.enter_context(service(endpoint, "--models-dir", str(models), "--model", "small", "--refine", "off"))
        for name in names:
            flags = ("--stream", name, "--connect", endpoint, "--wait", "120", "--loop")
            stack.enter_context(running("drive", source, *flags))
        page = stack.enter_context(running("page", "--connect", endpoint, "--listen", "0"))
        assert page.child.stdout is not None
        host = page.child.stdout.readline().split("http://")[1].strip().rstrip("/")
        wait_until(lambda: _estimates(host) >= 5 * args.streams, START_S)
        viewers = [Viewer(host, names, not args.no_images) for _ in range(args.viewers)]
        try:
            wait_until(lambda: all(one.messages > 20 for one in viewers))
            before, began, first = Usage.of(page.child.pid), time.monotonic(), _counts(viewers)
            threading.Event().wait(args.seconds)
            after, ended, last = Usage.of(page.child.pid), time.monotonic(), _counts(viewers)
            rates = [one["rate_hz"] for one in _state(host)["streams"]]
        finally:
            for viewer in viewers:
                viewer.close()
    seconds = ended - began
    messages, images, sent = ((now - then) / seconds / args.viewers for now, then in zip(last, first, strict=True))
    core = (after.cpu_s - before.cpu_s) / seconds
    found = {
        "core": round(core, 3), "rss_mib": round(after.rss_mib, 1), "peak_mib": round(after.peak_mib, 1),
        "estimates_s": sum(rates), "messages_s": round(messages, 1), "images_s": round(images, 1),
        "viewer_kib_s": round(sent / 1024, 1), "seconds": round(seconds, 1),
    }  # fmt: skip
    print(json.dumps(found))
    return int(core > MAX_CORE or after.rss_mib > MAX_MIB)


def _counts(viewers: list[Viewer]) -> tuple[int, int, int]:
    return (
        sum(one.messages for one in viewers),
        sum(one.images for one in viewers),
        sum(one.bytes for one in viewers),
    )


def _state(host: str) -> dict[str, list[dict[str, float]]]:
    """The first message of a new viewer."""
    connection = http.client.HTTPConnection(host, timeout=60)
    with contextlib.closing(connection):
        connection.request("GET", "/feed")
        for line in connection.getresponse():
            if line.startswith(b"data: "):
                found: dict[str, list[dict[str, float]]] = json.loads(line.removeprefix(b"data: "))
                return found
    return {"streams": []}


def _estimates(host: str) -> int:
    return sum(len(one["points"]) for one in _state(host)["streams"])  # type: ignore[arg-type]


if __name__ == "__main__":
    sys.exit(main())
