"""A slow link: forwards TCP between a client and a server, no faster than a number of bytes a second."""

import socket
import threading
import time


class Relay:
    """Listens on a free port of loopback and forwards each connection to a server.

    Args:
        port: of the server.
        bytes_per_s: from the client to the server.
    """

    def __init__(self, port: int, bytes_per_s: float) -> None:
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
            threading.Thread(target=_forward, args=(near, far, self._bytes_per_s), daemon=True).start()
            threading.Thread(target=_forward, args=(far, near, None), daemon=True).start()


def _forward(source: socket.socket, sink: socket.socket, bytes_per_s: float | None) -> None:
    due = time.monotonic()
    try:
        while data := source.recv(4096):
            sink.sendall(data)
            if bytes_per_s is not None:
                due = max(due, time.monotonic() - 0.01) + len(data) / bytes_per_s
                time.sleep(max(0.0, due - time.monotonic()))
    except OSError:
        pass
