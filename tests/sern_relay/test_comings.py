"""Who comes and goes, in the log."""

import logging
from types import SimpleNamespace
from typing import Any

import pytest

from sern_core.vocabulary.types import ClientName
from sern_relay.comings import AWAY, CONNECTED, DENIED, FORGOTTEN, TAKEOVER, TURN_S, TURNS, Comings
from sern_runtime import clock
from sern_runtime.events import EventLog
from sern_runtime.outages import SAY_AFTER_S

ROBOT = ClientName("robot")


def link(*, stalled: bool = False, established: bool = True) -> Any:
    return SimpleNamespace(established=established, lane=SimpleNamespace(stalled=stalled))


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.INFO)
    return caplog


def test_a_client_comes_goes_and_comes_again(said: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    comings = Comings()
    monkeypatch.setattr(clock, "now", lambda: 100.0)
    comings.up(ROBOT, resumed=False)
    comings.down(ROBOT, "no answer")
    monkeypatch.setattr(clock, "now", lambda: 107.0)
    comings.up(ROBOT, resumed=True)
    assert said.messages == ["robot connected", "robot is away: no answer", "robot connected again, after 7 s"]


def test_a_silence_in_a_session_is_said_once_and_its_end(said: pytest.LogCaptureFixture) -> None:
    comings = Comings()
    for at_s in (0.0, SAY_AFTER_S, SAY_AFTER_S + 1):
        comings.look({ROBOT: link(stalled=True)}, at_s)
    comings.look({ROBOT: link()}, 8.0)
    assert said.messages == [
        "robot does not answer; its session waits for it", "robot answers again, after 8 s",
    ]  # fmt: skip


def test_one_that_nobody_waits_for_any_more_is_new_when_it_comes(said: pytest.LogCaptureFixture) -> None:
    comings = Comings()
    comings.down(ROBOT, "gone")
    comings.look({}, 1.0)
    comings.up(ROBOT, resumed=False)
    assert said.messages[-1] == "robot connected"


def test_what_is_known_of_a_client_outlives_its_link_where_the_directory_has_it() -> None:
    events = EventLog()
    comings = Comings(events, remembered=lambda client: client == ROBOT, address=lambda _client: "192.0.2.1:4")
    stranger = ClientName("stranger")
    for client in (ROBOT, stranger):
        comings.up(client, resumed=False)
        comings.down(client, "gone")
    comings.look({ROBOT: link(established=False), stranger: link(established=False)}, clock.now())
    assert comings.clients.keys() == {ROBOT, stranger}
    comings.look({}, clock.now())
    assert comings.clients.keys() == {ROBOT}
    coming = comings.clients[ROBOT]
    assert (coming.up, coming.why, coming.address, coming.sessions, coming.waited_for) == (
        False, "gone", "192.0.2.1:4", 1, False,
    )  # fmt: skip
    assert [event["kind"] for event in events.after(0) if event["about"] == ROBOT] == [CONNECTED, AWAY, FORGOTTEN]


def test_a_takeover_is_another_event_than_what_the_rules_forbid(said: pytest.LogCaptureFixture) -> None:
    events = EventLog()
    comings = Comings(events)
    comings.up(ROBOT, resumed=False)
    comings.refused(ROBOT, "displaced", "another process connected as robot")
    comings.refused(ROBOT, "forbidden", "robot may not publish /x")
    assert [event["kind"] for event in events.after(0)] == [CONNECTED, TAKEOVER, DENIED]
    assert comings.clients[ROBOT].takeovers == 1
    assert said.messages[1:] == ["robot: another process connected as robot", "robot: robot may not publish /x"]


def errors(said: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in said.records if record.levelno == logging.ERROR]


def test_sessions_that_begin_at_two_relays_in_turn_are_two_processes(
    said: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = EventLog()
    comings = Comings(events, relay="hub1")
    for turn in range(TURNS + 3):
        monkeypatch.setattr(clock, "now", lambda turn=turn: 100.0 + 10.0 * turn)
        comings.went_over(ROBOT, "hub2", came=turn % 2 == 0)
        assert comings.takeovers == max(0, turn + 1 - TURNS)
    assert errors(said) == [
        "robot: its sessions begin at the relays hub1 and hub2 in turn, 4 times in 30 s: two processes have one name "
        "and key; give each its own"
    ]
    assert comings.clients[ROBOT].takeovers == 3
    (event,) = (each for each in events.after(0) if each["kind"] == TAKEOVER)
    assert event["about"] == ROBOT and event["relay"] == "hub2"
    monkeypatch.setattr(clock, "now", lambda: 100.0 + 10.0 * TURNS + TURN_S)
    comings.went_over(ROBOT, "hub2", came=True)
    assert len(errors(said)) == 2, "it is said again while it goes on"


def test_a_client_that_goes_over_and_back_is_one_process(
    said: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    comings = Comings(relay="hub1")
    for at_s in (0.0, 5.0, 10.0, TURN_S + 1.0, TURN_S + 6.0):
        monkeypatch.setattr(clock, "now", lambda at_s=at_s: at_s)
        comings.went_over(ROBOT, "hub2", came=True)
    assert not said.messages and comings.takeovers == 0 and comings.clients[ROBOT].takeovers == 0


def test_two_processes_at_one_relay_are_an_error_when_they_go_on(
    said: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clock, "now", lambda: 100.0)
    comings = Comings(relay="hub1")
    for count in range(1, TURNS + 2):
        comings.refused(ROBOT, "displaced", "another process connected as robot")
        assert comings.takeovers == count
    (error,) = errors(said)
    assert error.startswith("robot: two processes take its session at hub1 from each other, 4 times in 0 s")
