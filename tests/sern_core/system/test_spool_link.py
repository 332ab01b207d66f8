"""What is fetched delays nothing that is live by more than a datagram, uses the rest of the link, and comes once."""

import pytest

from tests.spool_link import COMMAND, POSE, ThinPath, idle_share, play


def p99(found_s: list[float]) -> float:
    return found_s[int(0.99 * len(found_s))]


@pytest.mark.parametrize(
    ("path", "clouds"),
    [
        (ThinPath(1e6, 0.05), True),
        (ThinPath(1e6, 0.05, loss=0.01), True),
        (ThinPath(256e3, 0.1), False),
        (ThinPath(1e6, 0.05), False),
        (ThinPath(4e6, 0.025), False),
    ],
)
def test_a_fetch_takes_what_is_free_of_a_thin_link_and_nothing_else(path: ThinPath, clouds: bool) -> None:
    """Also where nothing live fills the link: a pose meets an empty one then, but for one datagram of the fetch."""
    alone, beside = play(path, fetch=False, clouds=clouds), play(path, fetch=True, clouds=clouds)
    for topic in (POSE, COMMAND):
        assert p99(beside.ages_s(topic)) <= p99(alone.ages_s(topic)) + 1.05 * path.datagram_s
        assert len(beside.ages_s(topic)) >= 0.99 * len(alone.ages_s(topic))
    assert idle_share(alone, beside) >= 0.8
    assert beside.fetched == list(range(1, len(beside.fetched) + 1))
    beside.site.world.validate()


def test_a_fetch_ends_with_everything_once() -> None:
    run = play(ThinPath(4e6, 0.025, loss=0.02), fetch=True, messages=500)
    assert run.fetched == list(range(1, 501))
