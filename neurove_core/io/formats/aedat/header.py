"""Header of AEDAT4 data: the streams in it, as a file and a network stream of DV describe them.

It is a flatbuffer that holds XML. Source: ioheader.fbs of https://gitlab.com/inivation/dv/dv-processing.
"""

import struct
from typing import Final, NamedTuple
from xml.etree import ElementTree

from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

MAX_HEADER_BYTES: Final = 16 << 20
"""Limit for a header; one has about 3,000 bytes."""

PACKET_HEADER: Final = struct.Struct("<ii")
"""Before each packet: stream, size of the packet after this header [bytes]."""

_KINDS = {"EVTS": "events", "IMUS": "imu", "FRME": "frames", "TRIG": "triggers"}  # type in the header -> stream


class BadHeader(Exception):
    """The header cannot be decoded."""


class Stream(NamedTuple):
    """A stream that the header names."""

    number: int
    kind: str  # as in `Recording.streams`
    source: str  # the camera
    sensor: Sensor | None  # None without a valid size


def parse_header(header: bytes) -> tuple[list[Stream], int]:
    """The streams by number, and the byte after the last packet, -1 if the writer did not know it.

    Args:
        header: the flatbuffer, without its size.

    Raises:
        BadHeader: it is corrupt.
    """
    try:
        # a flatbuffer: a table of fields, preceded by their offsets, which are 0 for a field with its default
        (table,) = struct.unpack_from("<I", header)
        fields = table - struct.unpack_from("<i", header, table)[0]
        known, _, _, position, text = struct.unpack_from("<5H", header, fields)
        end = struct.unpack_from("<q", header, table + position)[0] if known >= 8 and position else -1
        text += table
        text += struct.unpack_from("<I", header, text)[0]
        (characters,) = struct.unpack_from("<I", header, text)
        xml = struct.unpack_from(f"{characters}s", header, text + 4)[0].decode()
        return _streams(xml), end
    except (struct.error, UnicodeDecodeError, ElementTree.ParseError, OverflowError) as error:
        raise BadHeader(str(error)) from None


def _streams(xml: str) -> list[Stream]:
    """The streams that the text of the header describes, by number.

    Raises:
        ElementTree.ParseError: it is not XML.
    """
    found = []
    for node in ElementTree.fromstring(xml).iterfind(".//node[@name='outInfo']/node"):
        number, kind = node.get("name", ""), _KINDS.get(_attribute(node, "typeIdentifier"))
        if kind is None or not number.isdecimal():
            continue
        info = node.find("node[@name='info']")
        try:
            sensor = Sensor(int(_attribute(info, "sizeX")), int(_attribute(info, "sizeY")))
        except (ValueError, InvalidField):
            sensor = None
        found.append(Stream(int(number), kind, _attribute(info, "source"), sensor))
    return sorted(found)


def _attribute(node: ElementTree.Element | None, name: str) -> str:
    """The text of an attribute of a node; empty without one."""
    found = None if node is None else node.find(f"attr[@key='{name}']")
    return "" if found is None or found.text is None else found.text
