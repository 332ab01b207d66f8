"""The modes of the window from delay and rate, and what leads from one to another."""

import pytest

from sern_core.path.congestion.mode import MODES, STARTUP, TRANSITIONS, Event, Mode


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_is_left_for_start_up_when_the_link_may_be_another(mode: Mode) -> None:
    assert TRANSITIONS[Event.RESTART][mode] is STARTUP


def test_every_event_has_its_transitions_and_every_mode_can_be_reached() -> None:
    assert TRANSITIONS.keys() == set(Event)
    reached = {after for table in TRANSITIONS.values() for after in table.values()}
    assert reached == set(MODES)


def test_each_event_changes_one_thing_about_the_mode() -> None:
    """Whether it starts, makes way or competes; only to start again ends all three."""
    assert len(set(MODES)) == len(MODES)
    for event in set(Event) - {Event.RESTART}:
        changes = {
            tuple(one - other for one, other in zip(after, before, strict=True))
            for before, after in TRANSITIONS[event].items()
        }
        assert len(changes) == 1 and sum(map(abs, next(iter(changes)))) == 1
