"""active.json: which model a node served last, so that it serves it again after a restart."""

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
    """What is kept over a restart."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    digest: Digest  # of the model that served
    previous: Digest | None  # of the one before, for a rollback
    configured: str  # the configured model at that time: another one now is a newer decision than this file
    highest_release: int = Field(ge=0)  # greatest release counter that has served


class ActiveFile:
    """Reads and writes it; without a folder nothing is kept, and what is kept in memory ends with the process.

    Args:
        folder: where active.json lies.
    """

    def __init__(self, folder: Path | None) -> None:
        self._path = folder / NAME if folder else None
        self._active = self._read()

    @property
    def active(self) -> Active | None:
        """What was kept last; none before the first change, or where the file was broken."""
        return self._active

    @property
    def highest_release(self) -> int:
        """Greatest release counter that has served on this node."""
        return self._active.highest_release if self._active else 0

    def keep(self, active: Active) -> bool:
        """Keep this from now on; whether it is on the disk. The log says why where it is not."""
        self._active = active
        if self._path is None:
            return False
        record = active.model_dump()
        text = json.dumps({"version": _VERSION, "active": record, "sha256": _sum(record)}, indent=2) + "\n"
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, text.encode())
        except OSError as error:
            log.warning("active model not kept over a restart", path=str(self._path), why=error.strerror or str(error))
            return False
        return True

    def _read(self) -> Active | None:
        if self._path is None:
            return None
        try:
            told = json.loads(self._path.read_bytes())
            if not isinstance(told, dict) or told.get("version") != _VERSION:
                raise ValueError(f"not of version {_VERSION}")
            if told.get("sha256") != _sum(told.get("active")):
                raise ValueError("its checksum does not fit")
            return Active.model_validate(told["active"])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError, ValidationError) as error:
            log.warning("active model unknown", path=str(self._path), why=str(error), then="the configured model")
            return None


def _sum(record: Any) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
