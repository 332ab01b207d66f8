"""What a site asks of what a robot has kept: every message once, none that may still come live, until nothing lacks."""

from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.site.spool import (
    ALWAYS,
    MAX_ASKED,
    MAX_REQUESTS,
    MAX_RUNS,
    MAX_SPANS,
    SETTLE_S,
    Request,
    Span,
    TopicFetch,
    Window,
    decode_report,
    decode_request,
    encode_report,
    encode_request,
)
from sern_core.topics.spool_names import SpoolStream, SpoolStreamKind, fetch_name, fetched_name, kept_name, parse
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import ClientName, TopicName
from tests.exploring import cases

OLD, NEW = 11, 22
SECOND_NS = 10**9
NOW = 1000.0


def span(boot: int, first: int, last: int, *, reliable: bool = False, nbytes: int = 100) -> Span:
    """A message a second, each of `nbytes`."""
    count = last - first + 1
    return Span(boot, first, last, first * SECOND_NS, last * SECOND_NS, count, count * nbytes, reliable)


def settled(*spans: Span) -> TopicFetch:
    """What was said long ago, and again now."""
    fetch = TopicFetch(1)
    fetch.reported(spans, now=NOW - SETTLE_S)
    fetch.reported(spans, now=NOW)
    return fetch


def play(fetch: TopicFetch, kept: set[int], boot: int, windows: list[Window] | None = None) -> list[int]:
    """Answer whatever is asked from what is kept, and record it; returns the order."""
    got: list[int] = []
    while (request := fetch.ask(windows or [ALWAYS], now=NOW)) is not None:
        assert request.boot == boot
        for first, last in request.runs:
            for seq in range(first, last + 1):
                if seq in kept and request.from_ns <= seq * SECOND_NS <= request.to_ns:
                    assert fetch.accept(boot, seq)
                    fetch.recorded(boot, seq)
                    got.append(seq)
        assert fetch.done(request.number)
    return got


def test_what_is_missing_is_asked_for_once_the_oldest_first() -> None:
    fetch = settled(span(OLD, 1, 5), span(NEW, 1, 10))
    fetch.have(OLD, 2, 3)
    assert fetch.missing() == (13, 1300)
    first, second = fetch.ask([ALWAYS], now=NOW), fetch.ask([ALWAYS], now=NOW)
    assert first is not None and (first.boot, first.runs) == (OLD, ((1, 1), (4, 5)))
    assert second is not None and (second.boot, second.runs, second.oldest) == (NEW, ((1, 10),), first.number)
    assert fetch.ask([ALWAYS], now=NOW) is None


@settings(max_examples=cases(60), deadline=None)
@given(st.sets(st.integers(1, 4000)), st.sets(st.integers(1, 4000)))
def test_everything_that_is_kept_and_not_here_is_fetched_once(kept: set[int], here: set[int]) -> None:
    fetch = settled(span(OLD, 1, 4000), span(NEW, 1, 1))
    fetch.have(NEW, 1, 1)
    for seq in here:
        fetch.have(OLD, seq, seq)
    assert play(fetch, kept, OLD) == sorted(kept - here)
    assert fetch.missing() == (0, 0)
    assert fetch.gone == 4000 - len(kept | here)


def test_what_may_still_come_live_is_not_asked_for() -> None:
    fetch = TopicFetch(1)
    fetch.began(NEW)
    fetch.reported([span(NEW, 1, 10)], now=NOW)
    assert fetch.ask([ALWAYS], now=NOW) is None
    fetch.reported([span(NEW, 1, 20)], now=NOW + SETTLE_S - 1.0)
    assert fetch.ask([ALWAYS], now=NOW + SETTLE_S - 1.0) is None
    request = fetch.ask([ALWAYS], now=NOW + SETTLE_S)
    assert request is not None and request.runs == ((1, 10),)


def test_of_a_reliable_topic_only_what_a_later_message_has_overtaken_is_asked_for() -> None:
    """It comes in order, however late: up to its newest message here nothing can come live any more."""
    fetch = settled(span(NEW, 1, 100, reliable=True))
    fetch.began(NEW)
    assert fetch.ask([ALWAYS], now=NOW) is None
    fetch.have(NEW, 1, 10)
    fetch.have(NEW, 20, 20)
    request = fetch.ask([ALWAYS], now=NOW)
    assert request is not None and request.runs == ((11, 19),)


def test_only_what_was_asked_for_is_taken_and_nothing_twice() -> None:
    fetch = settled(span(OLD, 1, 5), span(NEW, 1, 1))
    assert not fetch.accept(OLD, 1)
    assert fetch.ask([ALWAYS], now=NOW) is not None
    assert fetch.accept(OLD, 1) and not fetch.accept(OLD, 1)
    fetch.recorded(OLD, 1)
    assert not fetch.accept(OLD, 1) and not fetch.accept(OLD, 6) and not fetch.accept(33, 2)


def test_what_was_lost_on_its_way_or_at_the_disk_is_asked_for_again() -> None:
    fetch = settled(span(OLD, 1, 5), span(NEW, 1, 1))
    fetch.have(NEW, 1, 1)
    request = fetch.ask([ALWAYS], now=NOW)
    assert request is not None
    assert fetch.accept(OLD, 1)
    fetch.recorded(OLD, 1)
    assert fetch.accept(OLD, 2)
    fetch.lost(OLD, 2)
    fetch.torn()
    assert fetch.done(request.number) and not fetch.done(request.number)
    assert play(fetch, {1, 2, 3, 4, 5}, OLD) == [2, 3, 4, 5]
    assert fetch.gone == 0


def test_a_window_asks_for_its_stamps_alone_and_ends() -> None:
    fetch = settled(span(OLD, 1, 3000), span(NEW, 1, 1))
    wanted = Window(100 * SECOND_NS, 200 * SECOND_NS)
    assert not fetch.answered(wanted, now=NOW)
    assert play(fetch, set(range(1, 3001)), OLD, [wanted]) == list(range(100, 201))
    assert fetch.answered(wanted, now=NOW)
    assert fetch.missing(ALWAYS).messages == 2900
    assert fetch.gone == 0  # what lies outside was not looked for


def test_a_request_is_bounded_and_so_are_those_under_way() -> None:
    fetch = settled(span(OLD, 1, 10**6), span(NEW, 1, 1))
    for seq in range(2, 2000, 2):
        fetch.have(OLD, seq, seq)
    requests = [fetch.ask([ALWAYS], now=NOW) for _ in range(MAX_REQUESTS + 1)]
    assert requests[-1] is None
    for request in requests[:-1]:
        assert request is not None and len(request.runs) <= MAX_RUNS
        assert sum(last - first + 1 for first, last in request.runs) <= MAX_ASKED
        assert decode_request(encode_request(request)) == request


def test_what_the_robot_has_no_more_is_forgotten() -> None:
    fetch = settled(span(OLD, 1, 10), span(NEW, 1, 10))
    fetch.have(OLD, 1, 10)
    fetch.have(NEW, 1, 3)
    fetch.reported([span(NEW, 3, 12)], now=NOW)
    assert {boot: list(runs) for boot, runs in fetch.had()} == {NEW: [(3, 3)]}


def test_reports_and_requests_come_back_as_they_were_and_nothing_else_is_one() -> None:
    spans = tuple(span(boot, boot, boot + 5) for boot in range(1, MAX_SPANS + 1))
    assert decode_report(encode_report(spans)) == spans
    assert decode_report(encode_report((*spans, span(99, 1, 2))))[-1].boot == 99
    assert decode_report(b"") == ()
    request = Request(7, 5, OLD, -5, 10**18, ((1, 2), (4, 4)))
    assert decode_request(encode_request(request)) == request
    for bad in (
        b"x",
        encode_report([span(0, 1, 2)]),
        encode_report([span(5, 3, 2)]),
        encode_report([span(5, 1, 2)] * 2),
    ):
        with pytest.raises(WireError):
            decode_report(bad)
    for runs in (
        (),
        ((4, 4), (1, 2)),
        ((0, 1),),
        ((1, 2**63),),
        ((1, 2),) * 2,
        tuple((2 * i, 2 * i) for i in range(1, 200)),
    ):
        with pytest.raises(WireError):
            decode_request(encode_request(request._replace(runs=runs)))


@settings(max_examples=cases(200))
@given(st.binary(max_size=300))
def test_any_bytes_are_a_report_and_a_request_or_refused(body: bytes) -> None:
    for decode in (decode_report, decode_request):
        try:
            decode(body)
        except WireError:
            continue


def test_a_robot_that_says_anything_costs_little() -> None:
    """It claims to have kept what nobody can count: requests stay as small and as few."""
    fetch = settled(Span(OLD, 1, 2**62, -(2**63), 2**63 - 1, 2**63, 2**63, False), span(NEW, 1, 1))
    random = Random(1)
    for _ in range(200):
        request = fetch.ask([ALWAYS], now=NOW)
        if request is None or random.random() < 0.5:
            fetch.forget_requests()
            continue
        assert sum(last - first + 1 for first, last in request.runs) <= MAX_ASKED
        fetch.done(request.number)
    assert sum(len(runs) for _boot, runs in fetch.had()) <= 2


def test_names_have_their_parts() -> None:
    topic, site = TopicName("/robot1/points"), ClientName("site1")
    assert parse(kept_name(topic)) == SpoolStream(topic, SpoolStreamKind.KEPT, ClientName(""))
    assert parse(fetch_name(topic, site)) == SpoolStream(topic, SpoolStreamKind.FETCH, site)
    assert parse(fetched_name(topic, site)) == SpoolStream(topic, SpoolStreamKind.FETCHED, site)
    for name in ("/robot1/points", "/_kept", "/robot1/_fetch", "/robot1/points/_fetch/Site", "/robot1/points/_kept/x"):
        assert parse(TopicName(name)) is None
