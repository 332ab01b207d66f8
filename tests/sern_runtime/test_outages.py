"""Losses and recoveries are said in pairs, and only those that last."""

import logging

import pytest

from sern_runtime.outages import Outages


def look(outages: Outages, times_s: dict[float, bool]) -> None:
    for now, lost in times_s.items():
        outages.look("a", lost=lost, gone="a is silent", back="a is back", now=now)


@pytest.mark.parametrize(
    ("times_s", "said"),
    [
        ({0: False, 1: True, 2: True, 3: False}, []),  # too short to be news
        ({1: True, 3: True, 4: True, 9: True, 11: False, 12: False}, ["a is silent", "a is back, after 10 s"]),
        ({1: True, 4: True, 5: False, 6: True, 8: False}, ["a is silent", "a is back, after 4 s"]),
    ],
)
def test_pairs(times_s: dict[float, bool], said: list[str], caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    look(Outages(logging.getLogger("test"), logging.INFO), times_s)
    assert caplog.messages == said
    assert {record.levelno for record in caplog.records} <= {logging.INFO}


def test_what_ended_otherwise_is_not_said_to_be_back(caplog: pytest.LogCaptureFixture) -> None:
    outages = Outages(logging.getLogger("test"), logging.WARNING)
    look(outages, {1: True, 4: True})
    outages.forget("b")
    outages.forget("a")
    look(outages, {5: False})
    assert caplog.messages == ["a is silent"]
