"""AEDAT 2.0 files of jAER: a text header, then pairs of address and time, both 32-bit big-endian."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.clock import unwrap_times
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.format import Format
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, Imu, in_chunks, refuse_topic, valid_prefix
from neurove_protocol.errors import EventOutsideSensor, InvalidField, TimeBackwards
from neurove_protocol.events import Events, Sensor, check_events

MAX_HEADER_BYTES = 4 << 20  # jAER writes all its preferences there, about 200,000 bytes
PAIR = np.dtype([("address", ">u4"), ("t", ">u4")])
G_M_S2 = 9.80665

_MAGIC = b"#!AER-DAT2.0"
_LINE = re.compile(rb"#[^\x00-\x08\x0e-\x1f\n]*\n")  # a binary pair that begins with '#' has control bytes
_END = b"#End Of ASCII Header"

_IMU = 0x8000_0C00  # a word of the inertial unit has all of these bits set
_NO_DVS = 0x8000_0400  # samples and edges on the camera's input have one of these bits set; events have none
_IMU_WORDS = 7  # words of one sample: accel x y z, temperature, gyro x y z
GYRO_LSB_DEG_S = {250: 131.0, 500: 65.5, 1000: 32.8, 2000: 16.4}
ACCEL_LSB_G = {2: 16384.0, 4: 8192.0, 8: 4096.0, 16: 2048.0}
"""Full scale -> counts per deg/s and per g, from the data sheet of the MPU-6150 (jAER has 63.5 for 500 deg/s)."""


class Chip(NamedTuple):
    """Address layout of a chip. Both axes count from the lower right corner."""

    sensor: Sensor
    x_bit: int
    y_bit: int
    p_bit: int
    on: int  # the polarity bit of an ON event
    not_event: int  # an address with one of these bits set is not an event
    camera_axes: tuple[int, int, int] | None  # signs from the inertial unit's axes to the camera's, if known


_DAVIS240 = Chip(Sensor(240, 180), 12, 22, 11, 1, _NO_DVS, (-1, 1, -1))
_DAVIS346 = _DAVIS240._replace(sensor=Sensor(346, 260), camera_axes=None)
_DVS128 = Chip(Sensor(128, 128), 1, 8, 0, 0, 0xFFFF_8000, None)
CHIPS = {"DAVIS240": _DAVIS240, "DAVIS346": _DAVIS346, "DVS128": _DVS128, "TMPDIFF128": _DVS128}
"""Chips by the first part of their name in jAER."""


class Header(NamedTuple):
    """Content of the text header."""

    chip_name: str | None
    gyro_deg_s: int | None  # full scale, None if it is missing or ambiguous
    accel_g: int | None
    size: int  # [bytes]


def parse_header(head: bytes) -> Header:
    r"""Read the lines that begin with '#'.

    >>> parse_header(b"#!AER-DAT2.0\r\n# AEChip: eu.davis.DAVIS240C\r\n\x00\x01").chip_name
    'DAVIS240C'
    """
    at = 0
    while line := _LINE.match(head, at):
        at = line.end()
        if line.group().startswith(_END):
            break
    text = head[:at].decode("latin-1")
    chip = re.search(r"^# ?AEChip: *([\w.$]+)", text, re.MULTILINE)
    gyro = set(re.findall(r'GyroScale" value="GyroFullScaleDegPerSec(\d+)"', text))
    accel = set(re.findall(r'AccelScale" value="ImuAccelScaleG(\d+)"', text))
    return Header(
        chip.group(1).rpartition(".")[2] if chip else None,
        int(gyro.pop()) if len(gyro) == 1 else None,
        int(accel.pop()) if len(accel) == 1 else None,
        at,
    )


@dataclass(frozen=True, slots=True)
class Aedat2Recording(EventsOnly):
    """An .aedat file of a DAVIS240, a DAVIS346 or a DVS128; see `Recording`. Frames are not read.

    Source: jAER's extractors (DavisBaseCamera, DVS128, IMUSample).
    """

    path: Path
    sensor: Sensor
    chip: Chip
    header: Header
    endless: bool = False

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .aedat file.
            sensor: the pixel array of the events. The default is that of the chip.

        Raises:
            UnknownSource: the file is not AEDAT 2.0, or its header does not name a known chip.
        """
        with path.open("rb") as file:
            head = file.read(MAX_HEADER_BYTES)
        if not head.startswith(_MAGIC):
            raise UnknownSource(path, "the file does not begin with the AEDAT 2.0 signature")
        header = parse_header(head)
        name = (header.chip_name or "").upper()
        chip = next((chip for start, chip in CHIPS.items() if name.startswith(start)), None)
        if chip is None:
            why = f"its chip is {header.chip_name!r}" if name else "its header has no AEChip"
            raise UnknownSource(path, f"{why}; supported chips: {', '.join(CHIPS)}")
        return cls(path, sensor or chip.sensor, chip, header)

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    @property
    def streams(self) -> tuple[str, ...]:
        """Events. For a DAVIS also imu, which is empty if the file has no inertial samples."""
        return ("events",) if self.chip is _DVS128 else ("events", "imu")

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. The 32-bit clock wraps every 71.6 min and is unwrapped.

        Raises:
            BrokenRecording: a pair is truncated, outside the sensor, or earlier than the pair before it. The error
                names the byte.
        """
        not_before_us = None
        for at, address, t in self._blocks():
            index = np.flatnonzero(address & self.chip.not_event == 0)
            events = self._events(address[index], t[index])
            try:
                check_events(events, self.sensor, not_before_us)
            except (EventOutsideSensor, TimeBackwards) as error:
                valid = valid_prefix(events, self.sensor, not_before_us)
                yield from in_chunks(valid)
                byte = at + int(index[valid.n]) * PAIR.itemsize
                raise BrokenRecording(self.path, f"byte {byte}", error.message) from None
            yield from in_chunks(events)
            not_before_us = int(events.t[-1]) if events.n else not_before_us

    def imu(self) -> Iterator[Imu]:
        """All complete samples; see `Recording`. Axes: the optical frame for a DAVIS240, else those of the unit.

        A sample without all of its words is skipped. The last sample of a recording can be such a sample.

        Raises:
            InvalidField: there are samples, but the header does not give their scale.
            BrokenRecording: a pair is truncated, or a sample is earlier than the sample before it.
        """
        if self.chip is _DVS128:
            return
        pending, not_before_us = np.empty((2, 0), np.int64), None
        for at, address, t in self._blocks():
            of_imu = address & _IMU == _IMU
            words = np.concatenate([pending, np.stack([address[of_imu], t[of_imu]])], axis=1)
            code = words[0] >> 28 & 7
            first = np.flatnonzero(code[: code.size - _IMU_WORDS + 1] == 0) if code.size >= _IMU_WORDS else code[:0]
            first = first[(code[first[:, None] + np.arange(_IMU_WORDS)] == np.arange(_IMU_WORDS)).all(1)]
            pending = words[:, max(code.size - _IMU_WORDS + 1, int(first[-1]) + _IMU_WORDS if first.size else 0) :]
            if not first.size:
                continue
            samples = self._samples(words, first)
            times = samples.t if not_before_us is None else np.append(not_before_us, samples.t)
            if (np.diff(times) < 0).any():
                raise BrokenRecording(self.path, f"byte {at}", "time runs backwards in the samples from this byte")
            not_before_us = int(samples.t[-1])
            yield samples

    def _samples(self, words: NDArray[np.int64], first: NDArray[np.intp]) -> Imu:
        """The samples that begin at the columns `first` of `words`, which has rows of address and time (2, N)."""
        gyro_lsb = GYRO_LSB_DEG_S.get(self.header.gyro_deg_s or 0)
        accel_lsb = ACCEL_LSB_G.get(self.header.accel_g or 0)
        if gyro_lsb is None or accel_lsb is None:
            found = f"{self.header.gyro_deg_s} deg/s, {self.header.accel_g} g"
            raise InvalidField(
                str(self.path), "ImuGyroScale, ImuAccelScale", found, "the header must give one value of each"
            )
        raw = (words[0] >> 12).astype(np.uint16).view(np.int16)[first[:, None] + np.arange(_IMU_WORDS)]
        axes = np.array(self.chip.camera_axes or (1, 1, 1), np.float64)
        return Imu(words[1, first], raw[:, :3] * axes * (G_M_S2 / accel_lsb), np.radians(raw[:, 4:] * axes / gyro_lsb))

    def _events(self, address: NDArray[np.int64], t: NDArray[np.int64]) -> Events:
        (width, height), chip = (self.chip.sensor.width, self.chip.sensor.height), self.chip
        bits = 7 if chip is _DVS128 else 10
        x = width - 1 - (address >> chip.x_bit & (1 << bits) - 1)
        # a negative y becomes larger than any sensor
        y = height - 1 - (address >> chip.y_bit & (1 << min(bits, 9)) - 1)
        return Events.from_columns(t, x.astype(np.uint16), y.astype(np.uint16), (address >> chip.p_bit & 1) == chip.on)

    def _blocks(self) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
        """Blocks of up to BLOCK_BYTES: the byte of the first pair, the addresses and the times [us]."""
        at, before_us = self.header.size, 0
        with self.path.open("rb") as file:
            file.seek(at)
            while block := file.read(BLOCK_BYTES):
                pairs = np.frombuffer(block, PAIR, len(block) // PAIR.itemsize)
                t, before_us = unwrap_times(pairs["t"], before_us)
                yield at, pairs["address"].astype(np.int64), t
                at += pairs.nbytes
                if len(block) % PAIR.itemsize:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within a pair of address and time")


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> Aedat2Recording:
    refuse_topic(path, topic)
    return Aedat2Recording.open(path, sensor)


FORMAT = Format("FILE.aedat (AEDAT 2.0 of jAER)", _open, (".aedat",), signature=b"#!AER-DAT2")
