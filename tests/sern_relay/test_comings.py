"""Who comes and goes, in the log."""

import logging
from types import SimpleNamespace
from typing import Any

import pytest

from sern_core.vocabulary.types import ClientName
from sern_relay.comings import Comings
from sern_runtime import clock
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
