"""Real processes and real Zenoh sessions on loopback: multicast off, free ports, each process ended by its own id."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from neurove_protocol import TwistEstimate
from neurove_protocol.control import StreamStatus
from neurove_service.config import ClientConfig
from neurove_service.transport import open_transport

START_S = 180
AT_FULL_SPEED = {"COVERAGE_PROCESS_CONFIG": ""}  # environment of a process that must keep up with a camera


def free_endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def free_ports():
    """Two ports, both free at once."""
    with socket.socket() as one, socket.socket() as other:
        one.bind(("127.0.0.1", 0))
        other.bind(("127.0.0.1", 0))
        return one.getsockname()[1], other.getsockname()[1]


def start_router(endpoint):
    script = Path(__file__).with_name("router.py")
    return subprocess.Popen([sys.executable, str(script), endpoint])


@pytest.fixture(scope="module")
def router():
    endpoint = free_endpoint()
    process = start_router(endpoint)
    with client(endpoint):
        yield endpoint
    process.kill()
    process.wait()


def wait_until(condition, timeout_s=120.0):
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if condition():
            return
        threading.Event().wait(0.02)
    pytest.fail(f"did not become true within {timeout_s} s")


class Process:
    """A command as a child process."""

    def __init__(self, *arguments, module="neurove_service.cli", stderr=subprocess.PIPE, **environment):
        self.child = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            env=os.environ | environment,
        )

    def end(self, number=signal.SIGTERM, timeout_s=60.0):
        """Send a signal; return exit code, output and errors."""
        if self.child.poll() is None:
            self.child.send_signal(number)
        out, err = self.child.communicate(timeout=timeout_s)
        return self.child.returncode, out, err


@contextlib.contextmanager
def running(*arguments, **environment):
    process = Process(*arguments, **environment)
    try:
        yield process
    finally:
        try:
            process.end()  # in order, as an operator would, so that coverage counts it
        except subprocess.TimeoutExpired:
            process.child.kill()
            process.child.communicate()
            raise


def neurove(*arguments, timeout_s=180.0):
    """Run a command to its end."""
    return subprocess.run(
        [sys.executable, "-m", "neurove_service.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def client(endpoint, patience_s=60):
    return open_transport("client", connect=(endpoint,), patience_s=patience_s)


def is_alive(transport, config):
    return bool(transport.tokens(config.keys.alive(), 1.0))


@contextlib.contextmanager
def service(endpoint, *arguments, **environment):
    """A serving node and a session with it."""
    config = ClientConfig(connect=(endpoint,))
    always = ("--listen", endpoint, "--node", "n1", "--log-level", "warning", "--probation-s", "0.5")
    with running("serve", *always, *arguments, **environment) as process:
        wait_until(lambda: _connects(endpoint) or process.child.poll() is not None, START_S)
        with client(endpoint) as transport:
            wait_until(lambda: is_alive(transport, config), START_S)
            yield process, transport, config


def _connects(endpoint):
    host, port = endpoint.removeprefix("tcp/").split(":")
    with contextlib.suppress(OSError), socket.create_connection((host, int(port)), timeout=1):
        return True
    return False


def listen(transport, config, on_estimate, on_status):
    """Receive estimates as they were published; `ask.listen` also marks those that waited on a busy machine."""
    transport.subscribe(config.keys.velocity(), lambda _key, data, _ns: on_estimate(TwistEstimate.decode(data)))
    transport.subscribe(config.keys.status(), lambda _key, data, _ns: on_status(StreamStatus.decode(data)))


class Heard:
    """Estimates and statuses that a consumer received, by stream."""

    def __init__(self, transport, config):
        self.estimates = []
        self.statuses = {}
        listen(transport, config, self.estimates.append, self._on_status)

    def _on_status(self, status):
        self.statuses[status.stream] = status

    def of(self, stream):
        return [one for one in list(self.estimates) if one.stream == stream]


class Source:
    """A driver's publisher that waits for the service before it publishes."""

    def __init__(self, transport, config, stream):
        self._publisher = transport.publisher(config.keys.events(stream), "application/msgpack")
        wait_until(lambda: self._publisher.matching)

    def put(self, payload, *, live=False):
        """Publish; unless it is `live`, as a replay, whose sensor clock says nothing about the age of a packet."""
        self._publisher.put(payload, None if live else time.monotonic_ns() // 1000)

    def play(self, payloads, pause_s=0.002):
        """Publish one after the other, as a camera does: by contract, a link may drop packets of a burst."""
        for payload in payloads:
            self.put(payload)
            threading.Event().wait(pause_s)
