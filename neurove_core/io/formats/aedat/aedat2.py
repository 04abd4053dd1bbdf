"""AEDAT 2.0 files of jAER: a text header, then pairs of address and time, both 32-bit big-endian."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.axes import G_M_S2
from neurove_core.io.checked import Piece, as_recorded, cleaned, ordered
from neurove_core.io.clock import unwrap_times
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Faults
from neurove_core.io.format import Format
from neurove_core.io.order import Where
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, refuse_topic
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

MAX_HEADER_BYTES = 4 << 20  # jAER writes all its preferences there, about 200,000 bytes
PAIR = np.dtype([("address", ">u4"), ("t", ">u4")])

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
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .aedat file.
            sensor: the pixel array of the events. The default is that of the chip. If the header does not name a chip,
                the size selects the chip that has it.

        Raises:
            UnknownSource: the file is not AEDAT 2.0, its header names another chip, or it names none and the sensor is
                that of no known chip.
        """
        with path.open("rb") as file:
            head = file.read(MAX_HEADER_BYTES)
        if not head.startswith(_MAGIC):
            raise UnknownSource(path, "the file does not begin with the AEDAT 2.0 signature")
        header = parse_header(head)
        name = (header.chip_name or "").upper()
        chip = next((chip for start, chip in CHIPS.items() if name.startswith(start)), None)
        if chip is None and not name:
            chip = next((chip for chip in CHIPS.values() if chip.sensor == sensor), None)
        if chip is None:
            known = ", ".join(f"{start} {chip.sensor}" for start, chip in CHIPS.items())
            if name:
                raise UnknownSource(path, f"its chip is {header.chip_name!r}; supported chips: {known}")
            given = f"--sensor {sensor} is none of them" if sensor else "give --sensor WIDTHxHEIGHT"
            raise UnknownSource(path, f"its header has no AEChip; {given}: the size selects the chip: {known}")
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
        """All events from the beginning; see `Recording`. The 32-bit clock wraps every 71.6 min and is unwrapped."""
        return cleaned(self._pieces(), self.sensor, self.faults.begin("events"))

    def _pieces(self) -> Iterator[Piece]:
        for at, address, t in self._blocks():
            index = np.flatnonzero(address & self.chip.not_event == 0)
            yield _place(at, index), self._events(address[index], t[index])

    def imu(self) -> Iterator[Imu]:
        """All complete samples; see `Recording`. Axes: the optical frame for a DAVIS240, else those of the unit.

        A sample without all of its words is skipped. The last sample of a recording can be such a sample. If the header
        does not give the scale, there are no samples, and this is counted.
        """
        if self.chip is not _DVS128:
            yield from ordered(self._imu_pieces(), self.faults.begin("imu"))

    def _imu_pieces(self) -> Iterator[tuple[str, Imu]]:
        pending = np.empty((2, 0), np.int64)
        for at, address, t in self._blocks():
            of_imu = address & _IMU == _IMU
            words = np.concatenate([pending, np.stack([address[of_imu], t[of_imu]])], axis=1)
            code = words[0] >> 28 & 7
            first = np.flatnonzero(code[: code.size - _IMU_WORDS + 1] == 0) if code.size >= _IMU_WORDS else code[:0]
            first = first[(code[first[:, None] + np.arange(_IMU_WORDS)] == np.arange(_IMU_WORDS)).all(1)]
            pending = words[:, max(code.size - _IMU_WORDS + 1, int(first[-1]) + _IMU_WORDS if first.size else 0) :]
            if first.size:
                yield f"the samples from byte {at}", self._samples(words, first)

    def _samples(self, words: NDArray[np.int64], first: NDArray[np.intp]) -> Imu:
        """The samples that begin at the columns `first` of `words`, which has rows of address and time (2, N)."""
        gyro_lsb = GYRO_LSB_DEG_S.get(self.header.gyro_deg_s or 0)
        accel_lsb = ACCEL_LSB_G.get(self.header.accel_g or 0)
        if gyro_lsb is None or accel_lsb is None:
            found = f"{self.header.gyro_deg_s} deg/s, {self.header.accel_g} g"
            why = f"ImuGyroScale, ImuAccelScale: the header gives {found}, and must give one value of each"
            raise BrokenRecording(self.path, "the header", why)
        raw = (words[0] >> 12).astype(np.uint16).view(np.int16)[first[:, None] + np.arange(_IMU_WORDS)]
        axes = np.array(self.chip.camera_axes or (1, 1, 1), np.float64)
        return Imu(words[1, first], raw[:, :3] * axes * (G_M_S2 / accel_lsb), np.radians(raw[:, 4:] * axes / gyro_lsb))

    def _events(self, address: NDArray[np.int64], t: NDArray[np.int64]) -> Events:
        (width, height), chip = (self.chip.sensor.width, self.chip.sensor.height), self.chip
        bits = 7 if chip is _DVS128 else 10
        x = width - 1 - (address >> chip.x_bit & (1 << bits) - 1)
        y = height - 1 - (address >> chip.y_bit & (1 << min(bits, 9)) - 1)
        return as_recorded(t, x, y, (address >> chip.p_bit & 1) == chip.on)  # signed: `cleaned` names a negative number

    def _blocks(self) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
        """Blocks of up to BLOCK_BYTES: the byte of the first pair, the addresses and the times [us]."""
        at = self.header.size
        before_us: int | None = None
        with self.path.open("rb") as file:
            file.seek(at)
            while block := file.read(BLOCK_BYTES):
                pairs = np.frombuffer(block, PAIR, len(block) // PAIR.itemsize)
                t, before_us = unwrap_times(pairs["t"], before_us)
                yield at, pairs["address"].astype(np.int64), t
                at += pairs.nbytes
                if len(block) % PAIR.itemsize:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within a pair of address and time")


def _place(at: int, index: NDArray[np.intp]) -> Where:
    """The byte of event i of a block that begins at byte `at`; its pair has the number index[i]."""
    return lambda i: f"byte {at + int(index[i]) * PAIR.itemsize}"


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> Aedat2Recording:
    refuse_topic(path, topic)
    return Aedat2Recording.open(path, sensor)


FORMAT = Format("FILE.aedat (AEDAT 2.0 of jAER)", _open, (".aedat",), signature=b"#!AER-DAT2")
