"""The table of goals is bounded in every way."""

from typing import NamedTuple

from hypothesis import given
from hypothesis import strategies as st

from sern_client.action_conversion.goals import GoalTable
from sern_client.actions import GoalId


class Goal(NamedTuple):
    uuid: bytes
    text: str

    @property
    def ident(self) -> GoalId:
        return GoalId(0, 0, self.text)


def goal(number: int, text: str | None = None) -> Goal:
    return Goal(b"%016d" % number, f"goal {number}" if text is None else text)


def table(keep_s: float = 10.0) -> GoalTable[Goal]:
    return GoalTable(keep_s, max_live=3, max_goals=5, max_result_bytes=100)


def test_a_goal_is_known_by_both_of_its_names_until_it_is_forgotten() -> None:
    goals = table()
    one = goal(1)
    assert goals.add(one) == "" and goals.live == [one]
    assert goals.of_uuid(one.uuid) is one and goals.of_text("goal 1") is one
    goals.end(one, 7, now=100.0)
    assert goals.live == [] and goals.has_ended(one) and goals.due_s == 110.0
    goals.end(one, 7, now=105.0)  # once is all
    assert not goals.expire(now=109.9) and goals.of_text("goal 1") is one
    assert goals.expire(now=110.0) and goals.of_text("goal 1") is None and goals.of_uuid(one.uuid) is None
    assert goals.has_ended(one) and len(goals) == 0
    assert table().due_s is None


def test_a_goal_that_is_under_way_is_not_taken_twice_and_one_that_ended_makes_room() -> None:
    goals = table()
    assert goals.add(goal(1)) == ""
    for again in (goal(1), goal(1, "other"), goal(2, "goal 1")):
        assert goals.add(again) == "a goal of that id is under way"
    assert len(goals) == 1
    first = goals.live[0]
    goals.end(first, now=0.0)
    again = goal(2, "goal 1")
    assert goals.add(again) == "" and goals.of_text("goal 1") is again and len(goals) == 1
    assert goals.has_ended(first) and not goals.has_ended(again)


def test_only_so_many_are_under_way_and_the_oldest_ended_go_first() -> None:
    goals = table()
    for number in range(3):
        assert goals.add(goal(number)) == ""
    assert goals.add(goal(3)) == "3 goals are under way already"
    for each in goals.live[:2]:
        goals.end(each, now=0.0)
    for number in (4, 5):
        assert goals.add(goal(number)) == ""
    assert len(goals) == 5
    goals.end(goals.live[0], now=1.0)
    assert goals.add(goal(6)) == ""
    assert len(goals) == 5 and goals.of_text("goal 0") is None and goals.of_text("goal 1") is not None


def test_large_results_push_out_the_oldest_and_the_newest_stays() -> None:
    goals = table()
    for number in range(3):
        goals.add(goal(number))
    for each in goals.live:
        goals.end(each, 50, now=0.0)
    assert [each.text for each in goals] == ["goal 1", "goal 2"]
    goals.add(goal(3))
    goals.end(goals.live[0], 1000, now=0.0)
    assert [each.text for each in goals] == ["goal 3"]


@given(st.lists(st.tuples(st.sampled_from("aaeex"), st.integers(0, 6), st.integers(0, 6)), max_size=60))
def test_whatever_happens_it_stays_within_its_bounds(steps: list[tuple[str, int, int]]) -> None:
    goals = table()
    for now, (what, number, other) in enumerate(steps):
        if what == "a":
            goals.add(goal(number, f"goal {other}"))
        elif what == "e" and goals.live:
            goals.end(goals.live[number % len(goals.live)], 20 * other, now=float(now))
        elif what == "x":
            goals.expire(now=float(now))
        assert len(goals) <= 5 and len(goals.live) <= 3
        assert goals.busy == bool(goals.live)
        for each in goals:
            assert goals.of_uuid(each.uuid) is each and goals.of_text(each.text) is each
    goals.expire(now=1000.0)
    assert list(goals) == goals.live
