"""Why a topic is missing, in words: each cause is told from the others."""

from typing import Any

import pytest

from sern_runtime.watching.state import Sample, TopicLine, View, in_words, read
from sern_runtime.watching.why import BAD, NOTE, OK, WARN, literal, view

Json = dict[str, Any]


def sent(offered: int, delivered: int, **fields: Any) -> Json:
    row: Json = {
        "class": "bulk", "direction": "send", "wanted": True, "answered": True, "max_rate_hz": None, "offered": offered,
        "delivered": delivered, "dropped": {}, "refused": 0, "thinned": 0, "in_queue": 0, "in_flight": 0,
        "bytes_delivered": 1000 * delivered, "type": "t", "owner": "robot", "latched": False,
    }  # fmt: skip
    return row | fields


def arrived(delivered: int, **fields: Any) -> Json:
    row: Json = {
        "class": "bulk", "direction": "receive", "delivered": delivered, "bytes_delivered": 1000 * delivered,
        "dropped": {}, "age_s": 0.2, "type": "t", "owner": "robot", "latched": False,
    }  # fmt: skip
    return row | fields


def client(name: str, state: str = "connected", **fields: Any) -> Json:
    row: Json = {
        "name": name, "state": state, "why": "", "address": None, "lane": "udp", "since_s": 12.0, "heard_s": 0.1,
        "round_trip_s": 0.1, "loss": 0.0, "received_bytes": 10, "sent_bytes": 20,
    }  # fmt: skip
    return row | fields


def sample(
    topics: Json, at_s: float, *, role: str = "client", clients: list[Json] | None = None, **link: Any
) -> Sample:
    about = {
        "name": "me", "role": role, "time": "2026-01-31T12:00:00.000Z", "refused_total": 0,
        "clients": [client("relay")] if clients is None else clients,
    }  # fmt: skip
    row: Json = {"peer": "relay", "rate_bps": 1e6, "queue": {"bulk": {"bytes": 5}}} | link
    return read(at_s, about, [row], topics)


def seen(before: Json, now: Json, **given: Any) -> View:
    return view(sample(before, 0.0, **given), sample(now, 2.0, **given))


def one(before: Json, now: Json, **given: Any) -> TopicLine:
    (line,) = seen({"/robot/points": before}, {"/robot/points": now}, **given).topics
    return line


FLOWS = (sent(100, 100), sent(120, 120))


def test_what_flows_needs_no_word_and_has_its_rates_beside_totals() -> None:
    line = one(*FLOWS)
    assert (line.level, line.why) == (OK, "")
    assert (line.hz, line.messages, line.bytes_per_s, line.bytes) == (10.0, 120, 10_000.0, 120_000)


@pytest.mark.parametrize(
    ("before", "now", "level", "words"),
    [
        (sent(100, 0, wanted=False), sent(120, 0, wanted=False, dropped={"unwanted": 20}), NOTE, "nobody subscribes"),
        (sent(0, 0), sent(0, 0), NOTE, "nothing was published yet"),
        (sent(9, 9), sent(9, 9), NOTE, "nothing new is published"),
        (sent(100, 0), sent(120, 0, dropped={"too_slow": 20}), BAD, "it does not fit the link: too_slow 10.0/s"),
        (sent(100, 10), sent(120, 14, dropped={"superseded": 16}), WARN, "only part of it fits the link: superseded"),
        (sent(100, 10), sent(120, 14, dropped={"rate_cap": 16}, thinned=16), WARN,
         "thinned by the adaptation: 2.0 of 10"),
        (sent(100, 10, max_rate_hz=2.0), sent(120, 14, dropped={"rate_cap": 16}, max_rate_hz=2.0), NOTE,
         "rate cap (max_rate_hz 2): 2.0 of 10.0 Hz"),
        (sent(100, 10), sent(120, 14, refused=16), WARN, "only part of it fits the link: refused"),
        (sent(100, 10), sent(120, 14, dropped={"too_large": 16}), WARN, "larger than link.max_message_bytes"),
        (sent(100, 10, answered=False, wanted=False), sent(120, 10, answered=False, wanted=False), WARN,
         "waits for the relay"),
    ],
)  # fmt: skip
def test_each_cause_at_the_robot_has_its_words(before: Json, now: Json, level: str, words: str) -> None:
    line = one(before, now)
    assert (line.level, words in line.why) == (level, True), line.why


def test_access_denied_says_by_which_rule() -> None:
    text = "robot may not publish /robot/points: no access rule grants it"
    line = one(sent(9, 0, wanted=False), sent(9, 0, wanted=False), refused={"/robot/points": text})
    assert (line.level, line.why) == (BAD, f"access denied: {text}")


def test_a_summary_in_its_place_is_named() -> None:
    item = {"stream": "/robot/points", "kind": "voxel", "level": "summary", "by_link": True}
    assert one(*FLOWS, summaries=[item]).why == "sent as voxel, the link is too slow for whole ones"


def test_without_a_link_everything_that_is_missing_says_so() -> None:
    down = [client("relay", "away", why="the relay does not answer: connecting failed")]
    told = seen({"/robot/points": FLOWS[0]}, {"/robot/points": FLOWS[1]}, clients=down)
    assert [(line.level, line.why) for line in told.topics] == [(BAD, "there is no link to the relay")]
    assert told.links[0].why == "the relay does not answer: connecting failed"


@pytest.mark.parametrize(
    ("now", "peer", "level", "words"),
    [
        (arrived(20), client("robot"), OK, ""),
        (arrived(9, age_s=60.0), client("robot", "away"), BAD, "robot is gone for 12 s"),
        (arrived(9, age_s=60.0), client("robot", "silent"), BAD, "robot does not answer"),
        (arrived(9, age_s=60.0), client("robot"), WARN, "nothing for 60 s, though robot is connected"),
        (arrived(9, age_s=60.0, latched=True), client("robot"), OK, ""),
        (arrived(9, age_s=60.0, owner=""), client("robot"), NOTE, "its publisher has ended it"),
        (arrived(0, age_s=None), client("robot"), WARN, "announced by robot, and nothing came yet"),
        (arrived(12, dropped={"lost": 6}), client("robot"), WARN, "3.0/s dropped on arrival (lost)"),
    ],
)  # fmt: skip
def test_each_cause_at_the_site_has_its_words(now: Json, peer: Json, level: str, words: str) -> None:
    before = arrived(min(9, now["delivered"]))
    line = one(before, now, clients=[client("relay"), peer])
    assert (line.level, words in line.why) == (level, True), line.why


def test_what_is_asked_for_and_not_there_says_why() -> None:
    def why(patterns: list[str], **link: Any) -> dict[str, tuple[str, str]]:
        clients = [client("relay"), client("robot"), client("lost", "forgotten", since_s=700.0)]
        told = seen({}, {}, clients=clients, subscribed=patterns, **link)
        assert all(line.priority == "?" for line in told.topics)
        return {line.topic: (line.level, line.why) for line in told.topics}

    denied = "me may not subscribe to /robot/secret: no access rule grants it"
    found = why(
        ["/robot/points", "/robot/.*", "/lost/points", "/other/points", "/robot/secret", "/me(?:/cmd_vel)"],
        subscriptions_refused=[denied],
    )
    assert found.keys() == {"/robot/points", "/lost/points", "/other/points", "/robot/secret", "/me/cmd_vel"}
    assert found["/robot/points"][1].startswith("robot is connected and does not offer it")
    assert found["/lost/points"] == (BAD, "lost is gone for 12 min")
    assert found["/other/points"][1].startswith("nobody announces it: other never came")
    assert found["/robot/secret"] == (BAD, f"access denied: {denied}")
    assert found["/me/cmd_vel"][0] == WARN


def relay_topics(offered: int, delivered: int, **fields: Any) -> Json:
    return {
        "announced": {"/robot/points": {"class": "bulk", "taken": True, "owners": ["robot"], "latched": False}},
        "links": {"site": {"/robot/points": sent(offered, delivered, **fields)}},
        "received": {"/robot/points": arrived(offered)},
    }


def at_relay(before: Json, now: Json, *clients: Json) -> TopicLine:
    (line,) = seen(before, now, role="relay", clients=list(clients)).topics
    return line


def test_a_relay_says_whose_link_it_does_not_fit() -> None:
    line = at_relay(relay_topics(100, 10), relay_topics(120, 14, dropped={"superseded": 16}), client("robot"))
    assert line.why == "only part of it fits the link to site: superseded 8.0/s"


def test_a_relay_knows_who_is_gone_who_takes_nothing_and_what_has_ended() -> None:
    same = relay_topics(100, 100)
    assert at_relay(same, same, client("robot", "away")).why == "robot is gone for 12 s"
    nobody = relay_topics(100, 100)
    nobody["announced"]["/robot/points"]["taken"] = False
    assert at_relay(nobody, nobody, client("robot")).why == "nobody subscribes to it"
    over = relay_topics(100, 100) | {"announced": {}}
    assert at_relay(over, over, client("robot")).why == "its publisher has ended it"


def test_what_is_wrong_comes_first_within_a_class_and_what_nobody_wants_last() -> None:
    topics = {
        "/a": sent(9, 0, wanted=False), "/b": sent(9, 9, latched=True), "/c": sent(9, 9),
        "/d": sent(9, 9, **{"class": "control", "latched": True}),
    }  # fmt: skip
    told = seen(topics, topics, refused={"/c": "no"})
    assert [line.topic for line in told.topics] == ["/d", "/c", "/b", "/a"]


def test_counters_that_began_anew_make_no_negative_rate() -> None:
    line = one(sent(100, 100), sent(4, 4))
    assert (line.hz, line.messages) == (2.0, 4)


def test_services_are_left_out() -> None:
    topics = {"/robot/add/_service": sent(1, 1), "/robot/add/_call/me": sent(1, 1), "/robot/add": sent(1, 1)}
    assert [line.topic for line in seen(topics, topics).topics] == ["/robot/add"]


@pytest.mark.parametrize(
    ("pattern", "name"),
    [("/a/b", "/a/b"), ("/a(?:/b)", "/a/b"), ("/a/.*", None), ("/a(?:/b|/c)", None), ("/a(?:/.*)", None), ("", None)],
)
def test_a_pattern_that_is_a_name_is_known_as_one(pattern: str, name: str | None) -> None:
    assert literal(pattern) == name


def test_what_a_spool_keeps_and_what_is_still_missing_is_said() -> None:
    kept = {"problem": "", "kept_messages": 1234, "kept_bytes": 5_600_000, "missing": {}}
    assert seen({}, {}, spool=kept).notes == ((NOTE, "spool: 1,234 messages are kept here, 5.6 MB"),)
    lacking = {"problem": "the disk is full", "kept_messages": 0, "kept_bytes": 0}
    lacking["missing"] = {"/a": 1, "/b": 70_000, "/c": 2, "/d": 3, "/e": 1}
    assert seen({}, {}, spool=lacking).notes == (
        (BAD, "spool: the disk is full"),
        (NOTE, "spool: 70,000 messages of /b are at its robot and not here yet"),
        (NOTE, "spool: 3 messages of /d are at its robot and not here yet"),
        (NOTE, "spool: 2 messages of /c are at its robot and not here yet"),
        (NOTE, "spool: and of 2 more topics; `sern spool ls` lists them"),
    )


def test_a_configuration_is_in_words() -> None:
    configuration = {
        "rates": {"control": 1.0, "state": 0.5, "bulk": 0.1}, "codec": "zstd", "redundancy": 1,
        "summaries": {"control": 0, "state": 0, "bulk": 1},
    }  # fmt: skip
    assert in_words(configuration) == "let in: state 50%, bulk 10%; compressed: zstd; control twice; summaries: bulk"
    full = {"rates": {"bulk": 1.0}, "codec": "none", "redundancy": 0, "summaries": None}
    assert in_words(full) == "everything is let in; no compression"


@pytest.mark.parametrize(
    ("said", "note"),
    [
        ({"relays": [{}], "moves": 0}, None),
        ({"relays": [{}, {}], "preferred": True, "moves": 0}, (NOTE, "at the preferred relay (north, tcp://a:1)")),
        (
            {"relays": [{}, {}], "preferred": True, "moves": 2},
            (NOTE, "at the preferred relay (north, tcp://a:1); it moved 2 times"),
        ),
        (
            {"relays": [{"address": "tcp://b:1", "answering_s": None, "why": "it is gone"}, {}], "moves": 1},
            (
                WARN,
                "at another relay (north, tcp://a:1) than the preferred one, tcp://b:1: it is gone; it moved 1 times",
            ),
        ),
        (
            {"relays": [{"address": "tcp://b:1", "answering_s": 61.0, "why": ""}, {}], "moves": 0},
            (
                WARN,
                "at another relay (north, tcp://a:1) than the preferred one, tcp://b:1: has answered for 61 s",
            ),
        ),
    ],
)
def test_at_which_of_several_relays_a_client_is(said: Json, note: tuple[str, str] | None) -> None:
    relay = {"address": "tcp://a:1", "name": "north", "preferred": False} | said
    assert seen({}, {}, relay=relay).notes == (() if note is None else (note,))
