"""ModelSlot: the active estimator, the one before, and the models that may take its place."""

import threading
from pathlib import Path
from typing import NamedTuple

from neurove_core import bundle, models
from neurove_core.bundle import Bundle
from neurove_core.estimator import Estimator
from protocol.control import ModelInfo
from protocol.errors import BadModel, UnknownModel
from service import logs

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

    Raises:
        BadModel, UnknownModel: the first model can not be loaded.
    """

    def __init__(self, model: str, models_dir: Path | None = None) -> None:
        self._models_dir = models_dir
        self._changing = threading.Lock()
        self.previous: Bundle | None = None
        self._given = models.built_in()[0]
        path = Path(model)
        self._given = bundle.load(path) if path.suffix == bundle.SUFFIX else self._find(model)
        self._active = Serving(_warm(self._given), 0)

    @property
    def active(self) -> Serving:
        """The model that serves now."""
        return self._active

    def available(self) -> Available:
        """The built-in models, the one given at start, and every bundle of the folder, read anew."""
        bundles, unreadable = self._bundles()
        return Available(tuple(found.info for found in bundles), unreadable)

    def activate(self, model: str) -> tuple[Bundle, Serving]:
        """Make a model the active one; until it is ready the old one serves, and if it is not fit it stays.

        Args:
            model: its name, or at least the first 8 digits of its digest.

        Returns:
            the model before, and what serves now.

        Raises:
            UnknownModel, BadModel: nothing was changed.
        """
        with self._changing:
            before = self._active
            candidate = _warm(self._find(model))
            self._active = Serving(candidate, before.epoch + 1)
            self.previous = before.estimator.bundle
            log.info("model changed", model=candidate.bundle.name, digest=candidate.bundle.digest[:12])
            return self.previous, self._active

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
        bundles = [*models.built_in(), self._given]
        unreadable = {}
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
