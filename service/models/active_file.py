"""active.json: the last active model of a node, which serves again after a restart."""

import hashlib
import json
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from neurove_core.files import write_atomically
from neurove_protocol.control import Digest
from neurove_service import logs

log = logs.get(__name__)

NAME = "active.json"
_VERSION = 1


class Active(BaseModel):
    """What a node saves for a restart."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    digest: Digest  # of the active model
    previous: Digest | None  # of the model before it, for a rollback
    configured: str  # the configured model at that time; a different one now takes precedence over this file
    highest_release: int = Field(ge=0)  # highest release that has served
    trial: Digest | None = None  # of a model whose probation waits for windows; it serves again on probation


class ActiveFile:
    """Reads and writes active.json; without a folder the record is only kept in memory.

    Args:
        folder: of active.json.
    """

    def __init__(self, folder: Path | None) -> None:
        self._path = folder / NAME if folder else None
        self._active = self._read()

    @property
    def active(self) -> Active | None:
        """The newest record; None before the first change, or if the file is damaged."""
        return self._active

    @property
    def highest_release(self) -> int:
        """Highest release that has served on this node."""
        return self._active.highest_release if self._active else 0

    def keep(self, active: Active) -> bool:
        """Save a record; return whether it is on the disk. If it is not, the log has the reason."""
        self._active = active
        if self._path is None:
            return False
        record = active.model_dump()
        text = json.dumps({"version": _VERSION, "active": record, "sha256": _sum(record)}, indent=2) + "\n"
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, text.encode())
        except OSError as error:
            log.warning("active model not saved for a restart", path=str(self._path), why=error.strerror or str(error))
            return False
        return True

    def _read(self) -> Active | None:
        if self._path is None:
            return None
        try:
            saved = json.loads(self._path.read_bytes())
            if not isinstance(saved, dict) or saved.get("version") != _VERSION:
                raise ValueError(f"its version is not {_VERSION}")
            if saved.get("sha256") != _sum(saved.get("active")):
                raise ValueError("its checksum does not match")
            return Active.model_validate(saved["active"])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError, ValidationError) as error:
            log.warning("cannot read the last active model", path=str(self._path), why=str(error))
            return None


def _sum(record: Any) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
