"""Reload of a node's settings at SIGHUP: what can change while it serves, and what needs a restart."""

import logging
from collections.abc import Callable

from neurove_protocol.errors import NeuroVEError
from neurove_service import logs
from neurove_service.config import ServiceConfig
from neurove_service.models.library import Available

log = logs.get(__name__)


class Reload:
    """Reads the settings again, sets the log level, lists the folder of models, and names what needs a restart.

    Args:
        config: the settings that the node serves with.
        read: reads the settings from their sources.
        available: lists the models.
    """

    def __init__(
        self, config: ServiceConfig, read: Callable[[], ServiceConfig], available: Callable[[], Available]
    ) -> None:
        self._config, self._read, self._available = config, read, available

    def __call__(self) -> None:
        """Reload. Wrong settings change nothing and are logged."""
        try:
            new = self._read()
        except NeuroVEError as error:
            log.error("settings not reloaded", why=error.message)
            return
        fields = [name for name in ServiceConfig.model_fields if name != "log_level"]
        restart = [name for name in fields if getattr(new, name) != getattr(self._config, name)]
        found = self._available()
        log.warning(
            "settings reloaded",
            logs_from=new.log_level,
            models=len(found.models),
            unreadable=found.unreadable,
            needs_restart=restart,
        )
        logging.getLogger().setLevel(new.log_level.upper())
