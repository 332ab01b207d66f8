"""The screen of `sern top`: never wider than the terminal, nothing in it that steers one, what is wrong first."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_runtime.watching.state import Choice, LinkLine, TopicLine, View
from sern_tools.top_text import Line, ago, count, fit, fit_end, in_colour, length, plain, screen, whole
from tests.exploring import cases

API = "http://127.0.0.1:5581"


def link(peer: str = "relay", state: str = "connected", **fields: Any) -> LinkLine:
    values: dict[str, Any] = {
        "why": "", "lane": "udp", "capacity_bps": 1.5e6, "round_trip_s": 0.09, "loss": 0.001, "waiting_bytes": 147_000,
        "sent_bytes": 9_000_000, "sent_bytes_per_s": 177_500.0, "received_bytes": 5, "received_bytes_per_s": 1.0,
        "since_s": 12.0, "heard_s": 0.1,
    }  # fmt: skip
    return LinkLine(peer, state, **(values | fields))


def topic(name: str, priority: str = "bulk", level: str = "ok", why: str = "", **fields: Any) -> TopicLine:
    values: dict[str, Any] = {
        "hz": 9.8, "messages": 1234, "bytes_per_s": 177_000.0, "bytes": 5_000_000, "age_s": 0.12, "drops_hz": 0.0,
        "drops": 0, "reasons": {}, "reasons_hz": {},
    }  # fmt: skip
    return TopicLine(topic=name, priority=priority, level=level, why=why, **(values | fields))


def view(*topics: TopicLine, **fields: Any) -> View:
    values: dict[str, Any] = {
        "name": "jackal1", "role": "client", "time": "2026-01-31T12:34:56.789Z", "links": (link(),),
        "choices": (Choice("relay", "let in: bulk 50%; compressed: zstd", "costs 0.21 in place of 0.40"),),
        "peers": (), "topics": topics, "notes": (), "events": (),
    }  # fmt: skip
    return View(**(values | fields))


def text(lines: list[Line]) -> list[str]:
    return [in_colour(line, colour=False).rstrip() for line in lines]


ODOM = topic("/jackal1/odom", "control", hz=50.0, bytes_per_s=36_000.0)
POINTS = topic(
    "/jackal1/points", level="warn", why="only part of it fits the link: superseded 7.8/s", drops_hz=7.8, drops=1710
)
CAMERA = topic("/jackal1/camera", level="note", why="nobody subscribes to it", hz=0.0, bytes_per_s=0.0)


def test_at_80_columns_it_is_exactly_this() -> None:
    event = {"time": "2026-01-31T12:34:50.000Z", "kind": "connected", "text": "tcp://relay:5555: connected"}
    lines = text(screen(view(ODOM, POINTS, CAMERA, events=(event,)), 80, 24, api=API))
    assert lines == [
        "client jackal1 at 127.0.0.1:5581                                       12:34:56Z",
        "link  relay connected 1.42 of 1.5 Mbit/s  rtt 90ms  loss 0.1%  udp  147kB wait",
        "conf  let in: bulk 50%; compressed: zstd (costs 0.21 in place of 0.40)",
        "class   topic                                        Hz   B/s   age drop/s drops",
        "control /jackal1/odom                              50.0   36k  0.1s",
        "bulk    /jackal1/points                             9.8  177k  0.1s    7.8  1710",
        "          ! only part of it fits the link: superseded 7.8/s",
        "        /jackal1/camera                           nobody subscribes to it",
        "12:34:50Z tcp://relay:5555: connected",
    ]


def test_a_narrow_terminal_leaves_out_ages_and_totals_and_a_wide_one_has_all() -> None:
    narrow = text(screen(view(ODOM, POINTS), 40))
    assert max(map(len, narrow)) <= 40
    assert any("Hz   B/s drop/s" in line for line in narrow)
    assert "/jackal1/odom" in " ".join(narrow)
    wide = text(screen(view(ODOM, POINTS), 140))
    assert any("Hz  msgs   B/s bytes   age drop/s drops" in line for line in wide)
    assert any("1234" in line and "5.0M" in line for line in wide)


def test_where_there_is_no_room_what_is_wrong_stays() -> None:
    well = [topic(f"/jackal1/t{number}", "control") for number in range(40)]
    lines = text(screen(view(*well, POINTS, CAMERA), 80, 24))
    assert len(lines) <= 24
    assert any("/jackal1/points" in line for line in lines)
    assert any("! only part of it fits the link" in line for line in lines)
    assert any(line.strip().startswith("and ") and "more topics" in line for line in lines)
    assert not any("/jackal1/camera" in line for line in lines)


def test_a_relay_shows_troubled_links_first_and_some_of_the_others() -> None:
    links = [link(f"robot{number}") for number in range(500)]
    links[300] = link("robot300", "away", why="its connection is gone", since_s=75.0)
    choices = tuple(Choice(each.peer, "everything is let in; compressed: lz4", "kept") for each in links)
    lines = text(screen(view(role="relay", links=tuple(links), choices=choices), 80, 24))
    assert lines[1] == "link  robot300 away      for 75s  its connection is gone"
    assert any("494 more, 494 of them connected" in line for line in lines)
    assert "conf  all 500 links: everything is let in" in lines
    assert len(lines) <= 24


def test_peers_that_are_gone_are_in_colour_and_said_why() -> None:
    peers = (link("jackal1", round_trip_s=0.1), link("jackal2", "away", why="the relay does not reach it"))
    lines = screen(view(peers=peers), 80)
    assert "peers connected: jackal1 100 ms" in text(lines)
    found = next(line for line in lines if "jackal2" in in_colour(line, colour=False))
    assert in_colour(found, colour=False).rstrip() == "      jackal2 gone for 12s: the relay does not reach it"
    assert "\x1b[1;31m" in in_colour(found, colour=True)


def test_no_link_says_why() -> None:
    down = link(state="away", why="the relay does not answer: connecting failed", round_trip_s=None)
    lines = text(screen(view(links=(down,)), 80))
    assert lines[1] == "link  relay away      for 12s  the relay does not answer: connecting failed"


def test_a_silent_link_says_when_it_was_last_heard() -> None:
    lines = text(screen(view(links=(link(state="silent", why="no acknowledgement comes", heard_s=7.2),)), 80))
    assert lines[1] == "link  relay silent    last heard 7.2s ago  udp  no acknowledgement comes"


def test_without_colour_nothing_is_escaped() -> None:
    lines = screen(view(ODOM, POINTS, CAMERA), 80)
    assert not any("\x1b" in in_colour(line, colour=False) for line in lines)
    assert any("\x1b[33m" in in_colour(line, colour=True) for line in lines)


words = st.text(max_size=120)
levels = st.sampled_from(["ok", "note", "warn", "bad"])
numbers = st.floats(min_value=0, max_value=1e13, allow_nan=False)
topics = st.builds(
    topic, words, st.sampled_from(["control", "state", "bulk", "?"]), levels, words, hz=numbers, bytes_per_s=numbers,
    age_s=st.none() | numbers, drops_hz=numbers, messages=st.integers(0, 10**15), bytes=st.integers(0, 10**18),
    drops=st.integers(0, 10**15),
)  # fmt: skip
links = st.builds(
    link, words, st.sampled_from(["connected", "silent", "away", "never", "forgotten", "unknown"]), why=words,
    capacity_bps=st.none() | numbers, round_trip_s=st.none() | numbers, loss=st.none() | st.floats(0, 1),
    since_s=st.none() | numbers, waiting_bytes=st.integers(0, 10**15), lane=st.none() | words,
)  # fmt: skip
events = st.builds(lambda time, kind, said: {"time": time, "kind": kind, "text": said}, words, words, words)
views = st.builds(
    view, name=words, time=words, links=st.lists(links, max_size=9).map(tuple),
    peers=st.lists(links, max_size=9).map(tuple),
    choices=st.lists(st.builds(Choice, words, words, words), max_size=5).map(tuple),
    topics=st.lists(topics, max_size=30).map(tuple), notes=st.lists(st.tuples(levels, words), max_size=5).map(tuple),
    events=st.lists(events, max_size=5).map(tuple), role=words,
)  # fmt: skip


@settings(max_examples=cases(200), deadline=None)
@given(views, st.integers(1, 200), st.none() | st.integers(1, 60), words, words)
def test_it_is_never_wider_or_higher_than_the_terminal_and_never_steers_it(
    seen: View, width: int, height: int | None, api: str, problem: str
) -> None:
    lines = screen(seen, width, height, api=api, problem=problem)
    assert height is None or len(lines) <= height
    for line in lines:
        assert length(line) <= width
        shown = in_colour(line, colour=False)
        assert shown.isascii()
        assert shown.isprintable() or not shown


@given(words, st.integers(0, 50))
def test_a_text_that_is_cut_is_as_long_as_it_may_be(word: str, width: int) -> None:
    for cut in (fit(word, width), fit_end(word, width)):
        assert len(cut) == min(len(word), width)
        assert cut.isascii()
    assert len(plain(word)) == len(word)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (0.0, ""),
        (0.04, ""),
        (0.5, "0.5"),
        (99.9, "99.9"),
        (100.0, "100"),
        (999.4, "999"),
        (999.6, "1.0k"),
        (2e12, "2000G"),
    ],
)
def test_numbers_are_short(value: float, shown: str) -> None:
    assert count(value) == shown


@given(st.floats(min_value=0, max_value=1e15))
def test_all_numbers_and_times_fit_their_columns(value: float) -> None:
    assert len(count(value)) <= 5
    assert len(ago(value)) <= 5
    assert len(whole(int(value))) <= 5
    assert ago(None) == ""
