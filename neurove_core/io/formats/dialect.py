"""Detection of the dialect of a text file of events, and parsing of its lines.

The Event Camera Dataset has lines `t[s] x y p` (https://rpg.ifi.uzh.ch/davis_data.html). Others write the same columns
in another order, with a header line, with commas, semicolons or tabs, with a byte order mark, with polarities -1 and 1,
with times in us, or with the sensor's width and height in the first line (rpg_e2vid: https://github.com/uzh-rpg/rpg_e2vid).
metavision_file_to_csv writes x,y,p,t in us (https://docs.prophesee.ai/stable/samples/modules/stream/file_to_csv.html).
"""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.checked import Piece
from neurove_core.io.faults import Reason, Tally
from neurove_core.io.formats.columns import SECONDS, Columns, Unclear, by_name, by_values, names_any, piece, unit_of
from neurove_core.io.order import Where
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Sensor

HEAD_BYTES: Final = 64 << 10
"""So many bytes from the beginning of a file decide its dialect."""

_MARK = b"\xef\xbb\xbf"
_COMMENTS = (b"#", b"%", b"//")
_NUMBER = rb"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_IS_NUMBER = re.compile(_NUMBER)
_SIZE = re.compile(rb"(?:geometry|resolution|sensor|size|width)\W{0,3}(\d{2,5})\D{1,12}(\d{2,5})", re.IGNORECASE)
_TRUTH = (re.compile(rb"\btrue\b", re.IGNORECASE), re.compile(rb"\bfalse\b", re.IGNORECASE))


class Dialect(NamedTuple):
    """How the lines of a file are written."""

    columns: Columns = Columns(0, 1, 2, 3, SECONDS)
    numbers: int = 4  # in a line
    skip: int = 0  # lines before the first event that are no events
    separators: bytes | None = None  # a table for bytes.translate that makes them spaces, and decimal commas points
    words: bool = False  # polarities are true and false
    sensor: Sensor | None = None  # where the file gives it

    @property
    def example(self) -> str:
        """What a line should be, for messages."""
        names = [name for _, name in sorted(zip(self.columns.order, ("t", "x", "y", "p"), strict=True))]
        return "`t[s] x y p`" if self == ECD else f"{self.numbers} numbers with {', '.join(names)}"

    def plain(self, line: bytes) -> bytes:
        """The line with spaces between its numbers."""
        if self.words:
            line = _TRUTH[1].sub(b"0", _TRUTH[0].sub(b"1", line))
        return line.translate(self.separators) if self.separators else line


ECD: Final = Dialect()
"""The dialect of the Event Camera Dataset."""


def detect(head: bytes) -> Dialect:
    """The dialect of a file that begins with these bytes.

    Raises:
        Unclear: the columns cannot be told apart; the text names the column.
    """
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise Unclear("the text is UTF-16: save it as UTF-8")
    if b"\r" in head and b"\n" not in head:
        raise Unclear("its lines end with CR: save it with LF or CR LF")
    lines = head.removeprefix(_MARK).split(b"\n")
    if len(head) >= HEAD_BYTES:
        lines.pop()
    sensor, names, skip = None, None, 0
    plain = Dialect(separators=_separators(lines), words=any(_TRUTH[0].search(line) for line in lines[1:]))
    rows: list[tuple[int, list[bytes]]] = []
    for number, line in enumerate(lines):
        words = plain.plain(line).split()
        if is_blank(line):
            names = names or _names_in_comment(line)
            sensor = sensor or _size(_SIZE.search(line))
        elif all(map(_IS_NUMBER.fullmatch, words)):
            rows.append((number, words))
        elif all(len(words) == 2 for _, words in rows[:2]) and names_any(header := _fields(line)):
            names, skip = header, number + 1
    if len(rows) > 1 and len(rows[0][1]) == 2 and len(rows[1][1]) >= 4:  # width and height
        sensor, skip = _size(rows[0][1]) or sensor, max(skip, rows[0][0] + 1)
        rows = rows[1:]
    found = plain._replace(sensor=sensor, skip=skip)
    return _with_columns(found, names, [words for _, words in rows])


def pieces(blocks: Iterator[tuple[int, list[bytes]]], dialect: Dialect, tally: Tally) -> Iterator[Piece]:
    """The events of a file for `cleaned`; lines that are no events are counted and left out.

    Args:
        blocks: the number of the first line, counted from 1, and the lines.
        dialect: of the file.
        tally: of this pass.
    """
    line_of_event = re.compile(rb"[ \t]*" + rb"[ \t]+".join([_NUMBER] * dialect.numbers) + rb"[ \t]*\r?")
    for first, lines in blocks:
        if first == 1:
            lines[0] = lines[0].removeprefix(_MARK)
        if first <= dialect.skip:
            lines[: dialect.skip + 1 - first] = [b""] * min(len(lines), dialect.skip + 1 - first)
        text = [dialect.plain(line) for line in lines] if dialect.separators or dialect.words else lines
        try:
            rows = _parse(text, dialect)
        except ValueError:
            valid = [is_blank(line) or line_of_event.fullmatch(line) is not None for line in text]
            count_lines(tally, first, lines, valid, f"the line is not {dialect.example}")
            text = [line if good else b"" for line, good in zip(text, valid, strict=True)]
            rows = _parse(text, dialect)
        columns = [rows[:, i] for i in dialect.columns.order]
        yield piece(line_of(first, text), dialect.columns.unit_us or SECONDS, columns, tally)


def is_blank(line: bytes) -> bool:
    """Whether a line is blank or a comment."""
    text = line.lstrip()
    return not text or text.startswith(_COMMENTS)


def line_of(first: int, lines: list[bytes], prefix: str = "") -> Where:
    """The line of row i of a block, which begins with line `first`."""

    def where(i: int) -> str:
        kept = [k for k, line in enumerate(lines) if not is_blank(line)]
        return f"{prefix}line {first + kept[i]}"

    return where


def count_lines(tally: Tally, first: int, lines: list[bytes], valid: list[bool], why: str, prefix: str = "") -> None:
    """Count the lines of a block that are not valid."""
    if not all(valid):
        at = valid.index(False)
        text = lines[at][:60].decode("ascii", "backslashreplace")
        tally.add(Reason.DAMAGED, f"{prefix}line {first + at}", f"{why}: {text!r}", valid.count(False))


def _parse(lines: list[bytes], dialect: Dialect) -> NDArray[np.float64]:
    """The numbers of these lines (N, count), without blank lines and comments.

    Raises:
        ValueError: a line does not have so many numbers.
    """
    if any(mark in text for text in (b"".join(lines),) for mark in _COMMENTS):
        lines = [line for line in lines if not is_blank(line)]
    if not any(map(bytes.strip, lines)):
        return np.empty((0, dialect.numbers))
    rows = np.loadtxt(lines, np.float64, comments=None, ndmin=2)
    if rows.shape[1] != dialect.numbers:
        raise ValueError(f"{rows.shape[1]} numbers in a line")
    return rows


def _separators(lines: list[bytes]) -> bytes | None:
    """The table that makes the separators of these lines spaces, or None if they are spaces."""
    found = [line for line in lines if not is_blank(line)]
    semicolons, tabs, commas = (sum(mark in line for line in found) * 2 > len(found) for mark in (b";", b"\t", b","))
    if not semicolons and not commas and not any(b'"' in line for line in found):
        return None
    few = sum(line.count(b",") <= 2 for line in found) * 2 > len(found)
    decimal = commas and few and (semicolons or tabs)
    return bytes.maketrans(b';,"', b" . " if decimal else b"   ")


def _fields(line: bytes) -> list[str]:
    """The names in a header line."""
    text = line.decode("utf-8", "replace").strip()
    for mark in (";", ",", "\t"):
        if mark in text:
            return [name.strip().strip("\"'") for name in text.split(mark)]
    return re.sub(r"\s+([\[(])", r"\1", text).split()


def _names_in_comment(line: bytes) -> list[str] | None:
    """The names of the columns, if the comment is nothing but these."""
    names = _fields(line.strip().lstrip(b"#%/"))
    try:
        by_name(names)
    except Unclear:
        return None
    return names


def _size(numbers: re.Match[bytes] | Sequence[bytes] | None) -> Sensor | None:
    """The sensor of two numbers, or None."""
    if numbers is None:
        return None
    width, height = numbers.groups() if isinstance(numbers, re.Match) else numbers
    try:
        return Sensor(int(width), int(height))
    except (ValueError, InvalidField):
        return None


def _with_columns(found: Dialect, names: list[str] | None, rows: list[list[bytes]]) -> Dialect:
    """The dialect with the columns that the header names, or that fit the first rows."""
    counts = Counter(map(len, rows)).most_common(1)
    count = counts[0][0] if counts else len(names or range(4))
    if names is not None and len(names) != count:
        raise Unclear(f"the header names {len(names)} columns ({', '.join(names)}), the lines have {count}")
    if names is None and count != 4:
        if len(rows) > 1:
            raise Unclear(f"the lines have {count} numbers: add a header line that names t, x, y and p")
        count = 4  # the only line may be truncated
    used = [words for words in rows if len(words) == count]
    columns = by_name(names) if names is not None else Columns(0, 1, 2, 3)
    if names is None and used:
        try:
            columns = by_values(np.array(used, np.float64))
        except Unclear as error:
            raise Unclear(f"{error}; add a header line that names t, x, y and p") from None
    if columns.unit_us is None and used:
        times = [words[columns.t] for words in used]
        floats = any(mark in word for word in times for mark in (b".", b"e", b"E"))
        columns = columns._replace(unit_us=unit_of(np.array(times, np.float64), floats=floats))
    return found._replace(columns=columns._replace(unit_us=columns.unit_us or SECONDS), numbers=count)
