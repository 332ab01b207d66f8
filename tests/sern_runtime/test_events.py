"""Events are numbered and bounded, strangers push nothing out, and an answer can be waited for."""

import asyncio
import json
import logging
from typing import Any

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_runtime import clock
from sern_runtime.events import (
    BURST,
    INTERVAL_S,
    KIND_BURST,
    LEFT_OUT,
    MAX_CAUSES,
    MAX_EVENTS,
    MAX_REFUSED,
    REFUSED,
    EventLog,
    wall_text,
)
from sern_runtime.http_routes import JsonParts
from sern_runtime.logs import JsonFormatter, TextFormatter

_log = logging.getLogger("test_events")


class Time:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(clock, "now", lambda: self.now_s)

    def interval(self) -> None:
        self.now_s += INTERVAL_S


@pytest.fixture
def time_(monkeypatch: pytest.MonkeyPatch) -> Time:
    return Time(monkeypatch)


def answer(events: EventLog, **query: str) -> dict[str, Any]:
    parts = events.view().read(query)
    assert isinstance(parts, JsonParts)
    told: dict[str, Any] = json.loads("".join(parts.pieces))
    return told


def numbers(told: dict[str, Any]) -> list[int]:
    return [event["number"] for event in told["events"]]


def test_an_event_has_both_clocks_and_what_is_known_of_it(time_: Time) -> None:
    events = EventLog(wall=lambda: 1_700_000_000.25)
    events.add("connected", "robot1", "robot1 connected", address="192.0.2.1:4")
    assert answer(events)["events"] == [
        {"number": 1, "time": "2023-11-14T22:13:20.250Z", "at_s": time_.now_s, "kind": "connected", "about": "robot1",
         "text": "robot1 connected", "address": "192.0.2.1:4"},
    ]  # fmt: skip
    assert wall_text(0.0) == "1970-01-01T00:00:00.000Z"


def test_what_came_after_a_number_is_told_once(time_: Time) -> None:
    events = EventLog()
    for name in "abc":
        events.add("connected", name)
    told = answer(events, after="1", boot=events.boot)
    assert (numbers(told), told["last"], told["missed"]) == ([2, 3], 3, 0)
    assert numbers(answer(events, after="3", boot=events.boot)) == []


def test_a_number_of_another_process_means_nothing(time_: Time) -> None:
    events = EventLog()
    events.add("connected", "a")
    assert numbers(answer(events, after="700", boot="another")) == [1]
    assert EventLog().boot != events.boot


def test_one_cause_and_one_kind_are_bounded_and_the_rest_is_counted(time_: Time) -> None:
    events = EventLog()
    for _ in range(BURST + 7):
        events.add("denied", "robot1")
    assert len(events.after(0)) == BURST
    for number in range(KIND_BURST):
        events.add("denied", f"robot{number}")
    assert len(events.after(0)) == KIND_BURST
    time_.interval()
    events.tick()
    told = events.after(0)[-1]
    assert (told["kind"], told["of_kind"], told["count"]) == (LEFT_OUT, "denied", 7 + BURST)
    events.add("denied", "robot1")
    assert events.after(0)[-1]["kind"] == "denied"  # a new interval


def test_strangers_push_nothing_else_out(time_: Time) -> None:
    events = EventLog()
    events.add("takeover", "robot1")
    for number in range(20 * MAX_REFUSED):
        events.add(REFUSED, f"key {number}")
        time_.now_s += 1.0
    kept = events.after(0)
    assert sum(event["kind"] == "takeover" for event in kept) == 1
    assert len(kept) <= MAX_REFUSED + 1
    assert [event["number"] for event in kept] == sorted(event["number"] for event in kept)


def test_everything_that_is_kept_has_a_bound_and_what_is_missed_is_counted(time_: Time) -> None:
    events = EventLog()
    for number in range(MAX_EVENTS + 500):
        events.add(f"kind{number}", "x" * 5000, "y" * 5000)
        time_.interval()
    told = answer(events, after="100")
    assert len(told["events"]) == MAX_EVENTS
    assert told["missed"] == 400
    assert max(len(json.dumps(event)) for event in told["events"]) < 1200
    for number in range(2 * MAX_CAUSES):
        events.add(f"more{number}")
    assert len(events._causes) <= MAX_CAUSES


async def asked(query: dict[str, str]) -> None:
    route = EventLog().view()
    assert route.prepare is not None
    await route.prepare(query)
    route.read(query)


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ({"after": "-1"}, "after"), ({"after": "x"}, "after"), ({"after": "9" * 40}, "after"),
        ({"wait_s": "1e9"}, "0 to 30"), ({"wait_s": "nan"}, "0 to 30"), ({"wait_s": "-1"}, "0 to 30"),
    ],
)  # fmt: skip
async def test_a_bad_question_is_one_line(query: dict[str, str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        await asked(query)


async def test_an_answer_waits_for_an_event() -> None:
    events = EventLog()
    prepare = events.view().prepare
    assert prepare is not None
    waits = asyncio.ensure_future(prepare({"after": "0", "boot": events.boot, "wait_s": "30"}))
    await asyncio.sleep(0)
    assert not waits.done()
    events.add("connected", "robot1")
    await waits
    assert numbers(answer(events, after="0")) == [1]
    await prepare({"after": "0", "wait_s": "30"})  # at once: there is one


async def test_the_end_answers_whoever_waits() -> None:
    events = EventLog()
    waits = asyncio.ensure_future(events.wait(0, 30.0))
    await asyncio.sleep(0)
    events.close()
    await waits
    await events.wait(0, 30.0)
    assert events.after(0) == []


def test_a_line_of_the_log_is_an_event_in_the_same_words(caplog: pytest.LogCaptureFixture) -> None:
    events = EventLog()
    events.say(_log, logging.WARNING, "lost", "relay", "%s: %s%%", "tcp://relay", 7, reason="x")
    record = caplog.records[0]
    assert record.getMessage() == events.after(0)[0]["text"] == "tcp://relay: 7%"
    assert TextFormatter(with_time=False).format(record) == "WARNING test_events tcp://relay: 7%"
    told = json.loads(JsonFormatter().format(record))
    assert (told["event"], told["about"], told["message"]) == ("lost", "relay", "tcp://relay: 7%")
    assert record.pathname == __file__
