"""Real nodes in this process, each with its own session and folder; they share what is compiled and loaded."""

import contextlib
import threading
from dataclasses import replace
from pathlib import Path
from typing import Literal

from neurove_core.models import bundle
from neurove_service.config import ServiceConfig
from neurove_service.node.app import Service
from neurove_service.transport import open_transport
from tests.live.conftest import client, free_endpoint, wait_until
from tests.service.conftest import SMALL


def save_bundles(folder: Path) -> None:
    """`one` and `two` count as trained; `bad` does not, so a node that serves it is not ok."""
    for seed, name in ((1, "one"), (2, "two"), (3, "bad")):
        bundle.save(replace(bundle.untrained(seed, SMALL, name), trained=name != "bad"), folder / f"{name}.safetensors")


class Fleet:
    """Nodes behind one router; all serve `one` at first."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.folder, self.endpoint, self._stack = folder, free_endpoint(), stack
        save_bundles(folder)
        stack.enter_context(open_transport("router", listen=(self.endpoint,)))
        self.transport = stack.enter_context(client(self.endpoint))

    def bundle(self, name: str) -> Path:
        return self.folder / f"{name}.safetensors"

    def add(
        self, name: str, *, stores: bool = True, standby: Literal["off", "lot", "last"] = "off", **labels: str
    ) -> None:
        """Start a node; without `stores` it refuses every push."""
        state = self.folder / name
        state.mkdir()
        config = ServiceConfig(
            node=name,
            mode="client",
            connect=(self.endpoint,),
            model=str(self.bundle("one")),
            state_dir=state if stores else None,
            probation_s=0.05,
            max_age_s=60.0,
            labels=labels,
            standby=standby,
        )
        stop = threading.Event()
        thread = threading.Thread(target=Service(config, stop).run, name=name)
        thread.start()
        self._stack.callback(thread.join)
        self._stack.callback(stop.set)
        wait_until(lambda: self.transport.tokens(config.keys.alive(name), 1.0))
