"""The demo: a driver, the service and a consumer on one machine, three processes joined by Zenoh on loopback."""

import contextlib
import io
import json
import math
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from neurove_core.files import write_atomically
from neurove_protocol import Flag
from neurove_protocol.control import StreamStatus
from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError
from neurove_service.cli.board import Board
from neurove_service.clients import ask
from neurove_service.config import ENVIRONMENT, ClientConfig
from neurove_service.latency import latency
from neurove_service.transport import Transport

STREAM = "cam0"
_START_S = 90.0
_DRAIN_S = 3.0
_END_S = 2.5
_POLL_S = 0.1


class DemoFailed(NeuroVEError):
    """One of the demo's processes ended early."""

    code = "demo"
    exit_code = EXIT_FAILURE


def run(
    source: str,
    *,
    sensor: str | None,
    topic: str | None,
    calibration: str | None = None,
    height_m: float | None = None,
    time_unit: str | None = None,
    speed: str,
    loop: bool,
    duration_s: float,
    model: str | None,
    stop: threading.Event,
    console: Console,
    screenshot: str | None = None,
) -> dict[str, Any]:
    """Run driver, service and consumer on any source, and return a summary.

    Args:
        source: as sources.open_source.
        sensor: WIDTHxHEIGHT, if the source lacks it.
        topic: as sources.open_source.
        calibration: as `neurove drive --calibration`.
        height_m: height of the camera above the ground [m], if the source lacks it.
        time_unit: as sources.open_source.
        speed: as `neurove drive --speed`.
        loop: start again at the end.
        duration_s: sensor time to play [s]; infinity: until the source ends or the stop event.
        model: as `neurove serve --model`.
        stop: ends the demo early.
        console: receives the live table, if it is a terminal.
        screenshot: SVG file to write the last table to.

    Returns:
        counts, losses, latency and model, as `neurove demo --json` prints them.

    Raises:
        DemoFailed: the service or the driver ended with an error, which it printed to stderr.
    """
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    config = ClientConfig(connect=(endpoint,))
    board = Board()
    serve = ["serve", "--listen", endpoint, "--node", "demo", *(["--model", model] if model else [])]
    drive = ["drive", source, "--connect", endpoint, "--stream", STREAM, "--speed", speed, "--wait", "10", "--json"]
    drive += ["--sensor", sensor] if sensor else []
    drive += ["--topic", topic] if topic else []
    drive += ["--calibration", calibration] if calibration else []
    drive += ["--height", str(height_m)] if height_m else []
    drive += ["--time-unit", time_unit] if time_unit else []
    drive += ["--loop"] if loop else []
    drive += ["--seconds", str(duration_s)] if math.isfinite(duration_s) else []
    with _process(*serve) as service, _session(config, service, stop, console) as transport:
        ask.listen(transport, config, board.on_estimate, board.on_status)
        with _process(*drive, stdout=subprocess.PIPE) as driver:
            _show(board, console, lambda: driver.poll() is None and service.poll() is None, stop)
            if service.poll() is not None:
                raise DemoFailed(f"the service ended with exit code {service.returncode}")
            sent = _sent(driver, stop)
        status = _drained(transport, config, sent, stop)
    if screenshot:
        _draw(board, screenshot)
    return _summary(source, sent, status, board)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def _process(*arguments: str, stdout: int | None = None) -> Iterator[subprocess.Popen[str]]:
    """Run one of our commands as a child process that ends with the block, and with this process if it is killed."""
    command = [sys.executable, "-m", "neurove_service.cli", *arguments, "--with-parent"]
    quiet = {name: value for name, value in os.environ.items() if not name.startswith(ENVIRONMENT)}
    quiet |= {f"{ENVIRONMENT}LOG_LEVEL": "warning"}
    child = subprocess.Popen(
        command,
        stdout=stdout,
        stdin=subprocess.DEVNULL,
        text=True,
        env=quiet,
        start_new_session=True,  # Ctrl-C comes to us alone, and we end the others in order
    )
    try:
        yield child
    finally:
        child.terminate()
        try:
            child.wait(_END_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        if child.stdout:
            child.stdout.close()


@contextlib.contextmanager
def _session(
    config: ClientConfig, service: subprocess.Popen[str], stop: threading.Event, console: Console
) -> Iterator[Transport]:
    """A session with the service, once it answers."""
    with console.status("starting the service") if console.is_terminal else contextlib.nullcontext():
        transport = _connected(config, service, stop)
    with transport:
        yield transport


def _connected(config: ClientConfig, service: subprocess.Popen[str], stop: threading.Event) -> Transport:
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline and service.poll() is None and not stop.is_set():
        with contextlib.suppress(ask.NoService):
            transport = ask.connect(config, patience_s=0)
            if transport.tokens(config.keys.alive(), ask.ANSWER_S):
                return transport
            transport.close()
        stop.wait(_POLL_S)
    if stop.is_set():
        raise DemoFailed("stopped before the service had started")
    raise DemoFailed(
        f"the service did not start within {_START_S:.0f} s" if service.poll() is None else "the service ended"
    )


def _show(board: Board, console: Console, running: Any, stop: threading.Event) -> None:
    if not console.is_terminal:
        while running() and not stop.wait(_POLL_S):
            pass
        return
    with Live(board, console=console, refresh_per_second=8):
        while running() and not stop.wait(_POLL_S):
            pass


def _sent(driver: subprocess.Popen[str], stop: threading.Event) -> dict[str, Any]:
    """The driver's own summary, after a request to end; an empty one if it had not started yet."""
    driver.terminate()
    out, _ = driver.communicate(timeout=_END_S)
    try:
        return dict(json.loads(out))
    except ValueError:
        if stop.is_set():
            return {"sensor": None, "packets": 0, "events": 0, "broken": None}
        raise DemoFailed(f"the driver ended with exit code {driver.returncode}") from None


def _drained(
    transport: Transport, config: ClientConfig, sent: dict[str, Any], stop: threading.Event
) -> StreamStatus | None:
    """The status of the stream, once the service has received all that was sent or a few seconds have passed."""
    deadline = time.monotonic() + (_POLL_S if stop.is_set() else _DRAIN_S)
    status: StreamStatus | None = None
    while time.monotonic() < deadline:
        with contextlib.suppress(ask.NoService):
            replies = ask.health(transport, config)
            status = next((one for reply in replies for one in reply.streams if one.stream == STREAM), status)
        if status and status.packets_received + sum(status.lost.nonzero().values()) >= sent["packets"]:
            break
        time.sleep(_POLL_S)
    return status


def _draw(board: Board, file: str) -> None:
    """Write the last table as a picture that loads nothing from the network."""
    console = Console(record=True, width=100, file=io.StringIO())
    console.print(board)
    svg = console.export_svg(title="neurove demo")
    write_atomically(Path(file), re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL).encode())


def _summary(source: str, sent: dict[str, Any], status: StreamStatus | None, board: Board) -> dict[str, Any]:
    received = board.of(STREAM)
    lost = status.lost.nonzero() if status else {}
    packets = status.packets_received if status else 0
    undelivered = sent["packets"] - packets - sum(lost.get(name, 0) for name in _PACKET_LOSSES)
    lost |= {"undelivered_packets": undelivered} if undelivered > 0 else {}
    missed = (status.estimates if status else 0) - received.count
    lost |= {"estimates": missed} if missed > 0 else {}
    numbers = latency(received.latencies_ms)
    return {
        "source": source,
        "sensor": sent["sensor"],
        "packets_sent": sent["packets"],
        "packets_received": packets,
        "events_sent": sent["events"],
        "events_received": status.events_received if status else 0,
        "windows": status.windows if status else 0,
        "estimates": received.count,
        "lost": lost,
        "latency_ms": {name: round(value, 3) for name, value in numbers.model_dump().items()} if numbers else None,
        "rate_hz": round(received.mean_rate_hz, 3),
        "model": received.last.model if received.last else None,
        "model_digest": received.last.digest if received.last else None,
        "trained": bool(received.last and Flag.UNTRAINED not in received.last.flags),
        "broken": sent["broken"],
    }


_PACKET_LOSSES = ("gap_packets", "overload_packets", "malformed_packets", "failed_packets")
