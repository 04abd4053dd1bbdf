"""Recordings with truth as sequences to learn from: cut as the service cuts them, kept beside the simulated ones.

A recording is read once; what was made of it stays valid as long as its events, its truth, its lens and what the
configuration says of it stay the same.
"""

import functools
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.files import write_atomically
from neurove_core.geometry.camera import lookup_table
from neurove_core.geometry.motion import Twists, twists
from neurove_core.ingest import windows
from neurove_core.ingest.windows import Window, WindowsState
from neurove_core.io import Recording, UnknownSource, open_source, read_poses
from neurove_core.io.recording import SUPPORTED
from neurove_core.training.config import RecordedConfig, TrainingConfig
from neurove_core.training.data import FORMAT, Sequence, save
from neurove_protocol.errors import InvalidField

INDEX: Final = "index.json"
"""Written last: how many windows each sequence of a recording has."""

_SAMPLES: Final = 4  # of the truth in each bin, whose mean is the bin's
_STREAM: Final = "train"
_IS_RECORDING: Final = ("events.txt", "metadata.yaml")  # what makes a folder one recording, not some


class RecordedSequences:
    """The sequences of a configuration's recordings, in a folder; what is missing is cut, what is there is read.

    Args:
        folder: of all configurations, as of `data.Cache`; each recording has its own folder within.
        config: whose recordings these are.

    Raises:
        UnknownSource: there is no such recording, or a folder holds none.
        InvalidField: it has no truth, never ends, or knows linear velocity but no camera height; names the field.
        BrokenRecording, MissingGeometry, MissingExtra: as `io.open_source`.
    """

    def __init__(self, folder: Path, config: TrainingConfig) -> None:
        self._config, self._folder = config, folder
        self._found = [
            _open(f"data.recordings.{i}", source, one)
            for i, one in enumerate(config.data.recordings)
            for source in _sources(one)
        ]

    def fill(self) -> Iterator[str]:
        """Cut what is missing; yields the name of each recording that was cut.

        Raises:
            BrokenRecording: it can not be read to its end; nothing is kept of it.
            InvalidField: its truth and its events have too little time in common for a segment.
        """
        for found in self._found:
            folder = self._folder_of(found)
            if not (folder / INDEX).exists():
                folder.mkdir(parents=True, exist_ok=True)
                lengths: list[int] = []
                for sequence in split_recording(found.recording, found.truth, found.height_m, self._config):
                    save(sequence, folder / f"{len(lengths):06d}.safetensors")
                    lengths.append(len(sequence.twists))
                write_atomically(folder / INDEX, json.dumps({"source": found.source, "windows": lengths}).encode())
                yield found.recording.name
            self._paths_of(found)

    def missing(self) -> int:
        """How many recordings are not cut yet."""
        return sum(not (self._folder_of(found) / INDEX).exists() for found in self._found)

    def paths(self) -> list[Path]:
        """The files of all sequences that are long enough for a segment.

        Raises:
            InvalidField: a recording has none.
        """
        return [path for found in self._found for path in self._paths_of(found)]

    def _paths_of(self, found: "_OpenRecording") -> list[Path]:
        folder, takes = self._folder_of(found), self._config.recipe.most_windows
        lengths = json.loads((folder / INDEX).read_bytes())["windows"]
        paths = [folder / f"{i:06d}.safetensors" for i, length in enumerate(lengths) if length >= takes]
        if not paths:
            most = f"at most {max(lengths, default=0)} windows in a row have events and truth, a segment takes {takes}"
            raise InvalidField("training", f"{found.field}.source", found.source, most)
        return paths

    def _folder_of(self, found: "_OpenRecording") -> Path:
        model = self._config.model
        kind = [FORMAT, model.window.model_dump(), model.canonical.model_dump(), self._config.sequence_windows]
        kind += [found.height_m, found.digest]
        name = hashlib.sha256(json.dumps(kind, sort_keys=True).encode()).hexdigest()[:16]
        return self._folder / f"recorded-{name}"


def split_recording(recording: Recording, truth: Twists, height_m: float, config: TrainingConfig) -> Iterator[Sequence]:
    """The windows of a recording as the service cuts them, in sequences of at most `config.sequence_windows`.

    A sequence ends where the service would skip windows, and where a window has bins of which nothing is known.

    Args:
        recording: that ends.
        truth: of its camera; what it does not know (nan) stays unknown.
        height_m: of its camera above the ground.
        config: of the run.
    """
    window_config, most = config.model.window, config.sequence_windows
    run: list[tuple[Window, NDArray[np.float64]]] = []
    last_us = None
    for window in _windows(recording, config):
        true = _truth_of(window, truth, window_config.bins, window_config.bin_us)
        known = np.isfinite(true).any(axis=1).all()
        if run and (window.start_us != last_us or not known or len(run) == most):
            yield _sequence(run, height_m, recording.name)
            run = []
        if known:
            run.append((window, true))
        last_us = window.start_us + window_config.duration_us
    if run:
        yield _sequence(run, height_m, recording.name)


def _windows(recording: Recording, config: TrainingConfig) -> Iterator[Window]:
    model, state = config.model, WindowsState()
    lut = lookup_table(model.canonical, recording.sensor, recording.camera(_STREAM))
    for chunk in recording.chunks():
        pushed = windows.push(chunk, int(chunk.t[0]), state, lut, model.window, model.canonical)
        state = pushed.state
        yield from pushed.windows


def _truth_of(window: Window, truth: Twists, bins: int, bin_us: int) -> NDArray[np.float64]:
    """Mean truth (n, 6) of each bin; nan where it is not known over all of it."""
    t_us = window.start_us + (np.arange(bins * _SAMPLES) + 0.5) * (bin_us / _SAMPLES)
    mean: NDArray[np.float64] = truth.at(t_us.astype(np.int64)).reshape(bins, _SAMPLES, 6).mean(axis=1)
    return mean


def _sequence(run: list[tuple[Window, NDArray[np.float64]]], height_m: float, name: str) -> Sequence:
    twist = np.stack([true for _, true in run])
    twist[..., :3] /= height_m
    start_s = run[0][0].start_us / 1e6
    counts = np.stack([window.counts for window, _ in run])
    return Sequence(counts, twist.astype(np.float32), height_m, f"{name} from {start_s:.1f} s, h={height_m:.2f} m")


class _OpenRecording(NamedTuple):
    """A recording that is learned from."""

    field: str  # of the configuration
    source: str
    recording: Recording
    truth: Twists
    height_m: float
    digest: str  # of all that its sequences are made of


def _sources(one: RecordedConfig) -> list[str]:
    """The recording, or those in the folder."""
    path = Path(one.source)
    if "://" in one.source or not path.is_dir() or _is_recording(path):
        return [one.source]
    inside = [child for child in sorted(path.iterdir()) if _may_be_recording(child) and _opens(child, one.topic)]
    if not inside:
        raise UnknownSource(path, SUPPORTED, "neither a recording nor a folder that holds some")
    if one.truth is not None and len(inside) > 1:
        raise InvalidField("training", "truth", one.truth, f"{one.source} holds {len(inside)} recordings; name each")
    return [str(child) for child in inside]


def _is_recording(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _IS_RECORDING)


def _may_be_recording(child: Path) -> bool:
    if child.is_dir():
        return _is_recording(child)
    return not child.name.startswith(".") and child.suffix.lower() != ".txt"  # the text of a truth, of a calibration


def _opens(path: Path, topic: str | None) -> bool:
    try:
        open_source(str(path), topic=topic)
    except UnknownSource:
        return False
    return True


def _open(field: str, source: str, one: RecordedConfig) -> _OpenRecording:
    recording = open_source(source, topic=one.topic)
    if recording.endless:
        raise InvalidField("training", f"{field}.source", source, "it never ends: say how many seconds")
    truth = twists(read_poses(Path(one.truth))) if one.truth else recording.twists()
    if truth is None:
        raise InvalidField("training", f"{field}.truth", None, f"{source} holds no truth: name a file of poses")
    camera = recording.camera(_STREAM)
    height_m = one.height_m or (camera.height_m if camera else None)
    if height_m is None and np.isfinite(truth.twist[:, :3]).any():
        why = f"{source} does not say how high its camera is, and linear velocity is learned per metre of height"
        raise InvalidField("training", f"{field}.height_m", None, why)
    about: list[Any] = [camera.model_dump() if camera else None, str(recording.sensor), one.topic]
    about += [hashlib.sha256(column.tobytes()).hexdigest() for column in truth]
    about += [source] if "://" in source else [_digest(file, *_version(file)) for file in _files(Path(source))]
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()
    return _OpenRecording(field, source, recording, truth, height_m or 1.0, digest)


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())


def _version(file: Path) -> tuple[int, int]:
    about = file.stat()
    return about.st_size, about.st_mtime_ns


@functools.lru_cache(maxsize=4096)
def _digest(file: Path, size: int, changed_ns: int) -> str:
    """Of a file's content; within one process it is read again only where it has changed."""
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
