"""Relays with other access rules than each other: both must grant a stream to whoever takes it."""

import json
from random import Random
from typing import Any

import pytest

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.peer_rules import MAX_RULES, parse_rules, rules_hash, rules_text
from sern_core.topics.patterns import PatternSet
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.names import peer_name
from sern_core.vocabulary.types import PriorityClass, TopicName
from tests.exploring import cases
from tests.fabric_world import FabricWorld
from tests.world import SimClient, spec

A, B = peer_name("a"), peer_name("b")
ALL = AccessRule("..+", publish=(".*",), subscribe=(".*",))
"""For every client; the relays are called by one letter."""
ODOM, SCAN = "/robot/odom", "/robot/scan"


def site_may(*topics: str, replay: tuple[str, ...] | None = None) -> tuple[AccessRule, ...]:
    """Everybody may do everything, but `site` may subscribe to these topics alone."""
    return (AccessRule("site", publish=(".*",), subscribe=topics, replay=replay), ALL)


def started(world: FabricWorld, *topics: str, site: tuple[str, ...] = ("/robot/.*",)) -> tuple[SimClient, SimClient]:
    """A robot at `a` that says something in each topic ten times a second, and `site` at `b`."""
    robot, taker = world.client_at("a", "robot"), world.client_at("b", "site", patterns=site)
    for topic in topics:
        robot.every(0.1, robot.publish(topic, spec(PriorityClass.STATE)), b"x")
    world.run(3.0)
    return robot, taker


def topics_at(world: FabricWorld, relay: str) -> set[str]:
    return {identity.topic for identity in world.relays[relay].hub.relayed}


def test_the_relay_of_the_origin_must_grant_what_the_relay_of_the_taker_does() -> None:
    world = FabricWorld("ab", rules={"a": site_may(ODOM), "b": [ALL]}).watch()
    _robot, site = started(world, ODOM, SCAN)
    assert site.on(ODOM) and not site.on(SCAN)
    assert [relay.compared for relay in world.relays.values()] == [[(B, False)], [(A, False)]]
    beside = world.client_at("b", "beside", patterns=[SCAN])  # by both rules
    world.run(2.0)
    assert beside.on(SCAN) and not site.on(SCAN), "that it has come to this relay is for others"


def test_the_relay_of_the_taker_must_grant_what_the_relay_of_the_origin_does() -> None:
    world = FabricWorld("ab", rules={"a": [ALL], "b": site_may(ODOM)}).watch()
    _robot, site = started(world, ODOM, SCAN)
    assert site.on(ODOM) and not site.on(SCAN)


def test_who_names_a_topic_is_told_whose_rules_forbid_it_and_whoever_does_not_is_told_nothing() -> None:
    world = FabricWorld("ab", rules={"a": site_may(ODOM), "b": [ALL]}).watch()
    _robot, site = started(world, ODOM, SCAN, site=(ODOM, SCAN, "/robot/.*"))
    text = "site may not subscribe to /robot/scan: no access rule of the relay a, where it comes from, grants it"
    assert not site.denials, "the stream is not offered to b, which has nobody else who may have it"
    world.client_at("b", "beside", patterns=[SCAN])
    world.run(1.0)
    assert site.denials == [("forbidden", text)]
    site.subscribe(SCAN)  # whoever asks again is told again
    world.run(1.0)
    assert site.denials == [("forbidden", text)] * 2
    assert not world.clients["beside"].denials


def test_a_reload_at_the_origin_takes_and_gives_at_the_other_relay() -> None:
    world = FabricWorld("ab").watch()
    world.client_at("b", "beside", patterns=["/robot/.*"])
    _robot, site = started(world, ODOM, SCAN)
    assert site.on(ODOM) and site.on(SCAN)
    world.reload("a", *site_may(ODOM))
    world.run(1.0)
    counts = len(site.on(ODOM)), len(site.on(SCAN))
    world.run(2.0)
    assert len(site.on(ODOM)) > counts[0] and len(site.on(SCAN)) == counts[1]
    assert len(world.clients["beside"].on(SCAN)) > counts[1]
    world.reload("a", ALL)
    world.run(2.0)
    assert len(site.on(SCAN)) > counts[1]


@pytest.mark.parametrize("order", ["ab", "ba"])
def test_rules_that_all_relays_get_one_after_the_other_disturb_nothing(order: str) -> None:
    world = FabricWorld("ab", rules={"a": [ALL], "b": [ALL]}).watch()
    robot, site = world.client_at("a", "robot"), world.client_at("b", "site", patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(2.0)
    stop = robot.every(0.05, log, b"x")
    new = (AccessRule("nobody"), ALL)
    for relay in order:
        world.run(2.0)
        world.reload(relay, *new)
    world.run(2.0)
    stop()
    world.until(world.settled, what="everything has arrived")
    assert site.seqs("/robot/log") == list(range(1, len(robot.sent) + 1))
    assert len(site.opened) == 1, "its channel went on"
    for relay, peer in (("a", B), ("b", A)):
        assert world.relays[relay].compared == [(peer, False), (peer, True)]
        assert world.relays[relay].hub.rules.differ(peer) is False


@pytest.mark.parametrize("dies", ["a", "b"])
def test_a_relay_that_is_started_anew_with_other_rules_loses_nothing_that_both_grant(dies: str) -> None:
    world = FabricWorld("ab", rules={"a": [ALL], "b": [ALL]}).watch()
    robot, site = world.client_at("a", "robot"), world.client_at("b", "site", patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(2.0)
    stop = robot.every(0.05, log, b"x")
    world.run(2.0)
    world.rules[dies] = [AccessRule("nobody"), ALL]
    world.restart(dies)
    world.run(5.0)
    stop()
    world.until(world.settled, what="everything has arrived")
    assert site.seqs("/robot/log") == list(range(1, len(robot.sent) + 1))
    assert not robot.dropped_out


def test_a_relay_gets_only_what_some_client_of_its_may_have() -> None:
    """By the rules of the origin's relay, which need not believe the other one."""
    world = FabricWorld("ab", rules={name: site_may(ODOM) for name in "ab"}).watch()
    _robot, site = started(world, ODOM, SCAN, site=("/.*",))
    assert topics_at(world, "b") == {ODOM} and site.on(ODOM)
    assert not any(relay.refusals for relay in world.relays.values()), "a relay is told of no denial"
    beside = world.client_at("b", "beside", patterns=["/nothing"])
    world.run(1.0)
    assert topics_at(world, "b") == {ODOM, SCAN}, "it has one by now, whether or not that one asks for it"
    assert not site.on(SCAN) and not beside.got
    beside.subscribe("/robot/s.*")
    world.run(1.0)
    assert beside.on(SCAN)
    world.reload("a", *site_may(ODOM)[:1], AccessRule("robot", publish=(".*",)))
    world.run(1.0)
    assert topics_at(world, "b") == {ODOM}


def test_what_a_relay_is_to_read_itself_needs_a_rule_for_its_name() -> None:
    rules = [AccessRule("b", subscribe=(SCAN,)), *site_may(ODOM)]
    world = FabricWorld("ab", rules=dict.fromkeys("ab", rules)).watch()
    _robot, site = started(world, ODOM, SCAN)
    assert topics_at(world, "b") == {ODOM, SCAN}
    assert not site.on(SCAN)


def test_a_client_that_comes_back_to_its_relay_has_what_it_had() -> None:
    """That nobody is there for a moment takes nothing from the relay that holds a client's messages."""
    world = FabricWorld("abc", rules={name: site_may("/robot/log") for name in "abc"}).watch()
    robot, site = world.client_at("a", "robot"), world.client_at("b", "site", patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(2.0)
    stop = robot.every(0.05, log, b"x")
    for relay in ("c", "b", "c", "b"):
        world.run(2.0)
        world.move("site", relay)
    world.run(2.0)
    stop()
    world.until(world.settled, what="everything has arrived")
    assert site.seqs("/robot/log") == list(range(1, len(robot.sent) + 1))


def test_earlier_messages_need_both_grants_as_well() -> None:
    world = FabricWorld("ab", rules={"a": site_may(".*", replay=()), "b": [ALL]}).watch()
    robot = world.client_at("a", "robot")
    described = robot.publish("/robot/description", spec(reliable=True, latched=True))
    world.run(1.0)
    robot.send(described, b"first")
    beside = world.client_at("b", "beside", patterns=["/robot/.*"])
    world.run(2.0)
    site = world.client_at("b", "site", patterns=["/robot/.*"])
    world.run(2.0)
    robot.send(described, b"second")
    world.run(2.0)
    assert [got.body for got in beside.got] == [b"first", b"second"]
    assert [got.body for got in site.got] == [b"second"]


def test_nothing_waits_for_a_client_that_may_not_have_it() -> None:
    world = FabricWorld("ab", rules={"a": site_may(ODOM), "b": [ALL]}).watch()
    world.client_at("b", "beside", patterns=["/robot/.*"])
    robot, _site = started(world)
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(2.0)
    robot.every(0.1, log, b"x")
    world.run(2.0)
    assert log.required == ("beside",)


def test_whoever_publishes_needs_both_grants() -> None:
    world = FabricWorld("ab", rules={"a": [ALL], "b": [AccessRule("robot", publish=(ODOM,)), ALL]}).watch()
    robot, site = started(world, ODOM, SCAN)
    assert site.on(ODOM) and not site.on(SCAN)
    assert {code for code, _text in world.relays["b"].refusals} == {"forbidden"}
    assert not robot.refusals, "at its own relay it may"


def test_rates_are_those_of_the_rules_of_a_clients_own_relay() -> None:
    slow = (AccessRule("robot", publish=(".*",), max_rate_hz=2.0), ALL)
    for rules, many in (({"a": slow, "b": [ALL]}, False), ({"a": [ALL], "b": slow}, True)):
        world = FabricWorld("ab", rules=rules).watch()
        _robot, site = started(world, ODOM)
        world.run(5.0)
        assert (len(site.on(ODOM)) > 60) is many


# --- what is said -----------------------------------------------------------------------------------------------------


def test_rules_come_back_as_they_were_told() -> None:
    rules = (
        AccessRule("a.*", publish=("/{self}/.*",), subscribe=(".*", "/b"), replay=(), max_rate_hz=5.0),
        AccessRule("b", max_bytes_per_s=1e6, max_queue_bytes=None),
    )
    assert parse_rules(rules_text(rules)) == rules
    assert parse_rules(rules_text(())) == ()


def changed(**items: object) -> bytes:
    (rule,) = json.loads(rules_text([ALL]))
    return json.dumps([rule | items]).encode()


@pytest.mark.parametrize(
    "text",
    [
        b"", b"{}", b"[1]", b"[" * 100_000, b"\xff", b"null",
        changed(client=1), changed(client="x" * 513), changed(publish=None), changed(subscribe=["x" * 513]),
        changed(subscribe=[None]), changed(replay="/a"), changed(max_rate_hz=0), changed(max_rate_hz=float("nan")),
        changed(max_rate_hz=float("inf")), changed(max_queue_bytes=10**400), changed(max_bytes_per_s=True),
        changed(max_bytes_per_s="1"), changed(publish=["/a"] * 20_000), rules_text([ALL] * (MAX_RULES + 1)),
    ],
)  # fmt: skip
def test_what_no_relay_says_of_rules_is_an_error(text: bytes) -> None:
    with pytest.raises(WireError):
        parse_rules(text)


def told(world: FabricWorld, envelope: dict[str, Any], text: bytes) -> None:
    """`b` says this to `a`."""
    hub = world.relays["a"].hub
    hub.rules.told(hub.links[B], envelope, text, now=world.relays["a"].now)


@pytest.mark.parametrize(
    ("envelope", "text"), [({}, b""), ({"hash": 5}, b""), ({"hash": "x" * 65}, b""), ({"hash": "00"}, b"[]")]
)
def test_rules_whose_hash_is_wrong_are_an_error(envelope: dict[str, Any], text: bytes) -> None:
    world = FabricWorld("ab")
    world.run(1.0)
    with pytest.raises(WireError):
        told(world, envelope, text)


@pytest.mark.parametrize(
    "text",
    [changed(deny=["/a"]), changed(subscribe=["(a"]), changed(client="\ud800"), changed(publish=["/a{9999}"]), b""],
)
def test_rules_that_cannot_be_judged_by_let_nobody_have_anything(text: bytes) -> None:
    """Those of a later release, or that a relay keeps to itself."""
    world = FabricWorld("ab").watch()
    robot, site = world.client_at("b", "robot"), world.client_at("a", "site", patterns=["/.*"])
    odom = robot.publish(ODOM, spec(PriorityClass.STATE))
    world.run(2.0)
    robot.every(0.1, odom, b"x")
    world.run(1.0)
    assert site.got
    told(world, {"t": "rules", "hash": rules_hash(text)}, text)
    world.run(1.0)
    site.got.clear()
    world.run(2.0)
    assert not site.got
    assert [code for code, _text in world.relays["a"].refusals] == ["bad_rules"]


def test_a_relay_with_more_rules_than_can_be_told_says_so() -> None:
    many = [AccessRule(f"robot{number}") for number in range(MAX_RULES)]
    world = FabricWorld("ab", rules={"a": [*many, ALL], "b": [ALL]}).watch()
    _robot, site = started(world, ODOM)
    assert not site.got
    assert [code for code, _text in world.relays["a"].refusals] == ["too_many_rules"]
    assert [code for code, _text in world.relays["b"].refusals] == ["bad_rules"]


# --- any rules --------------------------------------------------------------------------------------------------------

RELAYS, CLIENTS, TOPICS = "abc", ("one", "two", "three", "four"), ("/x", "/y", "/z/u", "/z/v")
PATTERNS = ("/.*", "/x", "/z/.*", "/y|/z/u", "/none")


def any_rules(rng: Random) -> list[AccessRule]:
    def some() -> tuple[str, ...]:
        return tuple(rng.sample(PATTERNS, rng.randint(0, 2)))

    # That a publication which was refused is not offered again after a reload is so at one relay, too.
    rules = [AccessRule(name, publish=(".*",), subscribe=some()) for name in rng.sample(CLIENTS, 2)]
    return [*rules, rng.choice((ALL, AccessRule("..+", publish=(".*",), subscribe=("/z/.*",))))]


@pytest.mark.parametrize("seed", range(cases(8)))
def test_whatever_the_rules_are_and_become_everybody_gets_what_both_relays_grant(seed: int) -> None:
    rng = Random(seed)
    world = FabricWorld(RELAYS, seed, rules={name: any_rules(rng) for name in RELAYS}).watch(0.25)
    wants = {}
    for name in CLIENTS:
        wants[name] = tuple(rng.sample((*PATTERNS, *TOPICS), 2))
        world.client_at(rng.choice(RELAYS), name, patterns=wants[name])
    for name, topic in zip(CLIENTS, TOPICS, strict=True):
        client = world.clients[name]
        client.every(0.1, client.publish(topic, spec(PriorityClass.STATE, reliable=rng.random() < 0.5)), b"x")
    world.run(2.0)
    for _ in range(rng.randint(0, 6)):
        what = rng.randrange(4)
        if what == 0:
            world.reload(rng.choice(RELAYS), *any_rules(rng))
        elif what == 1:
            world.restart(rng.choice(RELAYS))
        elif what == 2:
            name = rng.choice(CLIENTS)
            wants[name] = tuple(rng.sample((*PATTERNS, *TOPICS), 2))
            world.clients[name].subscribe(*wants[name])
        else:
            world.hops[rng.choice(("a-b", "a-c", "b-c"))].break_connection(reconnect_s=rng.choice((0.5, 3.0)))
        world.run(rng.choice((0.0, 0.3, 3.0)))
    world.run(15.0)
    tables = {name: AccessTable(rules) for name, rules in world.rules.items()}
    for client in world.clients.values():
        client.got.clear()
    world.run(2.0)
    for name, client in world.clients.items():
        home = tables[world.at[name]]
        for origin, text in zip(CLIENTS, TOPICS, strict=True):
            topic, source = TopicName(text), tables[world.at[origin]]
            may = all(table.may_subscribe(client.name, topic) for table in (home, source))
            wanted = PatternSet(wants[name]).fullmatch(topic)
            assert bool(client.on(text)) is (may and wanted and origin != name), f"{text} to {name}"
