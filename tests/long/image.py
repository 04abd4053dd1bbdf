"""The container image as it runs: `python -m tests.long.image [IMAGE]`, after `make image`; needs buildah.

It starts `neurove serve` of the image on free ports, waits until the command of its HEALTHCHECK succeeds, sends a
source to it, and stops it with SIGTERM. It prints the size of the image and what was seen; the exit code is 1 if
something does not hold. The image runs with chroot isolation, so it shares the network of this machine.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time

from neurove_service.config import ClientConfig
from tests.live.conftest import client, free_endpoint, is_alive, neurove

START_S = 300


def buildah(*arguments: str) -> str:
    """Run buildah to its end; returns what it prints."""
    return subprocess.run(["buildah", *arguments], check=True, capture_output=True, text=True).stdout.strip()


def main() -> int:
    """Run; print one JSON object."""
    parser = argparse.ArgumentParser()
    parser.add_argument("image", nargs="?", default="neurove")
    args = parser.parse_args()
    os.environ.setdefault("BUILDAH_ISOLATION", "chroot")
    about = json.loads(buildah("inspect", "--type", "image", args.image))["Docker"]
    check = about["config"]["Healthcheck"]["Test"]
    size = json.loads(buildah("images", "--json", args.image))[0]["size"]
    container = buildah("from", args.image)
    endpoint, metrics = free_endpoint(), free_endpoint().removeprefix("tcp/")
    run = ["run", "--env", f"NEUROVE_LISTEN={endpoint}", "--env", f"NEUROVE_METRICS={metrics}", container, "--"]
    command = [*about["config"]["Entrypoint"], *about["config"]["Cmd"]]
    began = time.monotonic()
    serving = subprocess.Popen(["buildah", *run, *command], stderr=subprocess.PIPE, text=True)
    try:
        early = _healthy(run, check)
        while not _healthy(run, check):
            if serving.poll() is not None or time.monotonic() - began > START_S:
                print(serving.stderr.read() if serving.stderr else "", file=sys.stderr)
                return 1
            threading.Event().wait(0.5)
        healthy_s = time.monotonic() - began
        config = ClientConfig(connect=(endpoint,))
        with client(endpoint, START_S) as transport:
            while not is_alive(transport, config):
                threading.Event().wait(0.2)
        user = buildah(*run, "id", "-u")
        sent = neurove("drive", "pattern://", "--connect", endpoint, "--seconds", "3", "--wait", "120")
        health = json.loads(neurove("health", "--json", "--connect", endpoint).stdout)
    finally:
        began = time.monotonic()
        last = _end(serving)
        stopped_s = time.monotonic() - began
        buildah("rm", container)
    (stream,) = health[0]["streams"]
    windows, lost = stream["windows"], sum(stream["lost"].values())
    found = {
        "size": size, "healthy_s": round(healthy_s, 1), "user": user, "windows": windows,
        "estimates": stream["estimates"], "lost": lost, "stopped_s": round(stopped_s, 1), "last": last,
    }  # fmt: skip
    print(json.dumps(found))
    return int(early or user == "0" or sent.returncode != 0 or lost > 0 or not 0 < windows == stream["estimates"])


def _healthy(run: list[str], check: list[str]) -> bool:
    return subprocess.run(["buildah", *run, *check[1:]], check=False, capture_output=True).returncode == 0


def _end(serving: "subprocess.Popen[str]") -> str:
    """Stop it; returns the last line of its log."""
    serving.send_signal(signal.SIGTERM)
    lines = serving.communicate(timeout=60)[1].strip().splitlines()
    return lines[-1] if lines else ""


if __name__ == "__main__":
    sys.exit(main())
