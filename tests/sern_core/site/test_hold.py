"""Who of several operators commands a robot."""

import pytest

from sern_core.site.hold import ASKED_S, MAX_ASKED, MAX_REFUSED, Hold
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import ClientName

ANNA, BERT, CARL = ClientName("anna"), ClientName("bert"), ClientName("carl")
LAPSE_S = 5.0


def holder(hold: Hold) -> ClientName | None:
    return hold.holder


def asked(hold: Hold) -> tuple[ClientName, ...]:
    return hold.asked


def held(now: float = 10.0) -> Hold:
    """A robot that anna commands and bert would like to."""
    hold = Hold(LAPSE_S)
    assert hold.command(ANNA, now=now) and not hold.command(BERT, now=now)
    return hold


def test_who_commands_first_holds_it_while_commands_come() -> None:
    hold = held()
    for number in range(100):
        now = 10.0 + number * LAPSE_S
        assert hold.command(ANNA, now=now) and not hold.command(BERT, now=now)
    assert holder(hold) == ANNA and hold.changes == 1


def test_a_silent_holder_lets_go_and_whoever_was_refused_does_not_drive_off() -> None:
    hold = held()
    hold.look(now=10.0 + LAPSE_S)
    assert holder(hold) == ANNA
    assert not hold.command(BERT, now=10.1 + LAPSE_S) and holder(hold) is None
    hold.ask(BERT, now=16.0)
    assert holder(hold) == BERT and hold.command(BERT, now=16.0) and not hold.command(ANNA, now=16.0)


def test_the_holder_that_lapsed_and_somebody_new_may_go_on_by_commanding() -> None:
    hold = held()
    assert hold.command(ANNA, now=30.0) and holder(hold) == ANNA
    assert hold.command(CARL, now=40.0) and holder(hold) == CARL
    hold.ended(BERT)
    assert hold.command(BERT, now=50.0), "his commands have ended, and he begins anew"


def test_it_is_given_to_who_asked_first_and_by_the_holder_alone() -> None:
    hold = held()
    hold.ask(BERT, now=11.0)
    hold.ask(CARL, now=12.0)
    assert asked(hold) == (BERT, CARL) and holder(hold) == ANNA
    for other in (BERT, CARL):
        with pytest.raises(UsageError, match="does not hold it"):
            hold.give(other, now=12.0)
    hold.give(ANNA, now=12.0)
    assert holder(hold) == BERT and asked(hold) == (CARL,) and not hold.command(ANNA, now=12.0)
    hold.command(BERT, now=12.0)
    hold.give(BERT, now=13.0)
    hold.give(CARL, now=13.0)
    assert holder(hold) is None and asked(hold) == ()


def test_force_takes_it_and_a_lapse_gives_it_to_who_waits() -> None:
    hold = held()
    hold.force(BERT, now=11.0)
    assert holder(hold) == BERT and hold.command(BERT, now=11.0) and not hold.command(ANNA, now=11.0)
    hold.ask(ANNA, now=12.0)
    hold.look(now=11.1 + LAPSE_S)
    assert holder(hold) == ANNA and asked(hold) == ()


def test_what_is_remembered_has_a_bound_and_an_end() -> None:
    hold = held()
    for number in range(200):
        who = ClientName(f"c{number}")
        hold.ask(who, now=10.0)
        hold.command(who, now=10.0)
    assert len(asked(hold)) == MAX_ASKED
    hold.command(ANNA, now=10.0 + LAPSE_S)
    for number in range(1, 20):
        hold.command(ANNA, now=10.0 + number * LAPSE_S / 2)
    hold.look(now=10.1 + ASKED_S)
    assert asked(hold) == () and MAX_REFUSED < 200


def test_each_change_is_counted_and_nothing_else() -> None:
    hold = held()
    seen = [hold.changes]
    for now in (11.0, 12.0):
        hold.command(ANNA, now=now)
        hold.ask(BERT, now=now)
        seen.append(hold.changes)
    assert seen == [1, 2, 2]
