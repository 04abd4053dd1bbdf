"""Logs on stderr: coloured lines on a terminal, otherwise one JSON object per line.

A log line never waits for its reader, is bounded in length, and one kind of line is bounded in number.
"""

import atexit
import contextlib
import logging
import os
import sys
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Any, Final, TextIO

from neurove_service.log_writer import Limiter, LogWriter
from neurove_service.output import printable, unfiltered


@contextlib.contextmanager
def _hidden(name: str) -> Iterator[None]:
    """Let an import of this package fail, as if it were not installed."""
    absent = object()
    before = sys.modules.get(name, absent)
    sys.modules[name] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[name]
        if before is not absent:
            sys.modules[name] = before  # type: ignore[assignment]


with _hidden("rich"):  # structlog would load it for the tracebacks of a terminal: 3.7 MiB in every process
    import structlog

MAX_VALUE: Final = 300
"""Most characters of a value in a line; what comes from outside may be longer."""

MAX_LINE: Final = 32_768
"""Most characters of a line; a traceback may be longer."""

_FLUSH_S = 1.0


class _Handler(logging.Handler):
    """Formats lines and hands them to the writer."""

    def __init__(self, stream: TextIO, stamp: structlog.processors.TimeStamper) -> None:
        super().__init__()
        self._stamp = stamp
        self._limiter = Limiter()
        self.writer = LogWriter(stream, self._dropped, self._left_out)

    def emit(self, record: logging.LogRecord) -> None:
        try:
            for line in self._left_out():
                self.writer.add(line)
            fields = record.msg if isinstance(record.msg, dict) else {}
            about = str(fields.get("stream", ""))[:MAX_VALUE]
            if self._limiter.admit(str(fields.get("event", record.name)), about):
                self.writer.add(_bounded(self.format(record)))
        except Exception:  # noqa: BLE001  # a line that cannot be formatted must not end what logs it
            self.writer.add(f"a log line of {record.name} cannot be formatted")

    def _dropped(self, lines: int) -> str:
        return self._line("log lines dropped: no process reads them", lines=lines)

    def _left_out(self) -> list[str]:
        return [
            self._line("similar log lines left out", kind=one.kind, stream=one.stream, lines=one.lines)
            for one in self._limiter.ended()
        ]

    def _line(self, event: str, **fields: object) -> str:
        line: dict[str, Any] = {"event": event, "level": "warning", "logger": __name__, **fields}
        stamped = _clipped(None, "warning", self._stamp(None, "warning", line))
        about = {"_logger": None, "_name": "warning"}  # what marks a record as that of structlog
        return self.format(
            logging.makeLogRecord({"name": __name__, "levelno": logging.WARNING, "msg": stamped, **about})
        )


_handlers: list[_Handler] = []  # the present one, if any


def configure(level: str = "info") -> None:
    """Send the logs of structlog and of the standard library, which include Zenoh's, to stderr."""
    stream = unfiltered(sys.stderr) if sys.stderr is not None else Path(os.devnull).open("w")  # noqa: SIM115
    human = stream.isatty()
    stamp = structlog.processors.TimeStamper(fmt="%H:%M:%S" if human else "iso", utc=not human)
    shared: list[structlog.typing.Processor] = [
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        stamp,
        _clipped,
    ]
    renderer = structlog.dev.ConsoleRenderer() if human else structlog.processors.JSONRenderer()
    tail: list[structlog.typing.Processor] = [] if human else [structlog.processors.dict_tracebacks]
    handler = _Handler(stream, stamp)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *tail, renderer],
        )
    )
    if not _handlers:
        atexit.register(flush)
    flush()
    _handlers[:] = [handler]
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
    )


def get(name: str) -> structlog.stdlib.BoundLogger:
    """The logger of a module: `log.info("what", key=value)`."""
    return structlog.stdlib.get_logger(name)


def dropped() -> int:
    """Number of lines that were dropped, because they were not read in time."""
    return sum(handler.writer.dropped for handler in _handlers)


def flush() -> None:
    """Wait for the reader of the lines so far, at most one second."""
    for handler in _handlers:
        handler.writer.flush(_FLUSH_S)


def _clipped(_: Any, __: str, fields: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Bound and clean what a line says: names and reasons may come from a peer."""
    for name, value in fields.items():
        if isinstance(value, str):
            text = value if len(value) <= MAX_VALUE else f"{value[:MAX_VALUE]}... ({len(value)} characters)"
            fields[name] = printable(text)
    return fields


def _bounded(line: str) -> str:
    return line if len(line) <= MAX_LINE else f"{line[:MAX_LINE]}... ({len(line)} characters)"
