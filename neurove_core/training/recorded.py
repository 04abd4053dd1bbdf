"""Training sequences from recordings with ground truth, split into windows as the service does.

A recording is read once. Its sequences stay valid while its events, its truth, its lens and its entry in the
configuration stay the same.
"""

import functools
import hashlib
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.files import Stamp, stamp, write_atomically
from neurove_core.geometry.camera import lookup_table
from neurove_core.geometry.motion import Twists, twists
from neurove_core.ingest import windows
from neurove_core.ingest.windows import Window, WindowsState
from neurove_core.io import Recording, UnknownSource
from neurove_core.io.formats.pose_files import read_truth
from neurove_core.sources import open_source
from neurove_core.training.config import RecordedConfig, TrainingConfig
from neurove_core.training.data import FORMAT, Sequence, Sequences, Span, save, stored_grid
from neurove_protocol.errors import InvalidField

log = logging.getLogger(__name__)

INDEX: Final = "index.json"
"""File with the number of windows of each sequence of a recording; it is written last."""

_SAMPLES: Final = 4  # samples of the truth per bin; the bin has their mean
_STREAM: Final = "train"
_IS_RECORDING: Final = ("events.txt", "metadata.yaml")  # a folder with one of these files is one recording


class RecordedSequences:
    """Sequences of the recordings of a configuration, in a folder; only missing ones are made.

    Args:
        folder: shared by all configurations, as in `data.Cache`; each recording has its own folder inside.
        config: of the run.

    Raises:
        UnknownSource: a recording does not exist, or a folder contains none.
        InvalidField: a recording has no truth, never ends, or has linear velocities but no camera height. The error
            names the field.
        BrokenRecording, MissingGeometry, MissingExtra: as `sources.open_source`.
    """

    def __init__(self, folder: Path, config: TrainingConfig) -> None:
        self._config, self._folder = config, folder
        self._found = [
            _open(f"data.recordings.{i}", source, one)
            for i, one in enumerate(config.data.recordings)
            for source in _sources(one)
        ]

    def fill(self) -> Iterator[str]:
        """Split the missing recordings into sequences, and yield the name of each one when it is done.

        Raises:
            InvalidField: truth and events of a recording do not overlap long enough for a segment.
        """
        for found in self._found:
            folder = self._folder_of(found)
            if not (folder / INDEX).exists():
                folder.mkdir(parents=True, exist_ok=True)
                lengths: list[int] = []
                for sequence in split_recording(found.recording, found.truth, found.height_m, self._config):
                    path = folder / f"{len(lengths):06d}.safetensors"
                    save(sequence, path, sparse=self._config.data.subcells > 1)
                    lengths.append(len(sequence.twists))
                for fault in found.recording.faults.found:
                    log.warning("recording has a fault: recording=%s %s", found.source, fault)
                write_atomically(folder / INDEX, json.dumps({"source": found.source, "windows": lengths}).encode())
                yield found.recording.name
            self._paths_of(found)

    def missing(self) -> int:
        """Number of recordings that are not split yet."""
        return sum(not (self._folder_of(found) / INDEX).exists() for found in self._found)

    def paths(self) -> list[Path]:
        """Files of all sequences that are long enough for a segment.

        Raises:
            InvalidField: a recording has no such sequence.
        """
        return [path for found in self._found for path in self._paths_of(found)]

    def split(self) -> tuple[list[Span], list[Span]]:
        """The windows to train on, and those that are held out for validation: the end of each recording.

        A recording that is too short to hold a segment out of it is trained on as a whole.

        Raises:
            InvalidField: a recording has no sequence that is long enough.
        """
        training: list[Span] = []
        held: list[Span] = []
        recipe = self._config.recipe
        for found in self._found:
            paths = self._paths_of(found)
            if not recipe.validation_share:
                training += map(Span, paths)
            elif len(paths) > 1:
                count = max(1, round(recipe.validation_share * len(paths)))
                training += map(Span, paths[:-count])
                held += map(Span, paths[-count:])
            else:
                windows = len(Sequences(paths).twists[0])
                wanted = max(recipe.segment_windows, round(recipe.validation_share * windows))
                first = max(recipe.most_windows, windows - wanted)
                training.append(Span(paths[0], 0, first))
                held += [Span(paths[0], first, windows)] if windows - first >= recipe.segment_windows else []
                if windows - first < recipe.segment_windows:
                    training[-1] = Span(paths[0])
        return training, held

    def _paths_of(self, found: "_OpenRecording") -> list[Path]:
        folder, needed = self._folder_of(found), self._config.recipe.most_windows
        lengths = json.loads((folder / INDEX).read_bytes())["windows"]
        paths = [folder / f"{i:06d}.safetensors" for i, length in enumerate(lengths) if length >= needed]
        if not paths:
            most = (
                f"at most {max(lengths, default=0)} consecutive windows have events and truth, a segment needs {needed}"
            )
            raise InvalidField("training", f"{found.field}.source", found.source, most)
        return paths

    def _folder_of(self, found: "_OpenRecording") -> Path:
        model = self._config.model
        kind = [
            FORMAT,
            model.window.model_dump(),
            stored_grid(self._config).model_dump(),
            self._config.sequence_windows,
        ]
        kind += [found.height_m, found.digest]
        name = hashlib.sha256(json.dumps(kind, sort_keys=True).encode()).hexdigest()[:16]
        return self._folder / f"recorded-{name}"


def split_recording(recording: Recording, truth: Twists, height_m: float, config: TrainingConfig) -> Iterator[Sequence]:
    """Split a recording into windows as the service does, in sequences of at most `config.sequence_windows`.

    A sequence ends where the service would skip windows, and before a window with a bin whose truth is unknown.

    Args:
        recording: must end.
        truth: of its camera; unknown values (nan) stay unknown.
        height_m: height of its camera above the ground.
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
    grid = stored_grid(config)
    lut = lookup_table(grid, recording.sensor, recording.camera(_STREAM))
    for chunk in recording.chunks():
        pushed = windows.push(chunk, int(chunk.t[0]), state, lut, model.window, grid)
        state = pushed.state
        yield from pushed.windows


def _truth_of(window: Window, truth: Twists, bins: int, bin_us: int) -> NDArray[np.float64]:
    """Mean truth (n, 6) of each bin; nan if the truth does not cover the whole bin."""
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
    """An open recording of the configuration."""

    field: str  # of the configuration
    source: str
    recording: Recording
    truth: Twists
    height_m: float
    digest: str  # of everything that its sequences depend on


def _sources(one: RecordedConfig) -> list[str]:
    """The source itself, or the recordings in its folder."""
    path = Path(one.source)
    if "://" in one.source or not path.is_dir() or _is_recording(path):
        return [one.source]
    inside = [child for child in sorted(path.iterdir()) if _may_be_recording(child) and _opens(child, one)]
    if not inside:
        raise UnknownSource(path, "neither a recording nor a folder with recordings")
    if one.truth is not None and len(inside) > 1:
        raise InvalidField(
            "training", "truth", one.truth, f"{one.source} contains {len(inside)} recordings; list each with its truth"
        )
    return [str(child) for child in inside]


def _is_recording(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _IS_RECORDING)


def _may_be_recording(child: Path) -> bool:
    if child.is_dir():
        return _is_recording(child)
    return not child.name.startswith(".") and child.suffix.lower() != ".txt"  # text files hold truth or calibration


def _opens(path: Path, one: RecordedConfig) -> bool:
    try:
        open_source(str(path), topic=one.topic, time_unit=one.time_unit)
    except UnknownSource:
        return False
    return True


def _open(field: str, source: str, one: RecordedConfig) -> _OpenRecording:
    recording = open_source(source, topic=one.topic, time_unit=one.time_unit)
    if recording.endless:
        raise InvalidField("training", f"{field}.source", source, "it never ends: add ?seconds=S")
    truth = twists(read_truth(Path(one.truth))) if one.truth else recording.twists()
    if truth is None:
        raise InvalidField("training", f"{field}.truth", None, f"{source} has no truth: give a file of poses")
    camera = recording.camera(_STREAM)
    height_m = one.height_m or (camera.height_m if camera else None)
    if height_m is None and np.isfinite(truth.twist[:, :3]).any():
        why = f"{source} does not give the height of its camera, and linear velocity is trained per metre of height"
        raise InvalidField("training", f"{field}.height_m", None, why)
    parts: list[Any] = [camera.model_dump() if camera else None, str(recording.sensor), one.topic]
    parts += [one.time_unit] if one.time_unit else []
    parts += [hashlib.sha256(column.tobytes()).hexdigest() for column in truth]
    parts += [source] if "://" in source else [_digest(file, stamp(file)) for file in _files(Path(source))]
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    return _OpenRecording(field, source, recording, truth, height_m or 1.0, digest)


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())


@functools.lru_cache(maxsize=4096)
def _digest(file: Path, _: Stamp | None) -> str:
    """SHA-256 of the content of a file; a process reads a file again only after a change."""
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
