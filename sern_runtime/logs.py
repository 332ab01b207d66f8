"""Logging for people and for machines: one line a record, and no flood from one cause.

    text   2026-01-31T12:00:00.123Z WARNING sern_relay.routing refused /cmd_vel from site1 client=site1
    json   {"time": "...", "level": "warning", "logger": "...", "message": "...", "client": "site1"}

Fields come through `extra={"client": name}`. Those that only programs need, `event` and `about`
(sern_runtime/events.py), are in JSON alone: a text says them in words. Under systemd (JOURNAL_STREAM is set) the text
has no time of its own.
"""

import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final, Literal, TextIO

LogFormat = Literal["text", "json"]
LOG_FORMAT_HELP: Final = "Log for people or for programs, in place of log.format in the file."
REPEAT_INTERVAL_S: Final = 10.0
"""Warnings of one cause are written at most `REPEAT_BURST` times in this long, of one format `FORMAT_BURST` times."""
REPEAT_BURST: Final = 5
FORMAT_BURST: Final = 200
"""Many things may go wrong at once and be said once each: a hundred clients behind one radio, for one."""
MAX_CAUSES: Final = 1000
MAX_WORDS: Final = 400
"""Characters of a message by which it is told from others, and by which it is shown when it was held back."""
_Key = tuple[str, int, str]
_STANDARD: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}
_FOR_PROGRAMS: Final = frozenset({"event", "about"})


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
        fields = _fields(record).items()
        parts += [f"{name}={_one_line(str(value))}" for name, value in fields if name not in _FOR_PROGRAMS]
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


class _Format:
    """What is known of all records with one format: how many came in this interval, and what nobody was told of."""

    __slots__ = ("example", "held_back", "records", "start_s")

    def __init__(self, start_s: float) -> None:
        self.start_s = start_s
        self.records = 0
        self.held_back = 0
        self.example = ""


class RepeatLimit(logging.Filter):
    """Lets `burst` records of one cause through per `interval_s`, and `format_burst` of one format.

    A format is the logger, the level and the unformatted message; a cause is a format with its first argument, which
    names what it is about (a number names nothing). What is held back is counted until `take_held_back`; `on_held_back`
    is called with each record that is. Levels below WARNING are not limited. May be called from every thread.
    """

    def __init__(
        self,
        *,
        burst: int = REPEAT_BURST,
        format_burst: int = FORMAT_BURST,
        interval_s: float = REPEAT_INTERVAL_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self.interval_s: Final = interval_s
        self.on_held_back: Callable[[], None] = lambda: None
        self._burst = burst
        self._format_burst = format_burst
        self._clock = clock
        self._lock = threading.RLock()  # re-entrant, as those of logging: a signal handler may log
        self._formats: dict[_Key, _Format] = {}
        self._causes: dict[tuple[_Key, str], tuple[float, int]] = {}  # -> start of the interval, records in it

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return True
        with self._lock:
            passes = self._counted(record, self._clock())
        if not passes:
            self.on_held_back()
        return passes

    def _counted(self, record: logging.LogRecord, now_s: float) -> bool:
        """Count a record; whether it passes."""
        key = (record.name, record.levelno, str(record.msg)[:MAX_WORDS])
        every = self._formats.pop(key, None) or _Format(now_s)
        if now_s - every.start_s >= self.interval_s:
            every.start_s, every.records = now_s, 0
        self._formats[key] = every  # last in the dict: the longest unused one is first
        if len(self._formats) > MAX_CAUSES:
            del self._formats[next(iter(self._formats))]
        if every.records < self._format_burst and self._cause_passes((key, _about(record)), now_s):
            every.records += 1
            return True
        if not every.held_back:
            every.example = _words(record)
        every.held_back += 1
        return False

    def _cause_passes(self, cause: tuple[_Key, str], now_s: float) -> bool:
        start_s, records = self._causes.pop(cause, (now_s, 0))
        if now_s - start_s >= self.interval_s:
            start_s, records = now_s, 0
        self._causes[cause] = (start_s, records + 1)
        if len(self._causes) > MAX_CAUSES:
            del self._causes[next(iter(self._causes))]
        return records < self._burst

    def take_held_back(self) -> list[logging.LogRecord]:
        """A record for each format of which something was held back since the last call: how many, and the first."""
        with self._lock:
            found = [(key, every) for key, every in self._formats.items() if every.held_back]
            made = [
                logging.LogRecord(name, level, __file__, 0, "%d more of: %s", (every.held_back, every.example), None)
                for (name, level, _format), every in found
            ]
            for _key, every in found:
                every.held_back, every.example = 0, ""
        return made


def _about(record: logging.LogRecord) -> str:
    """The first argument where it is a name or a text: what the record is about."""
    first = record.args[0] if isinstance(record.args, tuple) and record.args else ""
    if isinstance(first, int | float):
        return ""
    try:
        return str(first)[:MAX_WORDS]
    except Exception:  # noqa: BLE001  (an object whose text fails; logging reports that where it writes the record)
        return ""


def _words(record: logging.LogRecord) -> str:
    try:
        return record.getMessage()[:MAX_WORDS]
    except Exception:  # noqa: BLE001  (as above)
        return str(record.msg)[:MAX_WORDS]


def _start_timer(delay_s: float, due: Callable[[], None]) -> Callable[[], None]:
    """Call `due` on a thread of its own; returns what prevents it. Raises RuntimeError where there is no thread."""
    timer = threading.Timer(delay_s, due)
    timer.daemon = True
    timer.start()
    return timer.cancel


class LimitedHandler(logging.StreamHandler[TextIO]):
    """Writes what `limit` lets through to `stream`, and how much it held back: at most `limit.interval_s` later, or
    when it is closed. A thread waits for that, because no record may ever follow, and the event loop may be held up."""

    def __init__(
        self,
        stream: TextIO,
        limit: RepeatLimit,
        *,
        start_timer: Callable[[float, Callable[[], None]], Callable[[], None]] = _start_timer,
    ) -> None:
        super().__init__(stream)
        self._limit = limit
        self._start_timer = start_timer
        self._timer_lock = threading.RLock()
        self._cancel: Callable[[], None] | None = None
        self.addFilter(limit)
        limit.on_held_back = self._held_back

    def _held_back(self) -> None:
        with self._timer_lock, suppress(RuntimeError):  # no thread to be had: tried again with the next one
            if self._cancel is None:
                self._cancel = self._start_timer(self._limit.interval_s, self._say_held_back)

    def _say_held_back(self) -> None:
        with self._timer_lock:
            self._cancel = None
        for record in self._limit.take_held_back():
            self.acquire()
            try:
                self.emit(record)
            finally:
                self.release()

    def close(self) -> None:
        """Say what was held back, and end. The stream stays open."""
        with self._timer_lock:
            if self._cancel is not None:
                self._cancel()
        self._say_held_back()
        super().close()


def configure(
    *,
    log_format: LogFormat = "text",
    level: int | str = logging.INFO,
    stream: TextIO | None = None,
    environment: Mapping[str, str] = os.environ,
) -> logging.Handler:
    """Send every record of the process to `stream` (stderr), in place of the root logger's handlers."""
    handler = LimitedHandler(stream or sys.stderr, RepeatLimit())
    with_time = "JOURNAL_STREAM" not in environment
    handler.setFormatter(JsonFormatter() if log_format == "json" else TextFormatter(with_time=with_time))
    root = logging.getLogger()
    for old in root.handlers[:]:
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level)
    logging.captureWarnings(capture=True)
    return handler
