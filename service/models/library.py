"""Library: every model that a node can activate, found by name or digest."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from neurove_core import models
from neurove_core.extras import installed
from neurove_core.files import Stamp, stamp, why_unreadable
from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle
from neurove_protocol.control import ModelInfo
from neurove_protocol.errors import BadModel, UnknownModel

MIN_DIGEST = 8
"""Minimum number of digits of a digest that name a model."""

_DIGEST: Final = re.compile(f"[0-9a-f]{{{MIN_DIGEST},64}}")

Files = Callable[[], dict[str, Path]]
"""Digest and file of every model that was pushed to this node."""


class Available(NamedTuple):
    """Models that can be activated now."""

    models: tuple[ModelInfo, ...]
    unreadable: dict[str, str]  # file name, digest of a pushed model, or the folder of models -> reason


class _Read(NamedTuple):
    info: ModelInfo | None
    why: str  # reason if there is no info


def nothing_pushed() -> dict[str, Path]:
    """No model was pushed."""
    return {}


class Library:
    """The built-in models, the model given at the start, those of a folder and those that were pushed.

    A file is read once, and again when it changes or another one replaces it.

    Args:
        models_dir: the operator's folder of bundles.
        pushed: the files of pushed models.
    """

    def __init__(self, models_dir: Path | None = None, pushed: Files = nothing_pushed) -> None:
        self._models_dir, self._pushed = models_dir, pushed
        self._read: dict[Path, tuple[Stamp, _Read]] = {}
        self._given: Bundle | None = None

    def open(self, model: str) -> Bundle:
        """The model that a node starts with, which stays available: a name as in `find`, or the path of a file.

        Raises:
            UnknownModel, BadModel: as find.
        """
        path = Path(model)
        self._given = bundle.load(path) if path.suffix == bundle.SUFFIX else self.find(model)
        return self._given

    def available(self) -> Available:
        """All models, and the files that are no models."""
        found = {one.digest: one.info for one in self._in_memory(models.built_in())}
        unreadable = {}
        if self._models_dir is not None and (why := why_unreadable(self._models_dir)):
            unreadable[str(self._models_dir)] = why
        for name, path, digest in self._files():
            read = self._known(path, digest)
            if read.info is None:
                unreadable[name] = read.why
            else:
                found.setdefault(read.info.digest, read.info)
        return Available(tuple(found.values()), unreadable)

    def find(self, model: str) -> Bundle:
        """The model with this name, or with a digest that begins with it; loads only the file of that model.

        Raises:
            UnknownModel: there is none.
            BadModel: several models have this name, or the file of this name is no model.
        """
        given = (models.untrained(),) if model == models.RANDOM else models.shipped()
        in_memory = {one.digest: one for one in self._in_memory(given) if _matches(one.info, model)}
        files = {}
        for name, path, digest in self._files():
            read = self._known(path, digest)
            if read.info is None:
                if model in (Path(name).stem, name) or (digest or "").startswith(model):
                    raise BadModel(name, read.why)
            elif _matches(read.info, model):
                files[read.info.digest] = path
        digests = in_memory.keys() | files.keys()
        if len(digests) > 1:
            raise BadModel(model, f"{len(digests)} models have this name; use a digest: {', '.join(digests)}")
        for digest in digests:
            if digest in in_memory:
                return in_memory[digest]
            found = bundle.load(files[digest])
            if found.digest != digest:
                raise BadModel(model, f"the file changed while it was read: its sha256 is now {found.digest}")
            return found
        if _DIGEST.fullmatch(model) and installed("torch") and _matches(models.untrained().info, model):
            return models.untrained()  # it served before the node was started again
        raise UnknownModel(model, tuple(one.name for one in self.available().models))

    def is_built_in(self, digest: str) -> bool:
        """Whether a model belongs to this installation."""
        return any(one.digest == digest for one in models.built_in())

    def _in_memory(self, built_in: tuple[Bundle, ...]) -> list[Bundle]:
        return [*built_in, *([self._given] if self._given else [])]

    def _files(self) -> list[tuple[str, Path, str | None]]:
        """Name and file; for pushed models also the digest that the file must have."""
        own = sorted(self._models_dir.glob(f"*{bundle.SUFFIX}")) if self._models_dir else []
        pushed = self._pushed()
        return [
            *((path.name, path, None) for path in own),
            *((digest, path, digest) for digest, path in sorted(pushed.items())),
        ]

    def _known(self, path: Path, digest: str | None) -> _Read:
        found = stamp(path)
        if found is None:
            return _Read(None, "the file cannot be read")
        known = self._read.get(path)
        if known is None or known[0] != found:
            known = self._read[path] = found, _read(path, digest)
        return known[1]


def _read(path: Path, digest: str | None) -> _Read:
    try:
        found = bundle.load(path)
    except BadModel as error:
        return _Read(None, error.why)
    if digest not in (None, found.digest):
        return _Read(None, f"the file changed on the disk: its sha256 is {found.digest}")
    return _Read(found.info, "")


def _matches(info: ModelInfo, model: str) -> bool:
    return info.name == model or (len(model) >= MIN_DIGEST and info.digest.startswith(model))
