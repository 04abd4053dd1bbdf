"""Monitor: metrics, liveness, readiness and health of a node by HTTP, from the start of the process to its end."""

import time
from collections.abc import Callable

from neurove_protocol.control import HealthReply
from neurove_service import logs
from neurove_service.endpoints import is_loopback, split_address
from neurove_service.guard import Guard
from neurove_service.metrics.exporter import Exporter
from neurove_service.metrics.families import Fleet
from neurove_service.metrics.http import HttpServer
from neurove_service.node.watchdog import STOPPED_LOOP_S

log = logs.get(__name__)


class Monitor:
    """Serves the paths of an `Exporter` for one node.

    Before `attach` the process is live and not ready, because the model is not loaded or no session is open.

    Args:
        node: its name.
        address: HOST:PORT to listen on.
        guard: counts internal errors.

    Raises:
        AddressError: the address cannot be used.
    """

    def __init__(self, node: str, address: str, guard: Guard) -> None:
        self._node = node
        self._health: Callable[[], HealthReply] | None = None
        self._stuck: Callable[[], list[str]] = list
        self._beat_s: Callable[[], float] = time.monotonic
        host, port = split_address(address)
        self._server = HttpServer(host, port, Exporter(self.read, self.live, self.ready).respond, guard)
        if is_loopback(host):
            log.info("metrics", url=f"{self._server.url}/metrics")
        else:
            log.warning(
                "metrics are visible to every host that reaches this address", url=f"{self._server.url}/metrics"
            )

    def attach(
        self, health: Callable[[], HealthReply], stuck: Callable[[], list[str]], beat_s: Callable[[], float]
    ) -> None:
        """Show a node that serves.

        Args:
            health: of the node and its streams.
            stuck: streams whose loop has stopped.
            beat_s: when the housekeeping loop turned last (monotonic) [s].
        """
        self._stuck, self._beat_s, self._health = stuck, beat_s, health

    @property
    def url(self) -> str:
        """Where it listens, without a path."""
        return self._server.url

    def close(self) -> None:
        """End the server."""
        self._server.close()

    def read(self) -> Fleet:
        """The node; before it serves, a silent one."""
        return Fleet([], [self._node]) if self._health is None else Fleet([self._health()])

    def live(self) -> str:
        """Why the process must be restarted: a loop has stopped; empty if all turn."""
        late_s = time.monotonic() - self._beat_s()
        if late_s >= STOPPED_LOOP_S:
            return f"the housekeeping loop has not turned for {late_s:.0f} s"
        stuck = self._stuck()
        return f"the loop of stream {', '.join(stuck)} is stuck" if stuck else ""

    def ready(self) -> str:
        """Why the node does not serve; empty if it serves."""
        if self._health is None:
            return "the model is not loaded, or no session is open yet"
        return self.live() or ("" if self._health().ready else "the node shuts down")
