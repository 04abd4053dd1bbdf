"""Library: every model that a node could activate, found by name or digest."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from neurove_core import models
from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle
from neurove_protocol.control import ModelInfo
from neurove_protocol.errors import BadModel, UnknownModel

MIN_DIGEST = 8
"""So many digits of a digest name a model."""

Files = Callable[[], dict[str, Path]]
"""Digest to file of the models that were pushed to this node."""


class Available(NamedTuple):
    """Models that could be activated now."""

    models: tuple[ModelInfo, ...]
    unreadable: dict[str, str]  # file name, or digest of a pushed model -> why it is no model


class _Read(NamedTuple):
    info: ModelInfo | None
    why: str  # it is no model


def nothing_pushed() -> dict[str, Path]:
    """No model was pushed."""
    return {}


class Library:
    """The built-in models, the one given at start, those of a folder and those that were pushed.

    A file is read once; then it is known by its size and its time of change, until one of them changes.

    Args:
        models_dir: the operator's folder of bundles.
        pushed: the files of pushed models.
    """

    def __init__(self, models_dir: Path | None = None, pushed: Files = nothing_pushed) -> None:
        self._models_dir, self._pushed = models_dir, pushed
        self._read: dict[tuple[Path, int, int], _Read] = {}
        self._given: Bundle | None = None

    def open(self, model: str) -> Bundle:
        """The model that a node starts with, which stays available: a name as of `find`, or the path of a file.

        Raises:
            UnknownModel, BadModel: as find.
        """
        path = Path(model)
        self._given = bundle.load(path) if path.suffix == bundle.SUFFIX else self.find(model)
        return self._given

    def available(self) -> Available:
        """All of them, and what lies among them but is no model."""
        found = {one.digest: one.info for one in self._here()}
        unreadable = {}
        for name, path, digest in self._files():
            read = self._known(path, digest)
            if read.info is None:
                unreadable[name] = read.why
            else:
                found.setdefault(read.info.digest, read.info)
        return Available(tuple(found.values()), unreadable)

    def find(self, model: str) -> Bundle:
        """The model of this name, or of a digest that begins so; only its own file is loaded.

        Raises:
            UnknownModel: there is none.
            BadModel: several have this name, or the file of this name is no model.
        """
        here = {one.digest: one for one in self._here() if _is(one.info, model)}
        files = {}
        for name, path, digest in self._files():
            read = self._known(path, digest)
            if read.info is None:
                if model in (Path(name).stem, name) or (digest or "").startswith(model):
                    raise BadModel(name, read.why)
            elif _is(read.info, model):
                files[read.info.digest] = path
        digests = here.keys() | files.keys()
        if len(digests) > 1:
            raise BadModel(model, f"{len(digests)} models have this name; say which by digest: {', '.join(digests)}")
        for digest in digests:
            if digest in here:
                return here[digest]
            found = bundle.load(files[digest])
            if found.digest != digest:
                raise BadModel(model, f"its file changes while it is read: its sha256 is now {found.digest}")
            return found
        raise UnknownModel(model, tuple(one.name for one in self.available().models))

    def _here(self) -> list[Bundle]:
        return [*models.built_in(), *([self._given] if self._given else [])]

    def _files(self) -> list[tuple[str, Path, str | None]]:
        """Name, file, and for pushed models the digest that the file must have."""
        own = sorted(self._models_dir.glob(f"*{bundle.SUFFIX}")) if self._models_dir else []
        pushed = self._pushed()
        return [
            *((path.name, path, None) for path in own),
            *((digest, path, digest) for digest, path in sorted(pushed.items())),
        ]

    def _known(self, path: Path, digest: str | None) -> _Read:
        try:
            about = path.stat()
        except OSError as error:
            return _Read(None, error.strerror or str(error))
        key = (path, about.st_size, about.st_mtime_ns)
        if key not in self._read:
            self._read = {known: read for known, read in self._read.items() if known[0] != path}
            self._read[key] = _look(path, digest)
        return self._read[key]


def _look(path: Path, digest: str | None) -> _Read:
    try:
        found = bundle.load(path)
    except BadModel as error:
        return _Read(None, error.message.partition(": ")[2])
    if digest not in (None, found.digest):
        return _Read(None, f"its bytes changed on the disk: their sha256 is {found.digest}")
    return _Read(found.info, "")


def _is(info: ModelInfo, model: str) -> bool:
    return info.name == model or (len(model) >= MIN_DIGEST and info.digest.startswith(model))
