"""The interface of recordings: what each source of events provides, and which errors it raises.

`neurove_core.sources.open_source` opens a recording; `formats/` has one module for each format. README.md in this
folder explains how to add a format.
"""

from neurove_core.io.errors import BrokenRecording, MissingFilter, MissingGeometry, RecordingError, UnknownSource
from neurove_core.io.faults import Fault, Faults, Reason, Tally
from neurove_core.io.format import Format, UrlFormat
from neurove_core.io.recording import EventsOnly, Frame, Recording, Triggers, refuse_topic
from neurove_core.io.units import DoubtfulUnit, Timed, TimeSample
from neurove_protocol.imu import Imu

__all__ = [
    "BrokenRecording",
    "DoubtfulUnit",
    "EventsOnly",
    "Fault",
    "Faults",
    "Format",
    "Frame",
    "Imu",
    "MissingFilter",
    "MissingGeometry",
    "Reason",
    "Recording",
    "RecordingError",
    "Tally",
    "TimeSample",
    "Timed",
    "Triggers",
    "UnknownSource",
    "UrlFormat",
    "refuse_topic",
]
