"""Writer of any recording as HDF5 in DSEC's layout. `dsec.py` describes the groups that it adds."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from neurove_core.io.checked import truth
from neurove_core.io.formats.hdf5.dsec import LENS_FIELDS
from neurove_core.io.formats.hdf5.sink import Sink, write_file
from neurove_core.io.recording import Recording
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events

MAX_SPAN_S: Final = 86_400
"""Longest recording. A longer span is a jump in time; the index has one entry per millisecond of it."""

_ROWS: Final = 1 << 16  # per stored chunk: about 300 kB, which fits h5py's default cache
_INDEX_BLOCK: Final = 1 << 20
_COLUMNS: Final = {"p": "u1", "x": "u2", "y": "u2", "t": "i8"}


class Written(NamedTuple):
    """What was written to a file."""

    events: int
    streams: tuple[str, ...]
    left_out: tuple[str, ...]  # streams of the recording that the layout cannot hold


def write_dsec(recording: Recording, path: Path, progress: Callable[[int], None] | None = None) -> Written:
    """Write a recording as HDF5 in DSEC's layout: events, and its lens, IMU, poses and twists where it has them.

    The file is written atomically: an existing file stays until the new one is complete. Memory is bounded for a
    recording of any length. The data is compressed with Blosc and Zstd, as in DSEC's own files: a reader needs
    hdf5plugin.

    Args:
        recording: the recording to write.
        path: the .h5 file.
        progress: called after each chunk with the number of events written so far.

    Returns:
        The number of events, the streams that were written, and those that were left out.

    Raises:
        InvalidField: the recording is endless, or its times span more than MAX_SPAN_S.
        BrokenRecording: the recording raises it; nothing is written.
        MissingExtra: h5py or hdf5plugin is not installed. OSError: the file cannot be written.
    """
    if recording.endless:
        raise InvalidField("write_dsec", "recording", recording.name, "must not be endless")

    def write(file: Any, sink: Sink) -> Written:
        def written(events: int) -> None:
            sink.check()
            if progress is not None:
                progress(events)

        n = _write_events(recording, file, written)
        streams = ("events", *_write_truth(recording, file), *_write_imu(recording, file))
        return Written(n, streams, tuple(stream for stream in recording.streams if stream not in streams))

    return write_file(path, write)


def _write_events(recording: Recording, file: Any, progress: Callable[[int], None]) -> int:
    """Write the groups `events`, `ms_to_idx`, `t_offset` and `camera`; return the number of events."""
    group = file.create_group("events")
    group.attrs["width"], group.attrs["height"] = recording.sensor.width, recording.sensor.height
    lens = recording.camera("recording")
    if lens is not None:
        stored = lens.model_dump()
        file.create_group("camera").attrs.update(
            {name: stored[name] for name in LENS_FIELDS if stored[name] is not None}
        )
    columns = {name: _growing(group, name, dtype) for name, dtype in _COLUMNS.items()}
    index = _growing(file, "ms_to_idx", "u8")
    offset_us, n = 0, 0
    for chunk in recording.chunks():
        offset_us = offset_us if n else int(chunk.t[0])
        if chunk.t[-1] - offset_us > MAX_SPAN_S * 1_000_000:
            span_s = int(chunk.t[-1] - offset_us) / 1e6
            raise InvalidField("write_dsec", "span_s", span_s, f"at most {MAX_SPAN_S} s between first and last event")
        shifted = chunk._replace(t=chunk.t - offset_us)
        for name, column in columns.items():
            _append(column, getattr(shifted, name))
        for entries in _index_entries(shifted, n, int(index.shape[0])):
            _append(index, entries)
        n += chunk.n
        progress(n)
    file["t_offset"] = np.int64(offset_us)
    return n


def _index_entries(events: Events, first: int, ms: int) -> Iterator[np.ndarray[Any, Any]]:
    """Index of the first event at or after each millisecond, from `ms` to that of the last event, in bounded blocks.

    Args:
        events: the next events of a recording; all earlier ones are before millisecond `ms`.
        first: how many events came before.
        ms: the first millisecond without an entry.
    """
    stop = int(events.t[-1]) // 1000 + 1
    for at in range(ms, stop, _INDEX_BLOCK):
        grid_us = np.arange(at, min(at + _INDEX_BLOCK, stop)) * 1000
        yield first + np.searchsorted(events.t, grid_us)


def _write_truth(recording: Recording, file: Any) -> Iterator[str]:
    """Write the groups `poses` and `twists`; yield their names."""
    poses, twists = truth(recording)
    if poses is not None:
        _write_group(file, "poses", t=poses.t, position=poses.position_m, orientation=poses.orientation)
        yield "poses"
    if twists is not None:
        _write_group(file, "twists", t=twists.t, twist=twists.twist)
        yield "twists"


def _write_imu(recording: Recording, file: Any) -> Iterator[str]:
    """Write the group `imu`; yield its name."""
    written = False
    for block in recording.imu():
        _write_group(file, "imu", t=block.t, accel=block.accel_m_s2, gyro=block.gyro_rad_s)
        written = True
    if written:
        yield "imu"


def _write_group(file: Any, name: str, **columns: np.ndarray[Any, Any]) -> None:
    """Append rows to the data sets of a group; the first call creates them."""
    group = file.require_group(name)
    for key, rows in columns.items():
        _append(group[key] if key in group else _growing(group, key, rows.dtype, *rows.shape[1:]), rows)


def _growing(group: Any, name: str, dtype: Any, *tail: int) -> Any:
    """An empty data set of shape (0, *tail) that can grow."""
    import hdf5plugin  # imported late, as in `hdf5.library`

    # measured on evt3.raw [Mev/s, bytes per event]: this 10, 3.5; level 3 5, 3.4; gzip 2.3, 3.3; lzf 4.4, 4.4
    packing = hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.SHUFFLE)
    return group.create_dataset(
        name, (0, *tail), dtype, maxshape=(None, *tail), chunks=(_ROWS, *tail), compression=packing
    )


def _append(data: Any, rows: np.ndarray[Any, Any]) -> None:
    n = data.shape[0]
    data.resize(n + len(rows), axis=0)
    data[n:] = rows
