"""Sources: a file, a folder or a URL to a Recording or a LiveSource. One table; other packages add to it.

A format is a module of `FORMATS` with a `FORMAT`, or an entry point of the group `neurove.recordings` whose object is a
`neurove_core.io.Format`. A live source is a module of `LIVE`, or such an entry point whose object is a `LiveFormat`.
Help, errors and README list the sources from this table.
"""

import functools
import importlib
import importlib.metadata
import logging
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final, NamedTuple, cast

from neurove_core.io.errors import BrokenRecording, RecordingError, UnknownSource
from neurove_core.io.faults import Reason
from neurove_core.io.format import Format, UrlFormat
from neurove_core.io.recording import Recording
from neurove_core.io.spool import HEAD_BYTES, Plain, compression_of, discard, is_text, piped, plain_file
from neurove_core.io.units import with_unit
from neurove_core.live.source import LiveFormat, LiveSource
from neurove_protocol.events import Sensor

log = logging.getLogger(__name__)

GROUP: Final = "neurove.recordings"
"""Entry point group of formats in other packages."""

FORMATS: Final = (
    "neurove_core.io.formats.aedat.aedat4",
    "neurove_core.io.formats.aedat.aedat2",
    "neurove_core.io.formats.aedat.aedat3",
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

LIVE: Final = {"dv": "neurove_core.live.dv_stream", "camera": "neurove_core.live.camera"}
"""Modules of the live sources, by the scheme of their URL."""

_SUFFIXES: Final = ((rb"PK\x03\x04.{26}[^\0]{0,255}\.npy", ".npz"), (rb"PK\x03\x04", ".zip"))
"""Suffix that the content of a pipe asks for, where the format looks at the suffix."""

_LIVE_ONLY: Final = (
    "it is a live source, and this command needs a recording: `neurove drive` publishes it, and `neurove record` "
    "writes what is published to a file"
)


class _Table(NamedTuple):
    formats: tuple[Format, ...]
    live: dict[str, LiveFormat]  # of other packages, by scheme
    failed: tuple[str, ...]  # entry points that could not be loaded, with the reason


def open_source(
    source: str, sensor: Sensor | None = None, topic: str | None = None, time_unit: str | None = None
) -> Recording:
    """Open a recording.

    Args:
        source: a file, a folder, a pipe such as `/dev/stdin`, `pattern://`, or `sim://SCENE?...`; see `supported`. A
            pipe is first copied into a temporary file; a file compressed with gzip, zstd, bz2 or lz4 is decompressed.
        sensor: size of the pixel array; overrides what the recording says.
        topic: one of several event streams, such as `davis/right` of MVSEC; by default the first.
        time_unit: unit of the event times in the file, one of s, ms, us and ns; by default that of its layout.

    Raises:
        UnknownSource: the source does not exist, has no known format, or does not have this topic.
        MissingGeometry: neither the caller nor the recording gives the sensor size.
        DoubtfulUnit: the times are implausible in the unit of the layout, and no `time_unit` is given.
        BrokenRecording: the header is damaged.
        MissingExtra: a library that reads this format is not installed.
        InvalidField: a calibration file or a query of the URL is invalid, or the format allows no other unit of time.
    """
    scheme, separator, _ = source.partition("://")
    if separator:
        if is_live(source):
            raise UnknownSource(source, _LIVE_ONLY)
        if scheme not in URLS:
            raise UnknownSource(source, f"unknown scheme {scheme}://", _known())
        return with_unit(_url_format(scheme).open(source, sensor, topic), time_unit)
    if not source.strip():
        raise UnknownSource(source, "the name of the source is empty", _known())
    try:
        return with_unit(_open_path(Path(source), sensor, topic), time_unit)
    except OSError as error:
        where = f": {error.filename}" if error.filename not in (None, source) else ""
        raise UnknownSource(source, f"{error.strerror or error}{where}") from None


def is_live(source: str) -> bool:
    """Whether a source is a camera or a network stream, for `open_live`."""
    scheme, separator, _ = source.partition("://")
    return bool(separator) and scheme not in URLS and (scheme in LIVE or scheme in _table().live)


def open_live(source: str, sensor: Sensor | None = None) -> LiveSource:
    """Open a live source.

    Args:
        source: such as `camera://`, `camera://evk4?serial=...` or `dv://HOST:PORT`; see `supported`.
        sensor: size of the pixel array, for a source that does not say it.

    Raises:
        UnknownSource: it is no live source, or its URL has unknown parts.
        InvalidField: a value in the URL is out of bounds.
        NoCamera: no such camera or stream can be opened.
        MissingExtra: a library that reads this camera is not installed.
    """
    scheme = source.partition("://")[0]
    if not is_live(source):
        raise UnknownSource(source, f"it is no live source: {', '.join(f'{one}://' for one in LIVE)}")
    return _live_format(scheme).open(source, sensor)


def supported() -> tuple[str, ...]:
    """One line for each source that `open_source` or `open_live` opens."""
    table = _table()
    urls = (_url_format(scheme).about for scheme in URLS)
    live = (_live_format(scheme).about for scheme in (*LIVE, *table.live))
    return (*dict.fromkeys(one.about for one in table.formats), *urls, *live, *table.failed)


def _known() -> tuple[str, ...]:
    """What `supported` lists, for an error: without what stands in brackets, and what is not loaded first."""
    failed = _table().failed
    return (*failed, *dict.fromkeys(re.sub(r" \([^)]*\)", "", line) for line in supported() if line not in failed))


def _open_path(path: Path, sensor: Sensor | None, topic: str | None) -> Recording:
    if not path.exists():
        raise UnknownSource(path, "no such file or folder")
    if path.is_dir():
        for one in _table().formats:
            if one.fits(path):
                return one.open(path, sensor, topic)
        raise UnknownSource(path, "the folder has no events.txt", _known())
    if path.is_symlink() and path.is_file() and not path.suffix:  # /dev/stdin of a redirected file
        path = path.resolve()
    plain = _plain(path)
    try:
        recording = _format_of(plain.path).open(plain.path, sensor, topic)
    except (RecordingError, OSError):
        discard(plain.path)
        if plain.why:
            raise BrokenRecording(path, "its compressed content", plain.why) from None
        raise
    if plain.why:
        recording.faults.begin("file").add(Reason.UNREAD, path.name, plain.why)
    return recording


def _plain(path: Path) -> Plain:
    """A plain file with the content of a file or a pipe, decompressed if it is compressed.

    Raises:
        UnknownSource: it is neither a plain file nor a pipe, the pipe gives no known format, the content is too large,
            or the file is a Git LFS pointer.
    """
    if path.is_fifo():
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
            suffix = next((suffix for signature, suffix in _SUFFIXES if re.match(signature, head, re.DOTALL)), "")
            suffix = suffix or (".txt" if is_text(head) else "")
            if not suffix and not compression_of(head) and not any(one.recognises(head) for one in _table().formats):
                why = "its first bytes are of no known format" if head else "it gives nothing"
                raise UnknownSource(path, f"{why}; a pipe needs content that identifies its format", _known())
            path = piped(path, stream, head, path.name.removesuffix(path.suffix) + (suffix or path.suffix))
    if not path.is_file():
        raise UnknownSource(path, "it is no plain file, pipe or folder")
    plain = plain_file(path)
    if plain.path != path:
        discard(path)  # a compressed file from a pipe
    return plain


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(HEAD_BYTES)


def _format_of(path: Path) -> Format:
    """The format of a file: by content and suffix, by content, or by suffix.

    Raises:
        UnknownSource: no format accepts it.
    """
    formats, head = _table().formats, _head(path)
    by_content = [one for one in formats if one.recognises(head)]
    found = _first_that_fits(path, by_content) or next((one for one in by_content if one.accepts(path)), None)
    found = found or _first_that_fits(path, formats)
    if found is None:
        suffix = path.suffix.lower()
        why = f"unknown suffix {suffix!r}" if suffix else "the file has no suffix"
        raise UnknownSource(path, f"{why}, and its first bytes are of no known format", _known())
    return found


def _first_that_fits(path: Path, formats: Iterable[Format]) -> Format | None:
    return next((one for one in formats if one.fits(path)), None)


def _url_format(scheme: str) -> UrlFormat:
    return cast("UrlFormat", importlib.import_module(URLS[scheme]).FORMAT)


def _live_format(scheme: str) -> LiveFormat:
    if scheme in LIVE:
        return cast("LiveFormat", importlib.import_module(LIVE[scheme]).FORMAT)
    return _table().live[scheme]


@functools.cache
def _table() -> _Table:
    """All formats, those of this package first; an entry point that fails costs itself."""
    formats = [cast("Format", importlib.import_module(name).FORMAT) for name in FORMATS]
    live: dict[str, LiveFormat] = {}
    failed = []
    for entry in importlib.metadata.entry_points(group=GROUP):
        try:
            found = entry.load()
            if isinstance(found, LiveFormat):
                live[found.scheme] = found
            elif isinstance(found, Format):
                formats.append(found)
            else:
                raise TypeError(f"it is a {type(found).__name__}, not a neurove_core.io.Format")
        except Exception as error:  # noqa: BLE001  # code of another package may fail in any way
            why = f"{entry.value} of the entry points {GROUP} is not loaded: {type(error).__name__}: {error}"
            log.warning("recording format not loaded: entry_point=%s why=%s", entry.value, error)
            failed.append(why)
    return _Table(tuple(formats), live, tuple(failed))
