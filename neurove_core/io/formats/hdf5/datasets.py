"""Detection of the layout of an HDF5 file with events: MVSEC, DSEC, M3ED, and those of `layouts`."""

from pathlib import Path

from neurove_core.io.errors import UnknownSource
from neurove_core.io.format import Format
from neurove_core.io.formats.hdf5.dsec import DsecRecording
from neurove_core.io.formats.hdf5.file import has, opened
from neurove_core.io.formats.hdf5.layouts import PlainRecording, layout_of
from neurove_core.io.formats.hdf5.m3ed import TOPICS as M3ED_TOPICS
from neurove_core.io.formats.hdf5.m3ed import M3edRecording
from neurove_core.io.formats.hdf5.mvsec import TOPICS as MVSEC_TOPICS
from neurove_core.io.formats.hdf5.mvsec import MvsecRecording
from neurove_core.io.recording import Recording, refuse_topic
from neurove_protocol.events import Sensor

_LOOKED_FOR = (
    "davis/left/events or davis/right/events (MVSEC)",
    "events/p, x, y, t (DSEC)",
    "prophesee/left or prophesee/right with t, x, y, p (M3ED)",
    "CD/events (Prophesee)",
    "events of shape (N, 4) (v2e)",
    "x, y, t, p (EDS)",
    "events/xs, ys, ts, ps",
)
_TRUTH = ("davis/left/odometry", "Cn_T_C0", "poss")


def open_hdf5(path: Path, sensor: Sensor | None = None, topic: str | None = None) -> Recording:
    """Open the recording in an HDF5 file. The names of its groups identify the layout.

    Args:
        path: the .h5 or .hdf5 file.
        sensor: the pixel array; overrides that of the file or of the data set.
        topic: the event stream to read, where the file has several.

    Raises:
        UnknownSource: the file has none of the layouts, or lacks this topic.
        MissingGeometry: neither the file nor the caller gives the sensor. MissingFilter: its events need a filter that
            HDF5 does not have.
        BrokenRecording: the file is truncated or corrupt. MissingExtra: h5py or hdf5plugin is not installed.
        InvalidField: its calibration is invalid.
    """
    with opened(path) as file:
        mvsec = any(has(file, f"{name}/events") for name in MVSEC_TOPICS)
        m3ed = any(has(file, *(f"{name}/{column}" for column in "txyp")) for name in M3ED_TOPICS)
        dsec = has(file, *(f"events/{column}" for column in "txyp"))
        layout = layout_of(file)
        truth = [name for name in _TRUTH if has(file, name)]
    if mvsec:
        return MvsecRecording.open(path, sensor, topic)
    if m3ed:
        return M3edRecording.open(path, sensor, topic)
    if dsec:
        refuse_topic(path, topic)
        return DsecRecording.open(path, sensor)
    if layout is not None:
        refuse_topic(path, topic)
        return PlainRecording.open(path, layout, sensor)
    why = f"it has no events; looked for {'; '.join(_LOOKED_FOR)}"
    raise UnknownSource(path, why + (f"; it has poses: {truth[0]}" if truth else ""))


FORMAT = Format(
    "FILE.h5, FILE.hdf5 (MVSEC, DSEC, M3ED, Prophesee, v2e, EDS, events/xs)",
    open_hdf5,
    (".h5", ".hdf5"),
    signature=rb"\x89HDF\r\n\x1a\n",
)
