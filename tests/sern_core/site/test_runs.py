"""Runs of numbers: the same as a set of them, whatever is done."""

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.site.runs import Runs
from tests.exploring import cases

NUMBERS = st.integers(1, 60)
RUNS = st.tuples(NUMBERS, st.integers(0, 12)).map(lambda pair: (pair[0], pair[0] + pair[1]))
STEPS = st.lists(st.tuples(st.sampled_from(["add", "below", "shed", "remove"]), RUNS), max_size=30)


def numbers(runs: Runs) -> set[int]:
    return {number for first, last in runs for number in range(first, last + 1)}


@settings(max_examples=cases(200))
@given(STEPS, RUNS)
def test_runs_are_the_set_of_their_numbers(steps: list[tuple[str, tuple[int, int]]], asked: tuple[int, int]) -> None:
    runs, model = Runs(), set[int]()
    for step, (first, last) in steps:
        if step == "add":
            new = runs.add(first, last)
            assert new == len(set(range(first, last + 1)) - model)
            model |= set(range(first, last + 1))
        elif step == "remove":
            runs.remove(first)
            model.discard(first)
        elif step == "below":
            runs.remove_below(first)
            model = {number for number in model if number >= first}
        else:
            most = 1 + first % 5
            before = set(model)
            gained = runs.shed(most)
            model = numbers(runs)
            assert len(runs) <= most and before <= model and gained == len(model - before)
            assert not model or max(model) == max(before)
        pairs = list(runs)
        assert numbers(runs) == model and runs.count == len(model) and runs.last == max(model, default=0)
        assert all(one[1] + 1 < other[0] for one, other in itertools.pairwise(pairs))
    first, last = asked
    inside = set(range(first, last + 1))
    assert runs.within(first, last) == len(model & inside)
    gaps = [number for low, high in runs.gaps(first, last) for number in range(low, high + 1)]
    assert gaps == sorted(inside - model)
    assert all((number in runs) is (number in model) for number in inside)
