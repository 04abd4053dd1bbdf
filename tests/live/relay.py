"""A link: forwards TCP between a client and a server, no faster than a number of bytes a second.

`python -m tests.live.relay PORT` runs one alone and prints its endpoint. While this process is stopped (SIGSTOP), the
link forwards nothing, in neither direction, and neither side is told; then it goes on with what was sent meanwhile.
"""

import contextlib
import signal
import socket
import subprocess
import sys
import threading
import time


class Relay:
    """Listens on a free port of loopback and forwards each connection to a server.

    Args:
        port: of the server.
        bytes_per_s: from the client to the server; None: no limit.
    """

    def __init__(self, port: int, bytes_per_s: float | None = None) -> None:
        self._port, self._bytes_per_s = port, bytes_per_s
        self._listening = socket.socket()
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16_384)  # the link itself stores little
        self._listening.bind(("127.0.0.1", 0))
        self._listening.listen()
        self._sockets = [self._listening]
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self._listening.getsockname()[1]}"

    def close(self) -> None:
        for one in self._sockets:
            one.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listening.accept()
            except OSError:
                return
            far = socket.create_connection(("127.0.0.1", self._port))
            self._sockets += [near, far]
            for source, sink, bytes_per_s in ((near, far, self._bytes_per_s), (far, near, None)):
                threading.Thread(target=self._forward, args=(source, sink, bytes_per_s), daemon=True).start()

    def _forward(self, source: socket.socket, sink: socket.socket, bytes_per_s: float | None) -> None:
        due = time.monotonic()
        with contextlib.suppress(OSError):
            while data := source.recv(4096):
                sink.sendall(data)
                if bytes_per_s is not None:
                    due = max(due, time.monotonic() - 0.01) + len(data) / bytes_per_s
                    time.sleep(max(0.0, due - time.monotonic()))
        with contextlib.suppress(OSError):
            sink.shutdown(socket.SHUT_WR)


class Link:
    """A relay in a process of its own, for the server that listens on a port."""

    def __init__(self, port: int) -> None:
        command = [sys.executable, "-m", "tests.live.relay", str(port)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.endpoint = self._process.stdout.readline().strip()

    def part(self) -> None:
        """Forward nothing."""
        self._process.send_signal(signal.SIGSTOP)

    def heal(self) -> None:
        """Forward again."""
        self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


if __name__ == "__main__":
    print(Relay(int(sys.argv[1])).endpoint, flush=True)
    threading.Event().wait()
