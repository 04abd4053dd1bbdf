"""ModelStore: the models that were pushed to this node, on its disk.

    <folder>/staging/<digest>/bundle.safetensors   a push that goes on or was cut; grows
    <folder>/pushed/<digest>/bundle.safetensors    whole and verified; never changes
                             bundle.safetensors.sig   its signature, where one came

A folder moves from staging to pushed by one rename, so a crash leaves a whole model or none. The only names that come
over the network and reach the disk are digests, each matched against 64 digits 0-9 a-f.
"""

import contextlib
import errno
import hashlib
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from neurove_core.files import move_folder, write_atomically
from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle
from neurove_protocol.control import ModelInfo, PushRequest
from neurove_protocol.errors import BadModel, NeuroVEError, NoQuota, NoSpace, NoStore, TooLarge
from neurove_service import logs
from neurove_service.models.progress import OnProgress, Progress
from neurove_service.models.pull import PATIENCE_S, Pull, pull_into
from neurove_service.models.signatures import Signed, Verify, verify_nothing

log = logs.get(__name__)

FILE = "bundle.safetensors"
SIGNATURE = ".sig"
SPARE_BYTES = 16 << 20
"""Left free on the disk, for active.json and the log."""

Admit = Callable[[ModelInfo, Signed], None]
"""Raises NeuroVEError where a node must not have a model that is sound."""

_Stamp = tuple[int, int] | None

_DIGEST = re.compile(r"[0-9a-f]{64}")


def _anything(_info: ModelInfo, _signed: Signed) -> None:
    """Admits every sound model."""


class ModelStore:
    """Fetches bundles whole or not at all, and finds them again.

    Args:
        folder: where they are kept; without one pushes are refused.
        models_dir: the operator's own bundles, which may have signatures beside them; only read.
        quota_bytes: most bytes that pushed and staged models take together.
        verify: what signatures say.
        patience_s: a push without a chunk for so long was cut.
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
        self._fetching: dict[str, int] = {}  # digest -> size that it may grow to
        self._changed = threading.Condition()
        self._digests: dict[Path, tuple[_Stamp, str]] = {}  # sha256 of files
        self._verdicts: dict[Path, tuple[tuple[_Stamp, _Stamp], Signed | NeuroVEError]] = {}  # on them

    def files(self) -> dict[str, Path]:
        """Digest and file of every pushed model."""
        return {folder.name: folder / FILE for folder in self._entries("pushed")}

    def partial(self) -> dict[str, int]:
        """Digest of every push that goes on or was cut, and how many bytes of it are here."""
        return {folder.name: _size(folder / FILE) for folder in self._entries("staging")}

    def pushed(self) -> frozenset[str]:
        """Digests of the pushed models."""
        return frozenset(self.files())

    def signed(self, digest: str) -> Signed:
        """What the signature of a model says; a model without a file of its own, a built-in one, came with the program.

        Raises:
            NeuroVEError: this node must not use it, as the configured verification says.
        """
        for path in self._files():
            if self._digest_of(path) == digest:
                return self._signed(path)
        return Signed("unsigned")

    def _signed(self, path: Path) -> Signed:
        """What the signature beside a file says; found out once, until one of both changes."""
        signature = path.with_name(path.name + SIGNATURE)
        key = (_stamp(path), _stamp(signature))
        known = self._verdicts.get(path)
        if known is None or known[0] != key:
            verdict: Signed | NeuroVEError
            try:
                verdict = self._verify(path.read_bytes(), signature.read_bytes() if signature.exists() else None)
            except NeuroVEError as error:
                verdict = error.with_traceback(None)
            known = self._verdicts[path] = key, verdict
        if isinstance(known[1], NeuroVEError):
            raise known[1]
        return known[1]

    def fetch(
        self, wanted: PushRequest, pull: Pull, stop: threading.Event, on_progress: OnProgress, admit: Admit = _anything
    ) -> tuple[Bundle, Signed, int]:
        """Pull a bundle, check it, and keep it. A push that was cut goes on where it stopped.

        Args:
            wanted: digest, size and signature.
            pull: asks for a chunk; see neurove_service.models.pull.
            stop: ends the waiting for chunks.
            on_progress: hears fetching, staged, verified.
            admit: refuses a model for what it says of itself, such as its release.

        Returns:
            the model, what its signature says, and how many bytes were moved.

        Raises:
            NoStore, TooLarge, NoQuota, NoSpace: refused before the first byte, NoSpace also later.
            Cut: no more chunks came; what is here stays for the next push.
            BadModel: the bytes are not those of the digest, or no sound bundle; nothing stays.
            NeuroVEError: refused by its signature or by `admit`; nothing stays.
        """
        if self._folder is None:
            raise NoStore("neither models_dir nor state_dir is configured")
        if wanted.size > bundle.MAX_BYTES:
            raise TooLarge(wanted.name, wanted.size, bundle.MAX_BYTES)
        if wanted.digest in self._fetching:
            on_progress(Progress("fetching", "another push of the same model is under way"))
        with self._alone(wanted, self._folder), _told_as_ours(wanted, self._folder):
            target = self._folder / "pushed" / wanted.digest
            if _size(target / FILE) != wanted.size:
                return self._fetch_anew(wanted, target, pull, stop, on_progress, admit)
            on_progress(Progress("staged", "it was here already"))
            data = (target / FILE).read_bytes()
            try:
                model, signed = self._check(data, wanted, admit)
            except BadModel:  # it rotted on the disk
                shutil.rmtree(target)
                return self._fetch_anew(wanted, target, pull, stop, on_progress, admit)
            if wanted.signature is not None:
                write_atomically(target / (FILE + SIGNATURE), wanted.signature)
            on_progress(Progress("verified", _about(model, signed)))
            return model, signed, 0

    def _fetch_anew(
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
            data = (staging / FILE).read_bytes()
            if not resumed or hashlib.sha256(data).hexdigest() == wanted.digest:
                break
            on_progress(Progress("fetching", "what was here from before does not fit; from the start"))
            (staging / FILE).unlink()
        on_progress(Progress("staged", f"{len(data):,} bytes"))
        try:
            model, signed = self._check(data, wanted, admit)
        except NeuroVEError:
            shutil.rmtree(staging)
            raise
        if wanted.signature is not None:
            write_atomically(staging / (FILE + SIGNATURE), wanted.signature)
        if target.exists():  # of another size than it should be
            shutil.rmtree(target)
        move_folder(staging, target)
        on_progress(Progress("verified", _about(model, signed)))
        log.info("model pushed", model=model.name, digest=model.digest, signature=signed.state)
        return model, signed, moved

    def _check(self, data: bytes, wanted: PushRequest, admit: Admit) -> tuple[Bundle, Signed]:
        digest = hashlib.sha256(data).hexdigest()
        if digest != wanted.digest:
            raise BadModel(wanted.name, f"the sha256 of what came is {digest}, pushed was {wanted.digest}")
        signed = self._verify(data, wanted.signature)
        model = bundle.from_bytes(data, wanted.name)
        admit(model.info, signed)
        return model, signed

    @contextlib.contextmanager
    def _alone(self, wanted: PushRequest, folder: Path) -> Iterator[None]:
        """One fetch of a digest at a time, and none that would break the quota."""
        with self._changed:
            self._changed.wait_for(lambda: wanted.digest not in self._fetching)
            if _size(folder / "pushed" / wanted.digest / FILE) != wanted.size:
                self._make_room(wanted, folder)
            self._fetching[wanted.digest] = wanted.size
        try:
            yield
        finally:
            with self._changed:
                del self._fetching[wanted.digest]
                self._changed.notify_all()

    def _make_room(self, wanted: PushRequest, folder: Path) -> None:
        """Refuse what breaks the quota or fills the disk; staged models that nobody fetches give way, oldest first."""
        staged = {one.name: max(_size(one / FILE), self._fetching.get(one.name, 0)) for one in self._entries("staging")}
        staged.pop(wanted.digest, None)
        used = sum(_size(one / FILE) for one in self._entries("pushed")) + sum(staged.values())
        left_over = [one for one in self._entries("staging") if one.name in staged.keys() - self._fetching.keys()]
        for old in sorted(left_over, key=lambda one: one.stat().st_mtime):
            if used + wanted.size <= self._quota:
                break
            log.warning("cut push given up, for a new one needs its room", digest=old.name, bytes=staged[old.name])
            shutil.rmtree(old)
            used -= staged[old.name]
        if used + wanted.size > self._quota:
            raise NoQuota(wanted.name, wanted.size, used, self._quota)
        need = wanted.size - _size(folder / "staging" / wanted.digest / FILE)
        free = shutil.disk_usage(_nearest(folder)).free
        if need + SPARE_BYTES > free:
            raise NoSpace(wanted.name, need, max(0, free - SPARE_BYTES))

    def _entries(self, kind: str) -> list[Path]:
        """Folders of pushed or staged models; what else lies there is not ours."""
        folder = self._folder / kind if self._folder else None
        if folder is None or not folder.is_dir():
            return []
        return sorted(one for one in folder.iterdir() if _DIGEST.fullmatch(one.name) and one.is_dir())

    def _files(self) -> list[Path]:
        own = sorted(self._models_dir.glob(f"*{bundle.SUFFIX}")) if self._models_dir else []
        return [*(folder / FILE for folder in self._entries("pushed")), *own]

    def _digest_of(self, path: Path) -> str | None:
        stamp = _stamp(path)
        if stamp is None or stamp[0] > bundle.MAX_BYTES:
            return None
        known = self._digests.get(path)
        if known is None or known[0] != stamp:
            try:
                known = self._digests[path] = stamp, hashlib.sha256(path.read_bytes()).hexdigest()
            except OSError:
                return None
        return known[1]


def _about(model: Bundle, signed: Signed) -> str:
    return f"{model.name}, release {model.info.release}, {signed.state}"


def _stamp(path: Path) -> _Stamp:
    """Size and time of change of a file [bytes, ns]; None where there is none."""
    try:
        about = path.stat()
    except OSError:
        return None
    return about.st_size, about.st_mtime_ns


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _nearest(path: Path) -> Path:
    return path if path.exists() else _nearest(path.parent)


@contextlib.contextmanager
def _told_as_ours(wanted: PushRequest, folder: Path) -> Iterator[None]:
    """What the disk refuses, as errors that the caller can be told; what filled the disk is taken off it."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise NoStore(f"its folder can not be written to: {error.strerror}") from None
        shutil.rmtree(folder / "staging" / wanted.digest, ignore_errors=True)
        raise NoSpace(wanted.name, wanted.size, shutil.disk_usage(_nearest(folder)).free) from None
