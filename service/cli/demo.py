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
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from neurove_core.files import write_atomically
from neurove_core.sim.truth import Truth
from neurove_protocol import Flag, Twist, TwistEstimate
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
    playing: Sequence[str],
    serving: Sequence[str],
    stop: threading.Event,
    console: Console,
    screenshot: Path | None = None,
    truth: Truth | None = None,
    page: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Run driver, service and consumer on any source, and return a summary.

    Args:
        source: as sources.open_source.
        playing: flags of `neurove drive` that say how to read and to play the source.
        serving: flags of `neurove serve`, such as its model.
        stop: ends the demo early.
        console: receives the live table, if it is a terminal.
        screenshot: SVG file to write the last live table to.
        truth: of a simulated source; the table and the summary compare the estimates with it.
        page: flags of `neurove page` to run as well; None: no page.

    Returns:
        counts, losses, latency and model, as `neurove demo --json` prints them.

    Raises:
        DemoFailed: the service, the driver or the page ended with an error, which it printed to stderr.
    """
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    config = ClientConfig(connect=(endpoint,))
    comparison = Comparison(truth)
    board = Board(truth=None if truth is None else comparison.truth_of)
    serve = ["serve", "--listen", endpoint, "--node", "demo", *serving]
    drive = ["drive", source, "--connect", endpoint, "--stream", STREAM, "--wait", "10", "--json", *playing]
    with (
        contextlib.nullcontext() if page is None else _page(endpoint, page, console),
        _process(*serve) as service,
        _session(config, service, stop, console) as transport,
    ):

        def on_estimate(estimate: TwistEstimate) -> None:
            board.on_estimate(estimate)
            comparison.add(estimate)

        ask.listen(transport, config, on_estimate, board.on_status)
        with _process(*drive, stdout=subprocess.PIPE) as driver:
            _show(board, console, lambda: driver.poll() is None and service.poll() is None, stop)
            if screenshot:
                _draw(board.at_newest(), screenshot)
            if service.poll() is not None:
                raise DemoFailed(f"the service ended with exit code {service.returncode}")
            sent = _sent(driver, stop)
        status = _drained(transport, config, sent, stop)
    return _summary(source, sent, status, board) | {"error": comparison.error}


@contextlib.contextmanager
def _page(endpoint: str, flags: Sequence[str], console: Console) -> Iterator[None]:
    """Run the page on a free port, and print its address before the table begins."""
    with _process("page", "--connect", endpoint, "--listen", "0", *flags, stdout=subprocess.PIPE) as child:
        address = child.stdout.readline().strip() if child.stdout else ""
        if not address:
            raise DemoFailed(f"the page ended with exit code {child.wait()}")
        console.print(address, highlight=False, soft_wrap=True)
        yield


class Comparison:
    """The estimates of a simulated source against its truth.

    Args:
        truth: of the source; None if it is unknown.
    """

    def __init__(self, truth: Truth | None) -> None:
        self._truth = truth
        self._squares, self._count = [0.0, 0.0], 0

    def truth_of(self, estimate: TwistEstimate) -> Twist | None:
        """The true twist in the middle of the last bin of a window."""
        bins = (estimate.start_us, *estimate.bin_end_us)
        true = self._truth.at((bins[-2] + bins[-1]) // 2) if self._truth is not None else None
        return None if true is None else Twist(*true.tolist())

    def add(self, estimate: TwistEstimate) -> None:
        """Compare an estimate, unless its state is not settled yet."""
        true = self.truth_of(estimate)
        if true is None or Flag.SETTLING in estimate.flags or Flag.RESET in estimate.flags:
            return
        squares = [(a - b) ** 2 for a, b in zip(estimate.twist, true, strict=True)]
        self._squares = [self._squares[0] + sum(squares[:3]), self._squares[1] + sum(squares[3:])]
        self._count += 1

    @property
    def error(self) -> dict[str, float] | None:
        """Root mean square of the error vectors of both parts; None without a truth."""
        if not self._count:
            return None
        linear, angular = (math.sqrt(total / self._count) for total in self._squares)
        return {"linear_m_s": round(linear, 4), "angular_rad_s": round(angular, 5)}


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
    with (
        console.status("starting the service; its first start compiles for up to 30 s")
        if console.is_terminal
        else contextlib.nullcontext()
    ):
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
            return {"sensor": None, "packets": 0, "events": 0, "broken": None, "behind_s": 0.0}
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


def _draw(board: Board, file: Path) -> None:
    """Write the last table as a picture that loads nothing from the network."""
    console = Console(record=True, width=100, file=io.StringIO())
    console.print(board)
    svg = console.export_svg(title="neurove demo")
    write_atomically(file, re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL).encode())


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
        "behind_s": sent["behind_s"],
    }


_PACKET_LOSSES = ("gap_packets", "overload_packets", "malformed_packets", "failed_packets")
