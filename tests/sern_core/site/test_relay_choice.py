"""When a client leaves a relay for another one, and for which."""

import pytest

from sern_core.site.relay_choice import MAX_LOOK_S, Move, MoveReason, RelayChoice

LOOK_S = 0.5


def choice_of(count: int, *, failover_s: float = 2.0, return_s: float = 300.0) -> RelayChoice:
    return RelayChoice([10.0] * count, failover_s=failover_s, return_s=return_s, now=0.0)


def look_on(
    choice: RelayChoice, now: float, until_s: float, *, answers: bool = False, letting_in: bool = False
) -> tuple[float, Move | None]:
    """Look twice a second until there is something to do, or until then; when that was."""
    while now < until_s:
        now += LOOK_S
        move = choice.look(now, answers=answers, letting_in=letting_in)
        if move is not None:
            return now, move
    return now, None


def test_a_relay_that_answers_is_stayed_at() -> None:
    choice = choice_of(3)
    assert look_on(choice, 0.0, 1000.0, answers=True) == (1000.0, None)
    assert choice.at == 0 and choice.silent_s == 0.0


def test_a_silent_relay_is_left_for_the_next_one_and_the_last_for_the_first() -> None:
    choice = choice_of(3)
    now, visited = 0.0, []
    for _ in range(4):
        began_s = now
        now, move = look_on(choice, now, now + 100.0)
        assert move is not None and move.reason is MoveReason.SILENT and now - began_s == 2.0
        visited.append(move.to)
        choice.moved(move.to, now)
    assert visited == [1, 2, 0, 1]


def test_an_answer_in_between_is_an_answer() -> None:
    choice = choice_of(2)
    now, move = look_on(choice, 0.0, 1.5)
    assert move is None
    now, move = look_on(choice, now, 2.0, answers=True)
    assert look_on(choice, now, 3.5) == (3.5, None)
    assert look_on(choice, 3.5, 100.0) == (4.0, Move(1, MoveReason.SILENT))


def test_a_single_relay_is_waited_for_for_ever() -> None:
    assert look_on(choice_of(1), 0.0, 10_000.0)[1] is None


@pytest.mark.parametrize(("failover_s", "left_s"), [(2.0, 10.0), (30.0, 30.0)])
def test_a_relay_that_lets_a_connection_in_has_longer(failover_s: float, left_s: float) -> None:
    """Four round trips of a satellite take longer than a relay that is there may be silent."""
    choice = choice_of(2, failover_s=failover_s)
    assert look_on(choice, 0.0, 100.0, letting_in=True) == (left_s, Move(1, MoveReason.SILENT))


def test_who_fails_to_let_it_in_is_left_as_soon_as_any_other() -> None:
    choice = choice_of(2)
    now, move = look_on(choice, 0.0, 5.0, letting_in=True)
    assert move is None
    assert choice.look(now, answers=False, letting_in=False) == Move(1, MoveReason.SILENT)


@pytest.mark.parametrize("stood_still_s", [5.0, 3600.0])
def test_of_a_process_that_stood_still_no_relay_was_silent(stood_still_s: float) -> None:
    choice = choice_of(2)
    choice.look(0.5, answers=True, letting_in=False)
    now = 0.5 + stood_still_s
    assert choice.look(now, answers=False, letting_in=False) is None
    assert choice.silent_s == MAX_LOOK_S
    assert look_on(choice, now, now + 10.0) == (now + 1.0, Move(1, MoveReason.SILENT))


def test_a_clock_that_goes_back_is_no_silence() -> None:
    choice = choice_of(2)
    choice.look(10.0, answers=True, letting_in=False)
    assert choice.look(5.0, answers=False, letting_in=False) is None
    assert choice.silent_s == 0.0


def asked(choice: RelayChoice, now: float, until_s: float, *places: int) -> tuple[float, Move | None]:
    """These relays answer twice a second, and so does the one that the client is at."""
    while now < until_s:
        now += LOOK_S
        for place in places:
            choice.answered(place, now)
        move = choice.look(now, answers=True, letting_in=False)
        if move is not None:
            return now, move
    return now, None


def at(place: int, count: int = 3) -> RelayChoice:
    choice = choice_of(count)
    choice.moved(place, 0.0)
    return choice


def test_it_returns_when_the_preferred_one_has_answered_for_so_long() -> None:
    choice = at(1)
    assert list(choice.better) == [0]
    assert asked(choice, 0.0, 1000.0, 0) == (300.5, Move(0, MoveReason.RETURN))
    choice.moved(0, 300.5)
    assert list(choice.better) == [] and choice.answering_s(0, 300.5) is None


def test_an_interruption_begins_the_time_anew() -> None:
    choice = at(1)
    now, move = asked(choice, 0.0, 299.0, 0)
    assert move is None and choice.answering_s(0, now) == 298.5
    now, move = asked(choice, now, now + 3.0)
    assert move is None and choice.answering_s(0, now) is None
    assert asked(choice, now, 1000.0, 0) == (now + 300.5, Move(0, MoveReason.RETURN))


def test_an_answer_that_is_late_within_what_is_allowed_is_no_interruption() -> None:
    choice = at(1)
    now, _ = asked(choice, 0.0, 299.0, 0)
    now, _ = asked(choice, now, now + 1.5)
    assert asked(choice, now, 1000.0, 0) == (301.0, Move(0, MoveReason.RETURN))


def test_the_first_of_those_that_answer_is_the_one_to_return_to() -> None:
    choice = at(2)
    assert list(choice.better) == [0, 1]
    now, move = asked(choice, 0.0, 1000.0, 1)
    assert move == Move(1, MoveReason.RETURN)
    choice.moved(1, now)
    assert asked(choice, now, now + 1000.0, 0)[1] == Move(0, MoveReason.RETURN)
    both = at(2)
    assert asked(both, 0.0, 1000.0, 0, 1)[1] == Move(0, MoveReason.RETURN)


def test_one_that_is_left_behind_by_a_peer_follows_where_a_preferred_relay_answers() -> None:
    choice = at(2)
    assert choice.look(0.5, answers=True, letting_in=False, left_behind=True) is None, "nobody says where it has gone"
    choice.answered(1, 1.0)
    assert choice.look(1.0, answers=True, letting_in=False) is None
    assert choice.look(1.5, answers=True, letting_in=False, left_behind=True) == Move(1, MoveReason.FOLLOW)
    assert choice.look(4.0, answers=True, letting_in=False, left_behind=True) is None, "it does not answer any more"


def test_who_has_answered_before_a_move_has_to_do_so_anew() -> None:
    choice = at(1)
    now, _ = asked(choice, 0.0, 200.0, 0)
    choice.moved(2, now)
    assert choice.answering_s(0, now) is None
    assert asked(choice, now, 1000.0, 0) == (now + 300.5, Move(0, MoveReason.RETURN))


def test_when_the_one_that_it_is_at_fails_meanwhile_it_goes_on_to_the_next() -> None:
    choice = at(1)
    now, _ = asked(choice, 0.0, 100.0, 0)
    assert look_on(choice, now, 200.0) == (now + 2.0, Move(2, MoveReason.SILENT))
