"""One line a record, whatever is in it, and no flood."""

import io
import json
import logging
import sys
import threading
from collections.abc import Callable, Iterator

import pytest

from sern_runtime.config.shared import LogSection
from sern_runtime.entry import run_daemon
from sern_runtime.logs import (
    FORMAT_BURST,
    MAX_CAUSES,
    MAX_WORDS,
    REPEAT_INTERVAL_S,
    JsonFormatter,
    LimitedHandler,
    LogFormat,
    RepeatLimit,
    TextFormatter,
    configure,
)
from sern_runtime.loop import Shutdown


@pytest.fixture
def root_restored() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    logging.captureWarnings(capture=False)


def record(message: str, *args: object, level: int = logging.INFO, **extra: object) -> logging.LogRecord:
    made = logging.getLogger("sern_relay.routing").makeRecord(
        "sern_relay.routing", level, "file.py", 1, message, args, None, extra=extra
    )
    made.created, made.msecs = 1_700_000_000.25, 250.0
    return made


def test_text() -> None:
    line = TextFormatter().format(record("refused %s", "/cmd_vel", level=logging.WARNING, client="site1"))
    assert line == "2023-11-14T22:13:20.250Z WARNING sern_relay.routing refused /cmd_vel client=site1"
    assert TextFormatter(with_time=False).format(record("up")) == "INFO sern_relay.routing up"


def test_json() -> None:
    assert json.loads(JsonFormatter().format(record("refused %s", "/cmd_vel", client="site1", count=3))) == {
        "time": "2023-11-14T22:13:20.250Z",
        "level": "info",
        "logger": "sern_relay.routing",
        "message": "refused /cmd_vel",
        "client": "site1",
        "count": 3,
    }


@pytest.mark.parametrize("formatter", [TextFormatter(), JsonFormatter()], ids=["text", "json"])
def test_nothing_starts_a_second_line(formatter: logging.Formatter) -> None:
    forged = "x\n2023-11-14T22:13:20Z ERROR forged\r\x1b[2J\u2028next"
    made = record("topic %s", forged, topic=forged)
    try:
        raise ValueError("first\nsecond")
    except ValueError:
        made.exc_info = sys.exc_info()
    line = formatter.format(made)
    assert len(line.splitlines()) == 1
    assert "\x1b" not in line
    assert "first" in line and "second" in line and "Traceback" in line


def test_a_field_cannot_replace_a_fixed_one() -> None:
    assert json.loads(JsonFormatter().format(record("real", logger="forged")))["logger"] == ("sern_relay.routing")


def test_repeated_warnings_are_held_back_and_counted() -> None:
    now_s = 0.0
    limit = RepeatLimit(burst=2, interval_s=10.0, clock=lambda: now_s)

    def passed(message: str = "slow %d", level: int = logging.WARNING) -> bool:
        return limit.filter(record(message, 1, level=level))

    assert [passed() for _ in range(5)] == [True, True, False, False, False]
    assert passed("another cause %d")
    assert passed(level=logging.ERROR)
    assert all(passed(level=logging.INFO) for _ in range(9))
    (told,) = limit.take_held_back()
    assert TextFormatter(with_time=False).format(told) == "WARNING sern_relay.routing 3 more of: slow 1"
    assert limit.take_held_back() == []
    assert not passed()  # told of meanwhile, and of the same interval
    now_s = 10.0
    assert [passed() for _ in range(3)] == [True, True, False]
    assert [told.getMessage() for told in limit.take_held_back()] == ["2 more of: slow 1"]


def test_numbers_do_not_tell_causes_apart() -> None:
    limit = RepeatLimit(burst=2, clock=lambda: 0.0)
    passed = [limit.filter(record("%d waiting", number, level=logging.WARNING)) for number in range(4)]
    assert passed == [True, True, False, False]


@pytest.mark.parametrize(
    "message",
    ["%s is gone: the relay does not reach it any more", "%s", "%s: %s", "%s is back after %.1f s"],
)
def test_what_is_said_once_of_each_of_many_is_said_of_all(message: str) -> None:
    """Robots behind one radio are lost together; types that nobody has a definition of are found together."""
    limit = RepeatLimit(clock=lambda: 0.0)
    arguments = {"%s: %s": ("no datagram came through",), "%s is back after %.1f s": (10.0,)}.get(message, ())
    for number in range(20):
        assert limit.filter(record(message, f"jackal{number}", *arguments, level=logging.WARNING)), number
    assert limit.take_held_back() == []


def test_what_is_said_of_very_many_has_an_end() -> None:
    """A stranger who comes from ever new addresses, for one."""
    now_s = 0.0
    limit = RepeatLimit(clock=lambda: now_s)
    passed = 0
    for number in range(10_000):
        now_s = number * 0.003
        passed += limit.filter(record("%s has a key that nobody knows", f"address {number}", level=logging.WARNING))
    assert passed == 3 * FORMAT_BURST
    (told,) = limit.take_held_back()
    assert told.getMessage() == f"{10_000 - passed} more of: address {FORMAT_BURST} has a key that nobody knows"


def test_an_argument_without_a_text_raises_nothing() -> None:
    class Broken:
        def __str__(self) -> str:
            raise ValueError("no text")

    limit = RepeatLimit(burst=1, clock=lambda: 0.0)
    assert [limit.filter(record("of %s", Broken(), level=logging.WARNING)) for _ in range(2)] == [True, False]
    assert [told.getMessage() for told in limit.take_held_back()] == ["1 more of: of %s"]


def test_causes_and_formats_are_bounded() -> None:
    limit = RepeatLimit(clock=lambda: 0.0)
    for number in range(3 * MAX_CAUSES):
        limit.filter(record(f"cause {number}", level=logging.WARNING))
    assert len(limit._causes) == len(limit._formats) == MAX_CAUSES
    limit.filter(record("%s", "x" * 10**6, level=logging.WARNING))
    assert max(len(about) for _, about in limit._causes) == MAX_WORDS


class Timer:
    """Stands in for the thread: `due` is called by the test."""

    def __init__(self) -> None:
        self.started: list[tuple[float, Callable[[], None]]] = []
        self.cancelled = 0
        self.refuses = False

    def start(self, delay_s: float, due: Callable[[], None]) -> Callable[[], None]:
        if self.refuses:
            raise RuntimeError("can't start new thread")
        self.started.append((delay_s, due))
        return self._cancel

    def _cancel(self) -> None:
        self.cancelled += 1


def flooded(timer: Timer) -> tuple[io.StringIO, LimitedHandler]:
    stream = io.StringIO()
    handler = LimitedHandler(stream, RepeatLimit(burst=2, clock=lambda: 0.0), start_timer=timer.start)
    handler.setFormatter(TextFormatter(with_time=False))
    for _ in range(5):
        handler.handle(record("%s is slow", "disk", level=logging.WARNING))
    return stream, handler


def test_what_was_held_back_is_told_though_nothing_follows() -> None:
    timer = Timer()
    stream, handler = flooded(timer)
    assert [delay_s for delay_s, _ in timer.started] == [REPEAT_INTERVAL_S]
    assert stream.getvalue().count("\n") == 2
    timer.started[0][1]()
    assert stream.getvalue().splitlines()[2:] == ["WARNING sern_relay.routing 3 more of: disk is slow"]
    handler.handle(record("%s is slow", "disk", level=logging.WARNING))
    assert len(timer.started) == 2


def test_what_was_held_back_is_told_at_the_end() -> None:
    timer = Timer()
    stream, handler = flooded(timer)
    handler.close()
    assert timer.cancelled == 1
    assert stream.getvalue().endswith("3 more of: disk is slow\n")


def test_without_a_thread_it_is_told_later() -> None:
    timer = Timer()
    timer.refuses = True
    stream, handler = flooded(timer)
    timer.refuses = False
    handler.handle(record("%s is slow", "disk", level=logging.WARNING))
    timer.started[0][1]()
    assert stream.getvalue().endswith("4 more of: disk is slow\n")


def test_the_thread_tells_it() -> None:
    told = threading.Event()

    class Stream(io.StringIO):
        def write(self, text: str) -> int:
            if "more of" in text:
                told.set()
            return super().write(text)

    handler = LimitedHandler(Stream(), RepeatLimit(burst=1, interval_s=0.001, clock=lambda: 0.0))
    for _ in range(2):
        handler.handle(record("%s is slow", "disk", level=logging.WARNING))
    assert told.wait(60.0)
    handler.close()


@pytest.mark.parametrize("log_format", ["text", "json"])
def test_configure(root_restored: None, log_format: LogFormat) -> None:
    stream = io.StringIO()
    handler = configure(log_format=log_format, level="INFO", stream=stream, environment={})
    assert logging.getLogger().handlers == [handler]
    logging.getLogger("sern_test").debug("hidden")
    logging.getLogger("sern_test").info("shown", extra={"client": "a"})
    (line,) = stream.getvalue().splitlines()
    assert "shown" in line
    assert (line.startswith("{")) == (log_format == "json")


def test_the_journal_has_its_own_time(root_restored: None) -> None:
    stream = io.StringIO()
    configure(stream=stream, environment={"JOURNAL_STREAM": "8:1"})
    logging.getLogger("sern_test").warning("up")
    assert stream.getvalue() == "WARNING sern_test up\n"


def test_the_command_line_has_the_last_word_about_the_format(
    root_restored: None, capsys: pytest.CaptureFixture[str]
) -> None:
    async def main(_shutdown: Shutdown) -> int:
        logging.getLogger("test").warning("said")
        return 0

    assert run_daemon("sern-test", LogSection, main, log_format="json") == 0
    assert json.loads(capsys.readouterr().err)["message"] == "said"
