"""Sources: a file, a folder or a URL to a Recording. One table of formats; other packages add theirs by entry points.

A format is a module of `FORMATS` with a `FORMAT`, or an entry point of the group `neurove.recordings` whose object is a
`neurove_core.io.Format`. Help, errors and README list the sources from this table.
"""

import functools
import importlib
import importlib.metadata
import logging
from pathlib import Path
from typing import Final, NamedTuple, cast

from neurove_core.io.errors import UnknownSource
from neurove_core.io.format import Format, UrlFormat
from neurove_core.io.recording import Recording
from neurove_protocol.events import Sensor

log = logging.getLogger(__name__)

GROUP: Final = "neurove.recordings"
"""Entry point group of formats in other packages."""

FORMATS: Final = (
    "neurove_core.io.formats.aedat.aedat4",
    "neurove_core.io.formats.aedat.aedat2",
    "neurove_core.io.formats.prophesee.raw",
    "neurove_core.io.formats.prophesee.dat",
    "neurove_core.io.formats.eventstream",
    "neurove_core.io.formats.packet_log.reader",  # before ROS 2: both are .mcap
    "neurove_core.io.formats.ros.recording",
    "neurove_core.io.formats.evbench",
    "neurove_core.io.formats.npy",  # before CARLA: both are .npz
    "neurove_core.io.formats.carla",
    "neurove_core.io.formats.atis_bin",
    "neurove_core.io.formats.ecd",
    "neurove_core.io.formats.hdf5.datasets",
)
"""Modules of the formats in this package. To add one, write its module and add its name here."""

URLS: Final = {"sim": "neurove_core.sim.source", "pattern": "neurove_core.io.formats.pattern"}
"""Modules of the sources that a URL names, by scheme."""


class _Table(NamedTuple):
    formats: tuple[Format, ...]
    failed: tuple[str, ...]  # entry points that could not be loaded, with the reason


def open_source(source: str, sensor: Sensor | None = None, topic: str | None = None) -> Recording:
    """Open a recording.

    Args:
        source: a file, a folder, `pattern://`, or `sim://SCENE?...`; see `supported`.
        sensor: size of the pixel array; overrides what the recording says.
        topic: one of several event streams, such as `davis/right` of MVSEC; by default the first.

    Raises:
        UnknownSource: the source does not exist, has no known format, or does not have this topic.
        MissingGeometry: neither the caller nor the recording gives the sensor size.
        BrokenRecording: the header is damaged.
        MissingExtra: a library that reads this format is not installed.
        InvalidField: a calibration file or a query of the URL is invalid.
    """
    scheme, separator, _ = source.partition("://")
    if separator:
        if scheme not in URLS:
            raise UnknownSource(source, f"unknown scheme {scheme}://", supported())
        return _url_format(scheme).open(source, sensor, topic)
    path = Path(source)
    try:
        return _open_path(path, sensor, topic)
    except OSError as error:
        raise UnknownSource(source, error.strerror or str(error), supported()) from None


def supported() -> tuple[str, ...]:
    """One line for each source that `open_source` opens."""
    table = _table()
    urls = (_url_format(scheme).about for scheme in URLS)
    return (*dict.fromkeys(one.about for one in table.formats), *urls, *table.failed)


def _open_path(path: Path, sensor: Sensor | None, topic: str | None) -> Recording:
    if not path.exists():
        raise UnknownSource(path, "no such file or folder", supported())
    for one in _table().formats:
        if one.fits(path):
            return one.open(path, sensor, topic)
    if path.is_dir():
        raise UnknownSource(path, "the folder has no events.txt", supported())
    suffix = path.suffix.lower()
    why = f"unknown suffix {suffix!r}" if suffix else "the file has no suffix"
    raise UnknownSource(path, why, supported())


def _url_format(scheme: str) -> UrlFormat:
    return cast("UrlFormat", importlib.import_module(URLS[scheme]).FORMAT)


@functools.cache
def _table() -> _Table:
    """All formats, those of this package first; an entry point that fails costs itself."""
    formats = [cast("Format", importlib.import_module(name).FORMAT) for name in FORMATS]
    failed = []
    for entry in importlib.metadata.entry_points(group=GROUP):
        try:
            found = entry.load()
            if not isinstance(found, Format):
                raise TypeError(f"it is a {type(found).__name__}, not a neurove_core.io.Format")
            formats.append(found)
        except Exception as error:  # noqa: BLE001  # code of another package may fail in any way
            why = f"{entry.value} of the entry points {GROUP} is not loaded: {type(error).__name__}: {error}"
            log.warning("recording format not loaded: entry_point=%s why=%s", entry.value, error)
            failed.append(why)
    return _Table(tuple(formats), tuple(failed))
