"""What a service takes: `python -m tests.long.light --streams 4`; a minute, three with `--cold`, not in `make test`.

A node serves the default model where only the packages of `neurove[serve]` can be imported. Cameras of 346x260 pixels
send a simulated drive at its own pace. The run prints the wall and processor time until the node is ready, and its
resident size before the first stream and with each further one. `--cold` begins with an empty cache of compiled code;
its processes that compiled are counted as children.
"""

import argparse
import contextlib
import itertools
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from neurove_core.io.packets import slices
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo, Events
from neurove_protocol.events import EventPacket, encode_packet
from neurove_service.cli.extras import EXTRAS
from neurove_service.config import ClientConfig
from tests.live.conftest import AT_FULL_SPEED, Heard, Source, client, free_endpoint, running, wait_until
from tests.long.small_packets import process_seconds
from tests.long.swaps import resident_kib
from tests.refusing import environment

OTHERS = {"coverage", "IPython", "pandas", "sympy"}  # of developers

Piece = tuple[int, Events]


def drive(seconds: float) -> tuple[CameraInfo, list[Piece]]:
    """The camera, and time and events of the packets of a simulated drive."""
    source = open_source(f"sim://street?seed=20450&seconds={seconds:g}&camera=davis346")
    lens = source.camera("cam0")
    assert lens is not None
    return lens, [(piece.t0_us, piece.events) for piece in slices(source.chunks())]


def measured(streams: int, seconds: float, cold: bool) -> dict[str, Any]:
    """The figures of one node."""
    lens, pieces = drive(seconds)
    absent = {name for names in EXTRAS.values() for name in names} - set(EXTRAS["serve"]) | OTHERS
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        given = environment(Path(folder), absent) | AT_FULL_SPEED
        if cold:
            given["NUMBA_CACHE_DIR"] = stack.enter_context(tempfile.TemporaryDirectory())
        endpoint = free_endpoint()
        began = time.monotonic()
        node = stack.enter_context(
            running("serve", "--listen", endpoint, "--node", "n1", "--log-level", "info", **given)
        )
        assert node.child.stderr is not None
        ready = next(line for line in node.child.stderr if '"event": "ready"' in line)
        found: dict[str, Any] = {
            "ready_s": round(time.monotonic() - began, 2),
            "ready_cpu_s": round(process_seconds(node.child.pid), 2),
            "children_cpu_s": round(process_seconds(node.child.pid, children=True), 2),
            "packages_refused": len(absent),
            "model": json.loads(ready)["model"],
            "resident_mib": [resident_kib(node.child.pid) >> 10],
        }
        transport = stack.enter_context(client(endpoint))
        config = ClientConfig(connect=(endpoint,))
        heard = Heard(transport, config)
        for number in range(streams):
            name = f"cam{number}"
            transport.publisher(config.keys.camera(name), "application/msgpack").put(
                lens.model_copy(update={"stream": name}).encode()
            )
            _play(Source(transport, config, name), lens, name, pieces)
            wait_until(
                lambda name=name: len(heard.of(name)) > 0 and heard.of(name)[-1].end_us >= pieces[-1][0] - 100_000
            )
            found["resident_mib"].append(resident_kib(node.child.pid) >> 10)
        found["estimates"] = {f"cam{number}": len(heard.of(f"cam{number}")) for number in range(streams)}
        found["refined"] = sum(one.source == "refined" for one in heard.estimates)
    return found


def _play(source: Source, lens: CameraInfo, stream: str, pieces: list[Piece]) -> None:
    began = time.monotonic()
    for seq, (t0_us, events) in zip(itertools.count(), pieces, strict=False):
        payload = encode_packet(EventPacket(stream, seq, lens.sensor, t0_us, events))
        time.sleep(max(0.0, began + t0_us / 1e6 - time.monotonic()))
        source.put(payload, live=True)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streams", type=int, default=2, help="cameras, one after the other; each stays open")
    parser.add_argument("--seconds", type=float, default=6.0, help="length of the drive [s]")
    parser.add_argument("--cold", action="store_true", help="begin with an empty cache of compiled code")
    given = parser.parse_args()
    print(json.dumps(measured(given.streams, given.seconds, given.cold), indent=1))


if __name__ == "__main__":
    main()
