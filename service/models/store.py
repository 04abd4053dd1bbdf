"""ModelStore: the models that were pushed to this node, on its disk.

    <folder>/staging/<digest>/bundle.safetensors   a running or interrupted push; grows
    <folder>/pushed/<digest>/bundle.safetensors    complete and verified; never changes
                             bundle.safetensors.sig   its signature, if it has one

A folder moves from staging to pushed by one rename, so a crash leaves a complete model or none. The only names from the
network that reach the disk are digests, each matched against 64 digits 0-9 a-f.
"""

import contextlib
import errno
import hashlib
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from neurove_core.files import move_folder, read_whole, write_atomically
from neurove_core.models import bundle, manifest
from neurove_core.models.bundle import Bundle
from neurove_core.models.container import Data
from neurove_protocol.control import ModelInfo, PushRequest
from neurove_protocol.errors import BadModel, NeuroVEError, NoQuota, NoSpace, NoStore, TooLarge
from neurove_service import logs
from neurove_service.models.progress import OnProgress, Progress
from neurove_service.models.pull import PATIENCE_S, Pull, pull_into
from neurove_service.models.signatures import Signed, Verify, verify_nothing
from neurove_service.models.signed_files import SignedFiles

log = logs.get(__name__)

FILE = "bundle.safetensors"
SPARE_BYTES = 16 << 20
"""Space that stays free on the disk, for active.json and the log [bytes]."""

Admit = Callable[[ModelInfo, Signed], None]
"""Raises NeuroVEError if the node must not have a model, although its bundle is valid."""

_DIGEST = re.compile(r"[0-9a-f]{64}")


def _anything(_info: ModelInfo, _signed: Signed) -> None:
    """Admit every valid model."""


class ModelStore:
    """Fetches bundles completely or not at all, and lists them.

    Args:
        folder: where they are stored; None: pushes are refused.
        models_dir: the operator's own bundles, which may have signatures next to them; only read.
        quota_bytes: maximum size of all pushed and staged models [bytes].
        verify: verifies a signature.
        patience_s: a push without a chunk for this time is interrupted [s].
    """

    def __init__(
        self,
        folder: Path | None,
        models_dir: Path | None = None,
        quota_bytes: int = 2 << 30,
        verify: Verify = verify_nothing,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._folder, self._models_dir, self._quota, self._verify = folder, models_dir, quota_bytes, verify
        self._patience_s = patience_s
        self._fetching: dict[str, int] = {}  # digest -> its full size
        self._changed = threading.Condition()
        self._signed_files = SignedFiles(self._paths, verify)

    def files(self) -> dict[str, Path]:
        """Digest and file of every pushed model."""
        return {folder.name: folder / FILE for folder in self._entries("pushed")}

    def partial(self) -> dict[str, int]:
        """Digest of every running or interrupted push, and the number of bytes that are stored."""
        return {folder.name: _size(folder / FILE) for folder in self._entries("staging")}

    def pushed(self) -> frozenset[str]:
        """Digests of the pushed models."""
        return frozenset(self.files())

    def signed(self, digest: str) -> Signed:
        """The signature state of a model; a model without a file, such as a built-in one, is unsigned.

        Raises:
            NeuroVEError: the configured keys do not allow this model.
        """
        return self._signed_files.signed(digest)

    def fetch(
        self, wanted: PushRequest, pull: Pull, stop: threading.Event, on_progress: OnProgress, admit: Admit = _anything
    ) -> tuple[Bundle, Signed, int]:
        """Pull a bundle, check it, and store it. An interrupted push resumes where it stopped.

        Args:
            wanted: digest, size and signature.
            pull: requests a chunk, see neurove_service.models.pull.
            stop: ends the wait for chunks.
            on_progress: called at the steps fetching, staged, verified.
            admit: refuses a model because of its description, such as its release.

        Returns:
            the model, its signature state, and the number of bytes that were transferred.

        Raises:
            NoStore, TooLarge, NoQuota, NoSpace: refused before the first byte; NoSpace also later.
            TransferInterrupted: no more chunks arrived; the received bytes stay for the next push.
            BadModel: the bytes do not match the digest, or are no valid bundle; nothing stays.
            NeuroVEError: refused because of its signature or by `admit`; nothing stays.
        """
        if self._folder is None:
            raise NoStore("neither models_dir nor state_dir is configured")
        if wanted.size > bundle.MAX_BYTES:
            raise TooLarge(wanted.name, wanted.size, bundle.MAX_BYTES)
        if wanted.digest in self._fetching:
            on_progress(Progress("fetching", "another push of the same model is in progress"))
        with self._reserved(wanted, self._folder), _disk_errors(wanted, self._folder):
            target = self._folder / "pushed" / wanted.digest
            if _size(target / FILE) != wanted.size:
                return self._fetch_new(wanted, target, pull, stop, on_progress, admit)
            on_progress(Progress("staged", "already stored"))
            data = read_whole(target / FILE)
            try:
                model, signed = self._check(data, wanted, admit)
            except BadModel:  # the file changed on the disk
                shutil.rmtree(target)
                return self._fetch_new(wanted, target, pull, stop, on_progress, admit)
            if wanted.signature is not None:
                write_atomically(target / (FILE + manifest.SUFFIX), wanted.signature)
            on_progress(Progress("verified", _about(model, signed)))
            return model, signed, 0

    def _fetch_new(
        self,
        wanted: PushRequest,
        target: Path,
        pull: Pull,
        stop: threading.Event,
        on_progress: OnProgress,
        admit: Admit,
    ) -> tuple[Bundle, Signed, int]:
        staging = target.parents[1] / "staging" / wanted.digest
        for folder in (staging, target.parent):
            folder.mkdir(parents=True, exist_ok=True)
        moved = 0
        while True:
            resumed = _size(staging / FILE) > 0
            moved += pull_into(staging / FILE, wanted, pull, stop, on_progress, self._patience_s)
            data = read_whole(staging / FILE)
            if not resumed or hashlib.sha256(data).hexdigest() == wanted.digest:
                break
            on_progress(Progress("fetching", "the bytes of an earlier push do not match; fetching starts again"))
            (staging / FILE).unlink()
        on_progress(Progress("staged", f"{len(data):,} bytes"))
        try:
            model, signed = self._check(data, wanted, admit)
        except NeuroVEError:
            shutil.rmtree(staging)
            raise
        if wanted.signature is not None:
            write_atomically(staging / (FILE + manifest.SUFFIX), wanted.signature)
        if target.exists():  # with a wrong size
            shutil.rmtree(target)
        move_folder(staging, target)
        on_progress(Progress("verified", _about(model, signed)))
        log.info("model pushed", model=model.name, digest=model.digest, signature=signed.state)
        return model, signed, moved

    def _check(self, data: Data, wanted: PushRequest, admit: Admit) -> tuple[Bundle, Signed]:
        digest = hashlib.sha256(data).hexdigest()
        if digest != wanted.digest:
            raise BadModel(
                wanted.name, f"the sha256 of the received bytes is {digest}, the push announced {wanted.digest}"
            )
        signed = self._verify(data, wanted.signature)
        model = bundle.from_bytes(data, wanted.name)
        admit(model.info, signed)
        return model, signed

    @contextlib.contextmanager
    def _reserved(self, wanted: PushRequest, folder: Path) -> Iterator[None]:
        """Reserve space for a bundle; one fetch of a digest at a time."""
        with self._changed:
            self._changed.wait_for(lambda: wanted.digest not in self._fetching)
            if _size(folder / "pushed" / wanted.digest / FILE) != wanted.size:
                self._free_space(wanted, folder)
            self._fetching[wanted.digest] = wanted.size
        try:
            yield
        finally:
            with self._changed:
                del self._fetching[wanted.digest]
                self._changed.notify_all()

    def _free_space(self, wanted: PushRequest, folder: Path) -> None:
        """Discard interrupted pushes, oldest first, until the bundle fits; refuse it if it does not."""
        staged = {one.name: max(_size(one / FILE), self._fetching.get(one.name, 0)) for one in self._entries("staging")}
        staged.pop(wanted.digest, None)
        used = sum(_size(one / FILE) for one in self._entries("pushed")) + sum(staged.values())
        left_over = [one for one in self._entries("staging") if one.name in staged.keys() - self._fetching.keys()]
        for old in sorted(left_over, key=lambda one: one.stat().st_mtime):
            if used + wanted.size <= self._quota:
                break
            log.warning("incomplete push discarded to free space", digest=old.name, bytes=staged[old.name])
            shutil.rmtree(old)
            used -= staged[old.name]
        if used + wanted.size > self._quota:
            raise NoQuota(wanted.name, wanted.size, used, self._quota)
        need = wanted.size - _size(folder / "staging" / wanted.digest / FILE)
        free = shutil.disk_usage(_nearest(folder)).free
        if need + SPARE_BYTES > free:
            raise NoSpace(wanted.name, need, max(0, free - SPARE_BYTES))

    def _entries(self, kind: str) -> list[Path]:
        """Folders of pushed or staged models; other entries are ignored."""
        folder = self._folder / kind if self._folder else None
        if folder is None or not folder.is_dir():
            return []
        return sorted(one for one in folder.iterdir() if _DIGEST.fullmatch(one.name) and one.is_dir())

    def _paths(self) -> list[Path]:
        """All model files that may have a signature."""
        own = sorted(self._models_dir.glob(f"*{bundle.SUFFIX}")) if self._models_dir else []
        return [*(folder / FILE for folder in self._entries("pushed")), *own]


def _about(model: Bundle, signed: Signed) -> str:
    return f"{model.name}, release {model.info.release}, {signed.state}"


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _nearest(path: Path) -> Path:
    return path if path.exists() else _nearest(path.parent)


@contextlib.contextmanager
def _disk_errors(wanted: PushRequest, folder: Path) -> Iterator[None]:
    """Turn errors of the disk into errors of the protocol; a push that filled the disk is discarded."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise NoStore(f"its folder is not writable: {error.strerror}") from None
        shutil.rmtree(folder / "staging" / wanted.digest, ignore_errors=True)
        raise NoSpace(wanted.name, wanted.size, shutil.disk_usage(_nearest(folder)).free) from None
