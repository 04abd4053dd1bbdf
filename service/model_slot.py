"""ModelSlot: the active estimator, the one before, and the models that may take its place."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from neurove_core import bundle, models
from neurove_core.bundle import Bundle
from neurove_core.estimator import Estimator
from protocol.control import ModelInfo
from protocol.errors import BadModel, Conflict, NothingBefore, UnknownModel
from service import logs
from service.progress import OnProgress, Progress

log = logs.get(__name__)

_MIN_DIGEST = 8


class Serving(NamedTuple):
    """What streams answer with: they read it once per packet and notice a change by the epoch."""

    estimator: Estimator
    epoch: int


class Available(NamedTuple):
    """Models that could be activated now."""

    models: tuple[ModelInfo, ...]
    unreadable: dict[str, str]  # file name -> why it is no model


class ModelSlot:
    """Holds the active model; replaces it whole, and only by one that was loaded, checked and warm.

    Args:
        model: name of a built-in model or of one in the folder, or the path of a bundle's file.
        models_dir: folder of bundles that may be activated.
        pushed: the bundles that were pushed to this node, and by name why others of them are none.
        kept: digests of the models that served last and before that, which go before `model` where they can be loaded.
        on_changed: hears of every model that serves from now on; runs on the thread that changed it.

    Raises:
        BadModel, UnknownModel: the first model can not be loaded.
    """

    def __init__(
        self,
        model: str,
        models_dir: Path | None = None,
        *,
        pushed: Callable[[], tuple[list[Bundle], dict[str, str]]] = lambda: ([], {}),
        kept: tuple[str | None, str | None] = (None, None),
        on_changed: Callable[[Bundle], None] = lambda _: None,
    ) -> None:
        self._models_dir, self._pushed, self._on_changed = models_dir, pushed, on_changed
        self._changing = threading.Lock()
        self._given = models.built_in()[0]
        active, self.previous = (self._kept(digest) if digest else None for digest in kept)
        path = Path(model)
        try:
            self._given = bundle.load(path) if path.suffix == bundle.SUFFIX else self._find(model)
        except (BadModel, UnknownModel) as error:
            if active is None:
                raise
            log.warning("configured model not loaded", model=model, why=error.message, serves=active.name)
        self._active = Serving(_warm(active or self._given), 0)

    @property
    def active(self) -> Serving:
        """The model that serves now."""
        return self._active

    def available(self) -> Available:
        """The built-in models, the one given at start, and every bundle of the folder, read anew."""
        bundles, unreadable = self._bundles()
        return Available(tuple(found.info for found in bundles), unreadable)

    def activate(
        self,
        model: str,
        *,
        expect: str | None = None,
        shadow_s: float = 0.0,
        canary: frozenset[str] = frozenset(),
        on_progress: OnProgress = lambda _: None,
    ) -> tuple[Bundle, Serving]:
        """Make a model the active one; until it is ready the old one serves, and if it is not fit it stays.

        Args:
            model: its name, or at least the first 8 digits of its digest.
            expect: how the digest of the active model begins, where the caller relies on it.
            shadow_s: for how long it should run beside the active model first; 0 not at all.
            canary: streams that should change; none means all.
            on_progress: hears each step.

        Returns:
            the model before, and what serves now.

        Raises:
            UnknownModel, BadModel, Conflict: nothing was changed.
        """
        with self._alone(expect):
            before = self._active.estimator.bundle
            serving = self._switch(self._find(model), on_progress)
            self.previous = before
            self._on_changed(serving.estimator.bundle)
            on_progress(Progress("done", serving.estimator.bundle.name))
            return before, serving

    def rollback(
        self, *, expect: str | None = None, on_progress: OnProgress = lambda _: None
    ) -> tuple[Bundle, Serving]:
        """Make the model before the active one again; it can be done once per change.

        Args:
            expect: how the digest of the active model begins, where the caller relies on it.
            on_progress: hears each step.

        Returns:
            the model before, and what serves now.

        Raises:
            NothingBefore, Conflict: nothing was changed.
        """
        with self._alone(expect):
            if self.previous is None:
                raise NothingBefore
            before = self._active.estimator.bundle
            serving = self._switch(self.previous, on_progress)
            self.previous = None
            self._on_changed(serving.estimator.bundle)
            on_progress(Progress("rolled_back", serving.estimator.bundle.name))
            return before, serving

    @contextlib.contextmanager
    def _alone(self, expect: str | None) -> Iterator[None]:
        """One change at a time, and only of the model that the caller knows of."""
        if not self._changing.acquire(blocking=False):
            raise Conflict("another model change is under way")
        try:
            digest = self._active.estimator.bundle.digest
            if expect is not None and not digest.startswith(expect):
                raise Conflict(f"expect={expect}, but the active model is {digest[:12]}")
            yield
        finally:
            self._changing.release()

    def _switch(self, candidate: Bundle, on_progress: OnProgress) -> Serving:
        on_progress(Progress("loaded", f"{candidate.name}, {candidate.digest[:12]}"))
        estimator = _warm(candidate)
        on_progress(Progress("warmed", candidate.name))
        self._active = Serving(estimator, self._active.epoch + 1)
        log.info("model changed", model=candidate.name, digest=candidate.digest[:12])
        on_progress(Progress("active", f"{candidate.name}, epoch {self._active.epoch}"))
        return self._active

    def _kept(self, digest: str) -> Bundle | None:
        try:
            return self._find(digest)
        except (BadModel, UnknownModel) as error:
            log.warning("model that served last not loaded", digest=digest, why=error.message)
            return None

    def _find(self, model: str) -> Bundle:
        bundles, unreadable = self._bundles()
        by_digest = len(model) >= _MIN_DIGEST
        found = {
            one.digest: one for one in bundles if one.name == model or (by_digest and one.digest.startswith(model))
        }
        if len(found) > 1:
            raise BadModel(model, f"{len(found)} models have this name; say which by digest: {', '.join(found)}")
        for one in found.values():
            return one
        for name, why in unreadable.items():
            if Path(name).stem == model:
                raise BadModel(name, why)
        raise UnknownModel(model, tuple(one.name for one in bundles))

    def _bundles(self) -> tuple[list[Bundle], dict[str, str]]:
        pushed, unreadable = self._pushed()
        bundles = [*models.built_in(), self._given, *pushed]
        for path in sorted(self._models_dir.glob(f"*{bundle.SUFFIX}")) if self._models_dir else ():
            try:
                bundles.append(bundle.load(path))
            except BadModel as error:
                unreadable[path.name] = error.message.partition(": ")[2]
        return list({one.digest: one for one in bundles}.values()), unreadable


def _warm(model: Bundle) -> Estimator:
    estimator = Estimator(model)
    estimator.warm_up()
    return estimator
