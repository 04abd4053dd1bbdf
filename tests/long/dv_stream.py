"""CPU of `neurove drive dv://` for each event: `python -m tests.long.dv_stream [--rounds N]`.

A NetworkWriter in its own process sends batches of 10 ms, five at once; a consumer on Zenoh counts. The result is the
CPU time of the process of the driver, all threads, divided by the events.
"""

import argparse
import json
import os
import re
import socket
import statistics
import subprocess
import sys
from pathlib import Path

from neurove_protocol.events import decode_packet
from neurove_protocol.keys import Keys
from tests.live.conftest import client, free_endpoint, start_router, wait_until
from tests.live.dv_writer import dv_writer, tell

RATES_PER_MS = (100, 1_000)
PIECES, PIECE_MS = 40, 50  # of a round; the next piece follows when a consumer has the one before


def cpu_s(pid: int) -> float:
    """CPU time of a process so far, user and system [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(endpoint: str, rounds: int, per_ms: int) -> dict[str, float]:
    """CPU of the driver for each event [ns], median of rounds. It fails if an event is lost."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    heard = {"events": 0}

    def count(_key: str, data: bytes, _ns: int) -> None:
        heard["events"] += decode_packet(data).events.n

    with client(endpoint) as transport, dv_writer(port) as writer:
        transport.subscribe(Keys().events(), count)
        url = f"dv://127.0.0.1:{port}?delay=3600"
        command = [sys.executable, "-m", "neurove_service.cli", "drive", url, "--connect", endpoint, "--wait", "60"]
        driver = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert driver.stderr is not None
        while not re.match("neurove: driving", driver.stderr.readline()):
            pass
        tell(writer, "clients 1")
        found: list[float] = []
        t0_us, sent = 1_000_000, 0
        for _ in range(rounds + 1):  # the first one warms up
            before = cpu_s(driver.pid)
            for _ in range(PIECES):
                tell(writer, f"events 20080 {PIECE_MS * per_ms} {t0_us} {per_ms}")
                t0_us, sent = t0_us + 1000 * PIECE_MS, sent + PIECE_MS * per_ms
                wait_until(lambda sent=sent: heard["events"] >= sent)
            found.append((cpu_s(driver.pid) - before) / (PIECES * PIECE_MS * per_ms) * 1e9)
        driver.terminate()
        driver.communicate(timeout=60)
    return {"events_per_ms": per_ms, "cpu_ns_per_event": round(statistics.median(found[1:]), 1)}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    endpoint = free_endpoint()
    router = start_router(endpoint)
    try:
        for per_ms in RATES_PER_MS:
            print(json.dumps(measured(endpoint, args.rounds, per_ms)), flush=True)
    finally:
        router.kill()
        router.wait()


if __name__ == "__main__":
    main()
