"""Counts of clients that were given up stay for those who look now and then, and have bounds."""

from sern_core.relay.given_up import KEPT_S, GivenUp
from sern_core.vocabulary.ledger import SendCounters
from sern_core.vocabulary.types import ClientName, DropReason, PriorityClass, TopicName

SITE, OTHER = ClientName("site"), ClientName("other")


def counters(topic: str, reason: DropReason | None = None, *, unconfirmed: int = 0) -> SendCounters:
    found = SendCounters(TopicName(topic), PriorityClass.STATE)
    if reason is not None:
        found.drop(reason, 10)
    found.reliable_unconfirmed = unconfirmed
    return found


def kept(given: GivenUp) -> list[tuple[str, str]]:
    return [(client, each.topic) for client, each in given.counters()]


def test_only_losses_are_kept_until_the_client_is_back() -> None:
    given = GivenUp()
    rows = [
        counters("/lost", DropReason.DISCONNECTED),
        counters("/perhaps", DropReason.UNCONFIRMED, unconfirmed=1),
        counters("/stale", DropReason.SUPERSEDED),
        counters("/well"),
    ]
    given.keep(SITE, rows, now=0.0)
    given.keep(OTHER, rows[2:], now=0.0)
    assert kept(given) == [("site", "/lost"), ("site", "/perhaps")]
    given.back(OTHER)
    given.back(SITE)
    assert kept(given) == []


def test_they_are_forgotten_after_an_hour() -> None:
    given = GivenUp()
    given.keep(SITE, [counters("/a", DropReason.RETENTION)], now=0.0)
    given.keep(OTHER, [counters("/b", DropReason.RETENTION)], now=10.0)
    given.sweep(now=KEPT_S + 1.0)
    assert kept(given) == [("other", "/b")]


def test_too_many_topics_cost_the_client_that_was_given_up_first() -> None:
    given = GivenUp(max_kept=3)
    rows = [counters(f"/{number}", DropReason.SHUTDOWN) for number in range(5)]
    given.keep(SITE, rows[:2], now=0.0)
    given.keep(OTHER, rows[:2], now=1.0)
    assert kept(given) == [("other", "/0"), ("other", "/1")]
    given.keep(SITE, rows, now=2.0)
    assert kept(given) == [("site", "/0"), ("site", "/1"), ("site", "/2")]
    given.keep(SITE, rows[:1], now=3.0)
    given.keep(OTHER, rows[:2], now=4.0)
    assert len(kept(given)) == 3
