"""What is said once, and what is said again."""

import logging

import pytest

from sern_client.endpoints.common.saying import SayOnce, Trouble
from sern_runtime import clock

LOG = logging.getLogger(__name__)


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


def test_each_line_once_and_no_more_of_them_than_a_bound(caplog: pytest.LogCaptureFixture) -> None:
    say = SayOnce(LOG, logging.ERROR, most=3)
    for line in ("one", "two", "one"):
        say(line)
    say("three of /chat", "/chat")
    say("three of /chat, in other words", "/chat")
    say("four")
    assert said(caplog) == ["one", "two", "three of /chat"] and len(say) == 3
    assert {record.levelname for record in caplog.records} == {"ERROR"}


def test_a_line_is_made_only_to_be_said(caplog: pytest.LogCaptureFixture) -> None:
    made: list[str] = []

    def line() -> str:
        made.append("dear")
        return "dear"

    say = SayOnce(LOG)
    for _ in range(3):
        say(line, "/chat")
    assert made == said(caplog) == ["dear"]


def test_what_nobody_expects_comes_with_its_traceback(caplog: pytest.LogCaptureFixture) -> None:
    SayOnce(LOG)("broken", error=ValueError("no number"))
    (record,) = caplog.records
    assert record.levelname == "ERROR" and "ValueError: no number" in caplog.text


def test_a_trouble_is_said_until_it_is_another_and_its_end_with_it(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    times_s = iter((10.0, 17.0))
    monkeypatch.setattr(clock, "now", lambda: next(times_s))
    trouble = Trouble(LOG, "/talker")
    trouble.over()
    for problem in ("refused", "refused", "no answer", "refused"):
        trouble.say(problem, lost=True)
    trouble.over()
    trouble.over()
    assert trouble.say("refused"), "again: it had answered"
    trouble.over()
    assert said(caplog) == [
        "/talker: refused", "/talker: no answer", "/talker: refused", "/talker answers again, after 7 s",
        "/talker: refused",
    ]  # fmt: skip
    trouble.forget()
    assert trouble.is_new("refused") and not trouble.is_new("refused")
