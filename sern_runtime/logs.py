"""Logging for people and for machines: one line a record, and no flood from one cause.

    text   2026-01-31T12:00:00.123Z WARNING sern_relay.routing refused /cmd_vel from site1 client=site1
    json   {"time": "...", "level": "warning", "logger": "...", "message": "...", "client": "site1"}

Fields come through `extra={"client": name}`. Under systemd (JOURNAL_STREAM is set) the text has no time of its own.
"""

import json
import logging
import os
import sys
import time
from collections.abc import Callable, Mapping
from typing import Final, Literal, TextIO

LogFormat = Literal["text", "json"]
REPEAT_INTERVAL_S: Final = 10.0
"""A warning with the same words is written at most `REPEAT_BURST` times in this long."""
REPEAT_BURST: Final = 5
MAX_CAUSES: Final = 1000
_STANDARD: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


def _fields(record: logging.LogRecord) -> dict[str, object]:
    return {name: value for name, value in vars(record).items() if name not in _STANDARD}


def _message(record: logging.LogRecord, formatter: logging.Formatter) -> str:
    text = record.getMessage()
    if record.exc_info:
        text += "\n" + formatter.formatException(record.exc_info)
    return text


def _utc(record: logging.LogRecord) -> str:
    whole_s = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
    return f"{whole_s}.{int(record.msecs):03d}Z"


def _one_line(text: str) -> str:
    """Escape what would start a new line or steer a terminal: text from a peer must not forge a record."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


class TextFormatter(logging.Formatter):
    def __init__(self, *, with_time: bool = True) -> None:
        super().__init__()
        self._with_time = with_time

    def format(self, record: logging.LogRecord) -> str:
        parts = [_utc(record)] if self._with_time else []
        parts += [record.levelname, record.name, _one_line(_message(record, self))]
        parts += [f"{name}={_one_line(str(value))}" for name, value in _fields(record).items()]
        return " ".join(parts)


class JsonFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, object] = {
            "time": _utc(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        for name, value in _fields(record).items():
            line.setdefault(name, value)
        return json.dumps(line, default=str)


class RepeatLimit(logging.Filter):
    """Lets `burst` records of one cause through per `interval_s`, and says how many it held back with the next one.

    A cause is the logger, the level and the unformatted message; levels below WARNING are not limited.
    """

    def __init__(
        self,
        *,
        burst: int = REPEAT_BURST,
        interval_s: float = REPEAT_INTERVAL_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self._burst = burst
        self._interval_s = interval_s
        self._clock = clock
        self._causes: dict[tuple[str, int, str], tuple[float, int]] = {}  # -> start of the interval, records in it

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return True
        cause = (record.name, record.levelno, str(record.msg))
        now_s = self._clock()
        start_s, records = self._causes.pop(cause, (now_s, 0))
        held_back = 0
        if now_s - start_s >= self._interval_s:
            held_back = max(0, records - self._burst)
            start_s, records = now_s, 0
        self._causes[cause] = (start_s, records + 1)  # last in the dict: the longest unused cause is first
        if len(self._causes) > MAX_CAUSES:
            del self._causes[next(iter(self._causes))]
        if held_back:
            record.held_back = held_back
        return records < self._burst


def configure(
    *,
    log_format: LogFormat = "text",
    level: int | str = logging.INFO,
    stream: TextIO | None = None,
    environment: Mapping[str, str] = os.environ,
) -> logging.Handler:
    """Send every record of the process to `stream` (stderr), in place of the root logger's handlers."""
    handler = logging.StreamHandler(stream or sys.stderr)
    with_time = "JOURNAL_STREAM" not in environment
    handler.setFormatter(JsonFormatter() if log_format == "json" else TextFormatter(with_time=with_time))
    handler.addFilter(RepeatLimit())
    root = logging.getLogger()
    for old in root.handlers[:]:
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level)
    logging.captureWarnings(capture=True)
    return handler
