"""What the relay's core promises its clients beside delivery: answers, and that they are let go."""

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.relayed_streams import MAX_DENIED
from sern_core.stream.prices import MESSAGE_OVERHEAD_BYTES
from sern_core.vocabulary.types import DropReason
from sern_sim.models import LinkModel, Window
from tests.world import World, spec

ONE_SECRET = AccessTable(
    [
        AccessRule(client="robot", publish=(".*",)),
        AccessRule(client="site", subscribe=("/robot/odom",)),
    ]
)


def test_a_topic_that_was_named_and_is_forbidden_is_told_in_every_session() -> None:
    world = World(access=ONE_SECRET).watch()
    site = world.client("site", patterns=["/robot/odom", "/robot/none", "/robot/se.*"])
    robot = world.client("robot")
    world.run(1.0)
    told = ("forbidden", "site may not subscribe to /robot/none: no access rule grants it")
    assert site.denials == [told]
    assert world.relay.refusals == [told]
    world.hops["site"].break_connection()
    world.until(lambda: len(site.ups) == 2)
    world.run(1.0)
    assert site.denials == [told] * 2
    assert robot.denials == []


def test_what_only_a_pattern_covers_is_not_mentioned() -> None:
    world = World(access=ONE_SECRET).watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    world.run(1.0)
    for name in ("/robot/odom", "/robot/secret"):
        robot.publish(name, spec())
    world.run(1.0)
    assert [stream.id.topic for stream in site.opened] == ["/robot/odom"]
    assert site.denials == []


def test_new_rules_are_told_to_whom_they_take_something_from() -> None:
    world = World().watch()
    site = world.client("site", patterns=["/robot/odom", "/robot/map"])
    world.run(1.0)
    assert site.denials == []
    world.relay.hub.revoke(ONE_SECRET, now=world.relay.now)
    world.run(1.0)
    assert [text.split(":")[0] for _, text in site.denials] == ["site may not subscribe to /robot/map"]


def test_a_bad_pattern_is_told_and_what_was_wanted_before_stays() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/odom"])
    channel = robot.publish("/robot/odom", spec())
    world.run(1.0)
    site.subscribe("/robot/map", "/(?=a)")
    world.run(1.0)
    assert [code for code, _ in site.denials] == ["bad_pattern"] and "'/(?=a)'" in site.denials[0][1]
    site.subscribe(*(f"/x.?{n}" for n in range(300)))
    world.run(1.0)
    assert [code for code, _ in site.denials] == ["bad_pattern", "too_many_patterns"]
    robot.send(channel, b"1")
    world.run(1.0)
    assert site.seqs("/robot/odom") == [1]


def test_the_list_of_what_is_denied_has_an_end() -> None:
    world = World(access=ONE_SECRET).watch()
    site = world.client("site", patterns=[f"/robot/n{n}" for n in range(200)])
    world.run(2.0)
    assert len(site.denials) == MAX_DENIED


# --- who is let go ----------------------------------------------------------------------------------------------------


def test_a_client_that_says_goodbye_and_has_nothing_to_get_is_forgotten_at_once() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    channel = robot.publish("/robot/odom", spec())
    world.run(1.0)
    assert channel.wanted
    site.core.link.close("client stops", now=site.now)
    world.until(lambda: site.name not in world.relay.hub.links, within_s=0.5)
    assert not world.relay.hub.routing.subscribers(channel.stream.id)
    assert site.name not in world.relay.hub.clients.port_of
    world.until(lambda: channel.wanted is False, within_s=0.5)
    world.hops["site"].break_connection()
    world.until(lambda: len(site.ups) == 2)  # it may change its mind
    world.until(lambda: channel.wanted)
    robot.send(channel, b"1")
    world.until(lambda: site.seqs("/robot/odom") == [1])


def test_a_client_that_is_required_or_has_reliable_streams_is_waited_for() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(1.0)
    site.core.link.close("client stops", now=site.now)
    robot.core.link.close("client stops", now=robot.now)
    world.run(0.5)
    assert {robot.name, site.name} <= world.relay.hub.links.keys()
    robot.send(log, b"meanwhile")
    for hop in world.hops.values():
        hop.break_connection()
    world.until(lambda: site.seqs("/robot/log") == [1])


def test_a_connection_that_breaks_is_no_goodbye() -> None:
    world = World().watch()
    site = world.client("site", LinkModel(blackouts=(Window(1.0, 3.0),), disconnect_after_s=0.5).as_stream())
    world.until(lambda: site.downs)
    assert site.name in world.relay.hub.links


def test_a_revoked_name_is_forgotten_and_what_waits_for_it_is_reported() -> None:
    world = World().watch()
    hub = world.relay.hub
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    own = site.publish("/site/plan", spec(reliable=True, latched=True))
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(1.0)
    site.core.link.close("away", now=site.now)
    world.run(0.2)
    for _ in range(3):
        robot.send(log, b"x")
    world.run(0.2)
    assert hub.links[site.name].outgoing.by_stream[log.stream.id].retained
    hub.forget(site.name, "the name is revoked", now=world.relay.now)
    assert site.name not in hub.links and not hub.routing.known(own.stream.id)
    world.until(lambda: len(robot.dropped_out) == 3, within_s=0.8)
    assert {drop.reason for drop in robot.dropped_out} == {DropReason.FORBIDDEN}
    assert not log.retained


# --- what may be kept -------------------------------------------------------------------------------------------------


def test_small_reliable_messages_count_with_their_overhead() -> None:
    world = World()
    robot = world.client("robot")
    channel = robot.publish("/robot/log", spec(reliable=True, max_queue_bytes=1000 * (MESSAGE_OVERHEAD_BYTES + 30)))
    assert [robot.send(channel, b"x" * 30) for _ in range(1001)] == [True] * 1000 + [False]
    assert channel.counters.refused == 1
    assert channel.held_bytes == 30_000


def test_a_new_relay_holds_for_every_one_of_many_subscribers() -> None:
    world = World()
    robot = world.client("robot")
    away = LinkModel(blackouts=(Window(5.0, 12.0),), disconnect_after_s=0.5).as_stream()
    sites = [world.client(f"s{n:03d}_" + "x" * 40, away, patterns=["/robot/.*"]) for n in range(120)]
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(4.0)
    assert set(log.required) == {site.name for site in sites}
    world.run(2.0)
    world.restart_relay()
    world.until(lambda: len(robot.ups) == 2, within_s=3.0)
    robot.send(log, b"1")
    world.run(1.0)
    relayed = world.relay.hub.relayed[log.stream.id]
    assert relayed.outs.keys() == {site.name for site in sites}
    assert log.retained
    world.until(lambda: all(site.seqs("/robot/log") == [1] for site in sites))
    world.until(lambda: not log.retained)
    assert set(log.required) == {site.name for site in sites}
    world.validate()
