"""The folders that a node is given: what is wrong with one is said at the start, not at the first push."""

import errno
import os

from neurove_core.files import why_unreadable
from neurove_service import logs
from neurove_service.config import ConfigError, ServiceConfig

log = logs.get(__name__)


def check_folders(config: ServiceConfig) -> None:
    """Check the configured folders; a missing one is logged, because the first push creates it.

    Raises:
        ConfigError: one is no folder, or cannot be read.
    """
    for field in ("models_dir", "state_dir"):
        folder = getattr(config, field)
        why = None if folder is None else why_unreadable(folder)
        if why == os.strerror(errno.ENOENT):
            log.warning("folder does not exist", setting=field, folder=str(folder))
        elif why is not None:
            raise ConfigError(f"config: {field}={str(folder)!r}: {why}", field=field, value=str(folder), bound=why)
