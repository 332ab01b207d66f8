"""One line a record, whatever is in it, and no flood."""

import io
import json
import logging
import sys
from collections.abc import Iterator

import pytest

from sern_runtime.logs import MAX_CAUSES, JsonFormatter, LogFormat, RepeatLimit, TextFormatter, configure


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

    def passed(message: str = "slow %d", level: int = logging.WARNING) -> logging.LogRecord | None:
        made = record(message, 1, level=level)
        return made if limit.filter(made) else None

    assert [passed() is not None for _ in range(5)] == [True, True, False, False, False]
    assert passed("another cause %d") is not None
    assert passed(level=logging.ERROR) is not None
    assert all(passed(level=logging.INFO) for _ in range(9))
    now_s = 10.0
    after = passed()
    assert after is not None
    assert vars(after)["held_back"] == 3
    assert TextFormatter().format(after).endswith("held_back=3")
    assert "held_back" not in vars(passed())


def test_causes_are_bounded() -> None:
    limit = RepeatLimit(clock=lambda: 0.0)
    for number in range(3 * MAX_CAUSES):
        limit.filter(record(f"cause {number}", level=logging.WARNING))
    assert len(limit._causes) == MAX_CAUSES


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
