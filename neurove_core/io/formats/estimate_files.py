"""Writer of the estimates of a recording, as the service publishes them: CSV, a TUM trajectory, or MCAP.

| suffix | content |
| --- | --- |
| .csv | one row for each bin of a window: times [us], twist, sigma, the events of the window, flags, model and source |
| .tum | `t x y z qx qy qz qw`: the pose of the camera, integrated from the twists; t in seconds, sensor clock |
| .mcap | the messages TwistEstimate as on the wire, in the channel `<stream>/velocity`; see `packet_log.layout` |

The world frame of a .tum file is the optical frame of the camera at the beginning of the first window. The error of the
twists adds up, so such a trajectory drifts. Where no window was estimated, the pose stays.
"""

import csv
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.files import atomic_path
from neurove_core.geometry import rotations
from neurove_core.io.formats.containers.mcap import McapFile
from neurove_core.io.formats.packet_log.layout import PROFILE
from neurove_core.io.formats.packet_log.writer import PacketWriter
from neurove_protocol.errors import InvalidField
from neurove_protocol.velocity import AXES, TwistEstimate

Add = Callable[[TwistEstimate], None]
"""Writes the next estimate."""

_COLUMNS = tuple(f"{axis}_{'m_s' if axis[0] == 'v' else 'rad_s'}" for axis in AXES)
CSV_HEADER: Final = (
    *("seq", "start_us", "end_us", "bin_end_us", *_COLUMNS, *(f"sigma_{name}" for name in _COLUMNS)),
    *("events", "flags", "model", "source"),
)
"""Columns of a .csv file; sigma is empty if the model has no uncertainty, flags are separated by spaces.

`source` is the origin of the angular part: network, refined or gyro.
"""


@contextmanager
def estimate_file(path: Path) -> Iterator[Add]:
    """A function that writes one estimate after the other; the file gets its name when the block ends without an error.

    Args:
        path: the file; its suffix is one of WRITERS.

    Raises:
        InvalidField: the suffix is unknown, or the file cannot be written. MissingExtra: mcap is not installed.
    """
    if path.suffix not in WRITERS:
        raise InvalidField("estimates", "FILE", str(path), f"its name must end in {', '.join(WRITERS)}")
    try:
        with WRITERS[path.suffix](path) as add:
            yield add
    except OSError as error:
        raise InvalidField("estimates", "FILE", str(path), error.strerror or str(error)) from None


@contextmanager
def _csv(path: Path) -> Iterator[Add]:
    with atomic_path(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(CSV_HEADER)

        def add(estimate: TwistEstimate) -> None:
            window = estimate.seq, estimate.start_us, estimate.end_us
            sigma = estimate.sigma or ("",) * len(AXES)
            about = estimate.events, " ".join(estimate.flags), estimate.model, estimate.source
            for end_us, twist in zip(estimate.bin_end_us, estimate.twists, strict=True):
                table.writerow((*window, end_us, *twist, *sigma, *about))

        yield add


@contextmanager
def _tum(path: Path) -> Iterator[Add]:
    with atomic_path(path) as part, part.open("w", encoding="utf-8") as file:
        file.write("# t x y z qx qy qz qw: pose of the camera (x right, y down, z forward), from neurove's estimates\n")
        track = _Track()

        def add(estimate: TwistEstimate) -> None:
            for t_us, position, orientation in track.after(estimate):
                numbers = (*position.tolist(), *orientation.tolist())
                file.write(f"{t_us / 1e6:.6f} {' '.join(f'{number:.9f}' for number in numbers)}\n")

        yield add


class _Track:
    """The pose of the camera in the frame of its first pose, integrated from its twists."""

    def __init__(self) -> None:
        self._t_us: int | None = None
        self._position, self._orientation = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])

    def after(self, estimate: TwistEstimate) -> Iterator[tuple[int, NDArray[np.float64], NDArray[np.float64]]]:
        """Time [us], position and quaternion at the begin of a window, unless known, and at the end of each bin.

        A window that does not begin after the newest pose, because the clock of the sensor went back, has no poses.
        """
        if self._t_us is not None and estimate.start_us < self._t_us:
            return
        if estimate.start_us != self._t_us:
            yield estimate.start_us, self._position, self._orientation
        begin_us = estimate.start_us
        for end_us, twist in zip(estimate.bin_end_us, estimate.twists, strict=True):
            turned, moved = rotations.pose_of(np.array(twist) * ((end_us - begin_us) / 1e6))
            self._position = self._position + rotations.turn(self._orientation, moved)
            self._orientation = rotations.product(self._orientation, turned)
            begin_us = end_us
            yield end_us, self._position, self._orientation
        self._t_us = begin_us


@contextmanager
def _mcap(path: Path) -> Iterator[Add]:
    with PacketWriter(path) as writer:

        def add(estimate: TwistEstimate) -> None:
            writer.add(estimate.stream, "velocity", estimate.encode(), estimate.end_us * 1000)

        yield add


def read_estimates(path: Path) -> Iterator[TwistEstimate]:
    """The estimates of an .mcap file that this module wrote, in recorded order.

    Raises:
        UnknownSource: it is no MCAP file. InvalidField: it has no estimates. NeuroVEError: one of them is not valid.
    """
    try:
        file = McapFile.open(path)
    except OSError as error:
        raise InvalidField("estimates", "FILE", str(path), error.strerror or str(error)) from None
    topics = [channel.topic for channel in file.channels.values() if channel.topic.endswith("/velocity")]
    if not topics or file.profile != PROFILE:
        raise InvalidField("estimates", "FILE", str(path), "a file of `neurove estimate` ending in .mcap is expected")
    for record in file.records(topics):
        yield TwistEstimate.decode(record.data)


WRITERS: Final[dict[str, Callable[[Path], AbstractContextManager[Add]]]] = {".csv": _csv, ".tum": _tum, ".mcap": _mcap}
"""The writer for each suffix."""
