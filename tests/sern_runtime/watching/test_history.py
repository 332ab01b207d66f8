"""The history of links: ten minutes, the worst of each step, and bounded."""

from sern_runtime.watching.history import POINTS, LinkHistory, Point
from tests.sern_runtime.watching.fakes import look


def points(history: LinkHistory, peer: str, since: int = -1) -> list[Point]:
    return dict(history.since(since)).get(peer, [])


def test_a_step_tells_of_its_worst_and_of_its_rates() -> None:
    history = LinkHistory(step_s=5.0)
    for second, (trip_s, loss, up) in enumerate([(0.05, 0.0, True), (0.4, 0.2, True), (0.06, 0.1, True)]):
        now = 100.0 + second
        history.note(look("robot", up=up, sent=1000 * second, received=500 * second, trip_s=trip_s, loss=loss), now=now)
        history.advance(now=now)
    assert points(history, "robot") == [], "the step is not over"
    history.note(look("robot", up=False, sent=9000, received=2500), now=105.0)
    history.advance(now=105.0)
    (point,) = points(history, "robot")
    assert point == Point(20, True, 1e6, 0.4, 0.2, 8 * 1000.0, 8 * 500.0)
    history.note(look("robot", sent=9000, received=2500), now=110.0)
    history.advance(now=110.0)
    (_first, second_point) = points(history, "robot")
    assert second_point.up is False
    assert second_point.sent_bps == 8 * 7000 / 3.0, "from the end of the step before on"
    assert points(history, "robot", since=20) == [second_point]
    assert points(history, "robot", since=21) == []


def test_totals_that_begin_anew_make_no_negative_rate() -> None:
    history = LinkHistory(step_s=1.0)
    for now, sent in ((0.0, 1000), (0.5, 10), (1.0, 20)):
        history.note(look("robot", sent=sent), now=now)
    history.advance(now=1.0)
    assert [point.sent_bps for point in points(history, "robot")] == [0.0]


def test_of_a_link_that_is_not_there_any_more_what_was_stays_for_ten_minutes() -> None:
    history = LinkHistory(step_s=1.0)
    history.note(look("robot"), now=0.0)
    history.advance(now=0.0)
    history.advance(now=1.0)
    assert [point.number for point in points(history, "robot")] == [0]
    history.advance(now=float(POINTS))
    assert [point.number for point in points(history, "robot")] == [0]
    history.advance(now=POINTS + 1.0)
    assert points(history, "robot") == []


def test_points_and_links_are_bounded_and_what_is_left_out_is_counted() -> None:
    history = LinkHistory(step_s=1.0, max_links=3)
    for step in range(3 * POINTS):
        for peer in ("a", "b", "c", "d", "e"):
            history.note(look(peer), now=float(step))
        history.advance(now=float(step))
    assert history.left_out == 2
    told = dict(history.since(-1))
    assert {peer: len(kept) for peer, kept in told.items()} == dict.fromkeys(("a", "b", "c"), POINTS)
    assert [point.number for point in told["a"]] == list(range(2 * POINTS - 1, 3 * POINTS - 1))


def test_a_clock_that_goes_on_while_nothing_runs_leaves_a_gap() -> None:
    """The machine slept: the pictures show when, and no rate is made up for it."""
    history = LinkHistory(step_s=5.0)
    for now, sent in ((0.0, 0), (4.0, 400), (300.0, 500), (304.0, 900), (305.0, 1000)):
        history.note(look("robot", sent=sent), now=now)
        history.advance(now=now)
    assert [(point.number, point.sent_bps) for point in points(history, "robot")] == [(0, 800.0), (60, 800.0)]
