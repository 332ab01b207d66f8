"""Reliable and latched streams end to end: restarts, absences, refusals, gaps, reports, late joiners."""

import pytest

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import HubParams
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import DropReason, PriorityClass
from sern_sim.models import LinkModel
from tests.world import SimClient, World, spec

THIN = LinkModel(rate_bps=1e6, delay_s=0.05).as_stream()


def pair(world: World, *, robot: LinkModel | None = None, site: LinkModel | None = None) -> tuple[SimClient, SimClient]:
    return world.client("robot", robot), world.client("site", site, patterns=["/robot/.*"])


def send(client: SimClient, channel: OutChannel, count: int, size: int = 100) -> None:
    for _ in range(count):
        assert client.send(channel, bytes(size))


@pytest.mark.parametrize("lossless", [True, False])
def test_kept_while_the_subscriber_is_away(lossless: bool) -> None:
    world = World(lossless=lossless).watch()
    robot, site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    world.network.crash_node(site)
    send(robot, log, 50)
    world.run(20.0)
    assert log.watermark == 0 and len(log.retained) == 50
    site = world.restart_client("site")
    world.until(lambda: log.watermark == 50)
    assert site.seqs("/robot/log") == list(range(1, 51))
    assert log.counters.delivered == 50 and not log.retained


def test_a_new_relay_waits_for_whom_the_origin_owes_its_stream() -> None:
    """The subscriber is away while the relay is replaced: nobody else knows that it was ever there."""
    world = World().watch()
    robot, site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    assert log.required == ("site",)
    world.network.crash_node(site)
    world.restart_relay()
    world.run(2.0)
    send(robot, log, 10)
    world.run(5.0)
    assert log.watermark == 0, "confirmed though nobody has it"
    site = world.restart_client("site")
    world.until(lambda: log.watermark == 10)
    assert site.seqs("/robot/log") == list(range(1, 11))


def test_a_relay_replaced_while_the_origin_is_away_changes_nothing() -> None:
    world = World(lossless=False).watch()
    robot, site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    send(robot, log, 5)
    world.run(2.0)
    world.hops["robot"].break_connection(reconnect_s=10.0)
    send(robot, log, 5)
    world.run(1.0)
    world.restart_relay()
    world.run(1.0)
    world.restart_relay()
    world.until(lambda: log.watermark == 10)
    assert site.seqs("/robot/log") == list(range(1, 11)), "once and in order, over three relays"


def test_a_subscriber_that_stays_away_is_given_up_and_reported() -> None:
    world = World(hub_params=HubParams(resume_s=30.0)).watch()
    robot, site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    world.network.crash_node(site)
    send(robot, log, 3)
    world.run(20.0)
    assert log.watermark == 0 and not robot.dropped_out
    world.run(20.0)
    assert log.watermark == 3 and not log.retained
    assert [(drop.seq, drop.reason) for drop in robot.dropped_out] == [(n, DropReason.DISCONNECTED) for n in (1, 2, 3)]
    assert log.counters.dropped == 3 and log.counters.delivered == 0


def test_overflow_is_refused_and_accepted_again_later() -> None:
    world = World().watch()
    robot, site = pair(world, robot=THIN)
    log = robot.publish("/robot/log", spec(reliable=True, max_queue_bytes=55_000))
    world.run(2.0)
    answers = [robot.send(log, bytes(10_000)) for _ in range(8)]
    assert answers == [True] * 5 + [False] * 3
    assert (log.counters.offered, log.counters.refused, log.counters.by_reason[DropReason.REFUSED]) == (5, 3, 3)
    world.until(lambda: log.watermark == 5)
    assert robot.send(log, b"again")
    world.until(lambda: log.watermark == 6)
    assert site.seqs("/robot/log") == [1, 2, 3, 4, 5, 6]


def test_expired_messages_leave_drop_markers_in_their_turn_and_are_reported() -> None:
    world = World().watch()
    robot, site = pair(world, robot=THIN)
    log = robot.publish("/robot/log", spec(reliable=True, lifespan_s=0.5))
    world.run(2.0)
    send(robot, log, 20, 10_000)  # 1.6 s of the link
    world.until(lambda: log.watermark == 20)
    delivered, expired = site.seqs("/robot/log"), site.expired_seqs["/robot/log"]
    assert site.turns[log.stream.id] == list(range(1, 21)), "every message has its turn, once and in order"
    assert delivered and expired and sorted(delivered + expired) == list(range(1, 21))
    assert {drop.seq for drop in robot.dropped_out} == set(expired)
    assert log.counters.dropped == len(expired) and log.counters.delivered == len(delivered)


def test_a_drop_on_the_second_hop_is_reported_before_the_watermark() -> None:
    """The message is in time at the relay and late behind it: the origin must not count it as delivered."""
    world = World().watch()
    robot, site = pair(world, site=LinkModel(rate_bps=100e3, delay_s=0.05).as_stream())
    log = robot.publish("/robot/log", spec(reliable=True, lifespan_s=0.5))
    world.run(2.0)
    send(robot, log, 5, 10_000)
    world.until(lambda: log.watermark == 5)
    missing = set(range(1, 6)) - set(site.seqs("/robot/log"))
    assert missing and {drop.seq for drop in robot.dropped_out} == missing
    by_reason = log.counters.by_reason  # the relay does not know of one that it had sent whole
    assert by_reason[DropReason.LIFESPAN] + by_reason[DropReason.UNCONFIRMED] == log.counters.dropped == len(missing)
    assert log.counters.delivered == 5 - len(missing)
    assert not any(stream.reports for link in world.links() for stream in link.taking.streams.values())


def test_reports_survive_a_broken_session() -> None:
    """The relay gives a message up while the origin's link is down, and says so when it is back."""
    world = World().watch()
    robot, site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True, retention_s=3.0))
    world.run(2.0)
    world.network.crash_node(site)
    send(robot, log, 3)
    world.run(1.0)
    assert log.flying == {}, "the relay has them"
    world.hops["robot"].break_connection(reconnect_s=1.0)
    world.run(10.0)
    assert sorted(drop.seq for drop in robot.dropped_out) == [1, 2, 3]
    assert log.counters.by_reason[DropReason.UNCONFIRMED] == 3, "they had left the relay whole"
    assert log.watermark == 3 and not log.retained


def test_what_lapsed_while_the_link_was_down_is_skipped() -> None:
    world = World().watch()
    robot, site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True, retention_s=3.0))
    world.run(2.0)
    send(robot, log, 2)
    world.run(1.0)
    world.hops["robot"].break_connection(reconnect_s=10.0)
    send(robot, log, 4)
    world.run(9.0)
    assert [drop.seq for drop in robot.dropped_out] == [3, 4, 5, 6]
    send(robot, log, 2)
    world.until(lambda: log.watermark == 8)
    assert site.turns[log.stream.id] == [1, 2, -4, 7, 8] or site.turns[log.stream.id] == [1, 2, 7, 8, -4]
    assert site.skipped_count["/robot/log"] == 4


def test_a_new_subscriber_is_not_told_of_what_nobody_wanted() -> None:
    world = World().watch()
    robot = world.client("robot")
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    send(robot, log, 100)
    world.run(1.0)
    assert log.counters.by_reason[DropReason.UNWANTED] == 100 and robot.wants["/robot/log"] == [False]
    site = world.client("site", patterns=["/robot/.*"])
    world.run(2.0)
    send(robot, log, 3)
    world.run(2.0)
    assert site.turns[log.stream.id] == [101, 102, 103]
    assert not site.expired_seqs["/robot/log"] and not site.skipped_count["/robot/log"]


@pytest.mark.parametrize("others", [True, False])
def test_what_a_subscriber_that_leaves_no_longer_wants_is_no_loss_to_the_origin(others: bool) -> None:
    """What waits for it at the relay is given up; whoever else wants the stream has it, and it counts as delivered."""
    world = World().watch()
    robot = world.client("robot")
    guest = world.client("guest", LinkModel(rate_bps=20e3, delay_s=0.05).as_stream(), patterns=["/robot/.*"])
    stays = world.client("stays", patterns=["/robot/.*"]) if others else None
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    send(robot, log, 20, 10_000)
    world.run(1.0)
    assert len(guest.seqs("/robot/log")) < 3
    guest.subscribe()  # as a tool does that ends
    world.until(lambda: not log.retained, within_s=20.0)
    assert len(guest.seqs("/robot/log")) < 10
    if stays is not None:
        assert stays.seqs("/robot/log") == list(range(1, 21))
        assert robot.dropped_out == [] and log.counters.delivered == 20
    else:
        assert {drop.reason for drop in robot.dropped_out} <= {DropReason.UNWANTED}


def test_a_report_names_who_did_not_get_it() -> None:
    world = World(hub_params=HubParams(resume_s=5.0)).watch()
    robot = world.client("robot")
    world.client("near", patterns=["/robot/.*"])
    far = world.client("far", patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True, retention_s=600.0))
    world.run(2.0)
    world.network.crash_node(far)
    send(robot, log, 3)
    world.until(lambda: len(robot.dropped_out) == 3)
    assert [(drop.seq, drop.reason, drop.where) for drop in robot.dropped_out] == [
        (seq, DropReason.DISCONNECTED, "far") for seq in (1, 2, 3)
    ]


def test_one_slow_subscriber_holds_back_nobody_else() -> None:
    world = World().watch()
    robot = world.client("robot")
    slow = world.client("slow", LinkModel(rate_bps=100e3, delay_s=0.05).as_stream(), patterns=["/robot/.*"])
    fast = world.client("fast", patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    send(robot, log, 20, 10_000)
    world.run(1.0)
    assert len(fast.seqs("/robot/log")) == 20 and len(slow.seqs("/robot/log")) < 3
    world.until(lambda: log.watermark == 20)
    assert slow.seqs("/robot/log") == fast.seqs("/robot/log") == list(range(1, 21))


@pytest.mark.parametrize("reliable", [True, False])
def test_every_late_joiner_gets_the_last_of_each_publisher(reliable: bool) -> None:
    world = World().watch()
    robots = [world.client(name) for name in ("robot1", "robot2")]
    topics = [
        robot.publish("/tf_static", spec(latched=True, reliable=reliable, depth=3, many_writers=True))
        for robot in robots
    ]
    world.run(2.0)
    for robot, topic in zip(robots, topics, strict=True):
        for _ in range(10):
            robot.send(topic, robot.name.encode())
            world.run(0.1)
    for number in (1, 2):
        site = world.client(f"site{number}", THIN, patterns=["/tf_static"])
        world.run(3.0)
        for robot, topic in zip(robots, topics, strict=True):
            got = [g for g in site.got if g.stream == topic.stream.id]
            assert [g.seq for g in got] == [8, 9, 10] and all(g.replay and g.body == robot.name.encode() for g in got)


def test_a_message_on_its_way_to_a_subscriber_that_leaves_is_no_loss_either() -> None:
    """It was sent whole, and its acknowledgement is still to come when nobody wants it any more."""
    world = World().watch()
    robot = world.client("robot")
    guest = world.client("guest", LinkModel(delay_s=1.0).as_stream(), patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(10.0)
    guest.subscribe()
    world.run(0.8)
    send(robot, log, 1)
    link = world.relay.hub.links[guest.name]
    world.until(lambda: any(channel.flying for channel in link.sender.channels.values()), within_s=0.5)
    world.until(lambda: not link.sender.channels, within_s=1.0)
    world.until(lambda: not log.retained)
    assert robot.dropped_out == [] and log.counters.delivered == 1


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("restarted", ["relay", "site", "both"])
def test_latched_state_outlives_restarts(reliable: bool, restarted: str) -> None:
    """A relay that starts anew gets it from the origin, a site that starts anew from the relay, whatever its age."""
    world = World().watch()
    robot, site = pair(world)
    grid = robot.publish("/robot/map", spec(latched=True, reliable=reliable, depth=2, retention_s=5.0))
    world.run(2.0)
    send(robot, grid, 5)
    world.run(20.0)
    if restarted in ("relay", "both"):
        world.restart_relay()
        world.run(3.0)
    if restarted in ("site", "both"):
        site = world.restart_client("site")
        world.run(3.0)
        assert site.seqs("/robot/map") == [4, 5]
    late = world.client("late", patterns=["/robot/.*"])
    world.run(3.0)
    assert late.seqs("/robot/map") == [4, 5]
    assert site.seqs("/robot/map")[-2:] == [4, 5] and len(site.seqs("/robot/map")) == len(set(site.seqs("/robot/map")))


def test_latched_state_is_there_again_when_its_stream_ended_and_begins_anew() -> None:
    """With the stream ended the publisher on the robot's far side, and what it would have told whoever comes late."""
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/.*"])
    world.run(1.0)
    for name, latched in (("/tf_static", True), ("/log", False)):
        robot.send(robot.publish(name, spec(PriorityClass.STATE, reliable=True, latched=latched)), name.encode())
    world.run(1.0)
    assert sorted(got.body for got in site.got) == [b"/log", b"/tf_static"]
    world.relay.hub.forget(site.core.name, "another process has its name", now=world.relay.now)
    world.run(5.0)
    assert sorted(stream.id.topic for stream in site.closed) == ["/log", "/tf_static"]
    assert [got.body for got in site.got[2:]] == [b"/tf_static"], "what is latched, and nothing twice"


def test_a_replay_does_not_delay_live_traffic() -> None:
    world = World().watch()
    robot = world.client("robot")
    grid = robot.publish("/robot/map", spec(latched=True, reliable=True))
    live = robot.publish("/robot/state", spec(PriorityClass.STATE))
    world.run(2.0)
    send(robot, grid, 1, 300_000)
    world.run(1.0)
    robot.every(0.1, live, b"s" * 1000)
    site = world.client("site", THIN, patterns=["/robot/.*"])
    world.run(5.0)
    assert site.seqs("/robot/map") == [1]
    ages = sorted(got.age_s for got in site.on("/robot/state"))
    assert len(ages) >= 40 and ages[int(0.9 * len(ages))] < 0.2


def test_replay_needs_its_right() -> None:
    access = AccessTable(
        [
            AccessRule(client="robot", publish=(".*",), subscribe=()),
            AccessRule(client="old", publish=(), subscribe=(".*",), replay=(".*",)),
            AccessRule(client="new", publish=(), subscribe=(".*",), replay=()),
        ]
    )
    world = World(access=access).watch()
    robot = world.client("robot")
    grid = robot.publish("/robot/map", spec(latched=True, reliable=True))
    world.run(2.0)
    send(robot, grid, 1)
    world.run(1.0)
    old, new = (world.client(name, patterns=["/robot/.*"]) for name in ("old", "new"))
    world.run(2.0)
    assert old.seqs("/robot/map") == [1] and new.seqs("/robot/map") == []
    send(robot, grid, 1)
    world.run(2.0)
    assert old.seqs("/robot/map") == [1, 2] and new.seqs("/robot/map") == [2]


def test_a_message_too_large_for_the_origin_or_the_relay_is_reported_and_passed_over() -> None:
    world = World(link=LinkParams(max_message_bytes=10_000)).watch()
    robot, site = pair(world)
    robot.core.link.end.params = LinkParams(max_message_bytes=50_000)
    log = robot.publish("/robot/log", spec(reliable=True))
    best = robot.publish("/robot/cloud", spec())
    world.run(2.0)
    for size in (10, 60_000, 20_000, 10):
        robot.send(log, bytes(size))
        robot.send(best, bytes(size))
        world.run(0.5)
    assert site.turns[log.stream.id] == [1, 2, 3, 4] and site.seqs("/robot/log") == [1, 4]
    assert [(d.seq, d.reason) for d in robot.dropped_out if d.topic == "/robot/log"] == [
        (2, DropReason.TOO_LARGE),
        (3, DropReason.TOO_LARGE),
    ]
    assert site.seqs("/robot/cloud") == [1, 4]


def test_a_topic_withdrawn_with_messages_still_waiting_is_delivered_first() -> None:
    """The robot's process is gone; what the relay has taken over is still delivered."""
    world = World().watch()
    robot, site = pair(world, site=LinkModel(rate_bps=100e3, delay_s=0.05).as_stream())
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    send(robot, log, 5, 10_000)
    world.run(0.5)
    assert log.flying == {} and log.watermark == 0
    world.restart_client("robot")
    world.run(20.0)
    assert site.seqs("/robot/log") == [1, 2, 3, 4, 5]
    assert [stream.id for stream in site.closed] == [log.stream.id]
    assert not world.relay.hub.streams.draining


def test_publishing_again_goes_on_counting() -> None:
    world = World().watch()
    robot, site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    send(robot, log, 3)
    world.run(1.0)
    robot.core.unpublish(log, now=robot.now)
    world.run(1.0)
    again = robot.publish("/robot/log", spec(reliable=True))
    world.run(1.0)
    send(robot, again, 2)
    world.run(1.0)
    assert site.seqs("/robot/log") == [1, 2, 3, 4, 5] and len(site.closed) == 1 and len(site.opened) == 2


def test_published_anew_while_the_link_was_down_with_other_properties() -> None:
    world = World().watch()
    robot, site = pair(world)
    topic = robot.publish("/robot/state", spec())
    world.run(2.0)
    world.hops["robot"].break_connection(reconnect_s=2.0)
    world.run(0.5)
    robot.core.unpublish(topic, now=robot.now)
    topic = robot.publish("/robot/state", spec(reliable=True))
    world.run(5.0)
    send(robot, topic, 3)
    world.run(2.0)
    assert site.seqs("/robot/state") == [1, 2, 3] and topic.watermark == 3
