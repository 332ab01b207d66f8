"""`sern events`: every event once, in order, over restarts and gaps, and an end when nobody reads."""

import json
import os
from io import StringIO
from itertools import islice
from typing import Any

import pytest

from sern_core.vocabulary.errors import SernError
from sern_tools.api import NotFoundError
from sern_tools.events import Follower, run_events

URL = "http://daemon"


class Daemon:
    """Answers one after the other; an exception is raised."""

    def __init__(self, *answers: Any) -> None:
        self.answers = list(answers)
        self.asked: list[str] = []

    def __call__(self, _api: str, path: str, *, timeout_s: float | None = None) -> Any:
        self.asked.append(path)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


def told(*numbers: int, boot: str = "b1", missed: int = 0, last: int | None = None) -> dict[str, Any]:
    events = [{"number": number, "kind": "connected", "text": f"event {number}"} for number in numbers]
    newest = last if last is not None else max(numbers, default=0)
    return {"boot": boot, "last": newest, "missed": missed, "time": "T", "events": events}


def follower(daemon: Daemon) -> tuple[Follower, list[str]]:
    said: list[str] = []
    return Follower(URL, get=daemon, warn=said.append, pause=lambda _s: None), said


def test_what_was_before_comes_first_and_then_what_is_new() -> None:
    daemon = Daemon(told(1, 2, 3), told(4, 5), told(last=5))
    one, said = follower(daemon)
    assert [event["number"] for event in one.begin(2)] == [2, 3]
    following = one.follow()
    assert [event["number"] for event in islice(following, 2) if event is not None] == [4, 5]
    assert next(following) is None
    assert daemon.asked[1] == "/api/events?after=3&boot=b1&wait_s=10"
    assert daemon.asked[2] == "/api/events?after=5&boot=b1&wait_s=10"
    assert said == []


def test_a_daemon_that_was_started_anew_is_followed_and_said() -> None:
    daemon = Daemon(
        told(1, 2, 3), SernError("no answer"), SernError("no answer"), told(1, boot="b2"), told(2, boot="b2")
    )
    one, said = follower(daemon)
    one.begin(0)
    found = [event for event in islice(one.follow(), 5) if event is not None]
    assert [event["kind"] for event in found] == ["restarted", "connected", "connected"]
    assert daemon.asked[-1] == "/api/events?after=1&boot=b2&wait_s=10"
    assert len(said) == 2  # an absence is said once
    assert said[0] == "no answer (trying again)"
    assert said[1].startswith("http://daemon answers again, after ")
    assert said[1].endswith("; it was started anew")


def test_events_that_were_missed_are_said_in_the_stream_too() -> None:
    one, said = follower(Daemon(told(1), told(90, 91, missed=88)))
    one.begin(0)
    found = [event for event in islice(one.follow(), 3) if event is not None]
    assert (found[0]["kind"], found[0]["count"]) == ("missed", 88)
    assert [event["number"] for event in found[1:]] == [90, 91]
    assert said == ["88 events were missed: they came faster than they were read"]


def test_an_older_daemon_is_an_error_of_one_line() -> None:
    one, _ = follower(Daemon(NotFoundError("no path")))
    with pytest.raises(SernError, match="older than this program"):
        one.begin(1)


def test_each_event_is_a_line_of_json() -> None:
    out = StringIO()
    one, _ = follower(Daemon(told(1, 2)))
    run_events(one, last=5, once=True, out=out)
    assert [json.loads(line)["number"] for line in out.getvalue().splitlines()] == [1, 2]


def test_it_ends_when_nobody_reads_any_more() -> None:
    reader, writer = os.pipe()
    one, _ = follower(Daemon(told(), told()))
    os.close(reader)
    with os.fdopen(writer, "w") as out, pytest.raises(BrokenPipeError):
        run_events(one, last=0, once=False, out=out)
