"""A client knows whether those are there whose streams it takes, however loaded its link is."""

import pytest

from sern_core.path.flight import STALL_MIN_S, STALL_RTTS
from sern_core.path.lanes import PING_INTERVAL_S
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import HubParams
from sern_core.relay.presence import MAX_TOLD
from sern_core.site.peers import LET_GO_S, PeerChange, PeerStatus
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, PriorityClass, TopicName
from sern_core.wire import framing
from sern_sim.models import LinkModel, Window
from tests.exploring import also
from tests.views import peers, statuses
from tests.world import SimClient, World, spec

CONNECTED, GONE, UNKNOWN = PeerStatus.CONNECTED, PeerStatus.GONE, PeerStatus.UNKNOWN
THIN_BPS = 0.25e6
OVERLOAD = 13.0
SWEEP_S = 1.0
"""How often the relay looks who is silent, in `World` as in the daemon."""


def thin(rate_bps: float = THIN_BPS, delay_s: float = 0.025) -> LinkModel:
    return LinkModel(rate_bps=rate_bps, delay_s=delay_s).as_stream()


# --- who is told of whom ----------------------------------------------------------------------------------------------


def test_a_site_knows_of_its_robots_and_a_robot_of_who_drives_it() -> None:
    world = World().watch()
    robots = [world.client(name, thin(), patterns=[f"/{name}/cmd_vel"]) for name in ("robot1", "robot2")]
    stranger = world.client("stranger")
    site = world.client("site", thin(delay_s=0.1), patterns=["/robot.*"])
    for robot in robots:
        robot.publish(f"/{robot.name}/odom", spec())
    stranger.publish("/stranger/odom", spec())
    site.publish("/robot1/cmd_vel", spec(PriorityClass.CONTROL))
    world.until(lambda: statuses(site) == {"robot1": CONNECTED, "robot2": CONNECTED})
    world.until(lambda: statuses(robots[0]) == {"site": CONNECTED})
    world.run(5.0)
    assert statuses(robots[1]) == statuses(stranger) == {}
    assert peers(site)["robot1"].lane == "zmq"
    assert peers(site)["robot1"].rtt_s == pytest.approx(0.05, abs=0.03)
    assert peers(robots[0])["site"].rtt_s == pytest.approx(0.2, abs=0.05)


def test_the_age_is_that_of_the_last_message_of_any_of_its_topics_and_a_replay_is_none() -> None:
    world = World()
    robot = world.client("robot")
    map_ = robot.publish("/robot/map", spec(reliable=True, latched=True))
    world.run(1.0)
    robot.send(map_, b"map")
    world.run(1.0)
    site = world.client("site", patterns=["/robot/.*"])
    world.until(lambda: site.seqs("/robot/map") == [1])
    assert site.got[0].replay
    world.run(2.0)
    assert peers(site)["robot"].age_s is None
    odom = robot.publish("/robot/odom", spec())
    world.run(1.0)
    robot.send(odom, b"odom")
    world.run(3.0)
    assert peers(site)["robot"].age_s == pytest.approx(3.0, abs=0.3)


def test_a_stream_that_ends_leaves_a_peer_only_while_there_is_another() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    channels = [robot.publish(f"/robot/{name}", spec()) for name in ("odom", "map")]
    world.until(lambda: statuses(site) == {"robot": CONNECTED})
    robot.core.unpublish(channels[0], now=robot.now)
    world.run(3.0)
    assert statuses(site) == {"robot": CONNECTED}
    robot.core.unpublish(channels[1], now=robot.now)
    world.until(lambda: statuses(site) == {})


def test_what_the_relay_itself_publishes_is_nobodys() -> None:
    world = World(access=AccessTable([AccessRule(client=".*", publish=(".*",), subscribe=(".*",))])).watch()
    site = world.client("site", patterns=["/scene/.*"])
    world.run(1.0)
    info = TopicInfo(TopicName("/scene/pose"), "std_msgs/msg/String", Encoding.CDR)
    handle = world.relay.hub.local.open(info, spec(), ClientName("feed_scene"), now=world.relay.now)
    world.run(1.0)
    world.relay.hub.local.inject(handle, b"1", 0, now=world.relay.now)
    world.until(lambda: site.seqs("/scene/pose") == [1])
    world.run(2.0)
    told = [name for name in statuses(site) if name != "feed_scene"]
    assert told == [] and GONE not in statuses(site).values()
    world.hops["site"].break_connection(reconnect_s=1.0)
    world.run(LET_GO_S)
    world.relay.hub.local.inject(handle, b"2", 0, now=world.relay.now)
    world.run(LET_GO_S)
    assert site.seqs("/scene/pose") == [1, 2]
    assert GONE not in statuses(site).values(), "the site has asked of it in its new session"


@pytest.mark.interpreted
def test_a_client_that_does_not_ask_is_told_nothing() -> None:
    """Peers of an earlier version: a control message that it does not know would end its session."""
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site")
    robot.publish("/robot/odom", spec())
    world.run(0.5)
    site.core.link.control.send({"t": "subscribe", "patterns": ["/robot/.*"], "more": False}, now=site.now)
    told: list[str] = []
    link = world.relay.hub.links[site.name]
    send = link.control.send

    def watched(envelope: framing.Envelope, attachment: bytes = b"", *, now: float) -> int:
        told.append(envelope["t"])
        return send(envelope, attachment, now=now)

    world.relay.hub.presence._watchers.clear()
    link.control.send = watched  # type: ignore[method-assign]
    world.until(lambda: site.opened)
    world.run(5.0)
    assert "announce" in told and "peers" not in told


# --- who is gone ------------------------------------------------------------------------------------------------------


def gone_within_s(rtt_s: float, site_delay_s: float = 0.0) -> tuple[float, float]:
    """How soon a robot that falls silent is said to be gone at its site, at the least and at the most: four round
    trips from the last answer, or from the first question after it, until the relay looks and the site hears."""
    stall_s = max(STALL_MIN_S, STALL_RTTS * rtt_s)
    return stall_s - rtt_s, rtt_s / 2 + PING_INTERVAL_S + stall_s + SWEEP_S + site_delay_s


@pytest.mark.parametrize("lossless", [True, False])
@pytest.mark.parametrize("rtt_s", [0.01, 0.05, 0.2, 0.5, 1.5])
def test_how_soon_a_robot_is_gone_depends_on_its_round_trip(rtt_s: float, lossless: bool) -> None:
    """README: four round trips, half a second at the least, and up to a second and a half."""
    world = World(lossless=lossless)
    model = LinkModel(delay_s=rtt_s / 2, blackouts=(Window(20.0, 60.0),))
    robot = world.client("robot", model.as_stream() if lossless else model)
    site = world.client("site", thin(), patterns=["/robot/.*"])
    odom = robot.publish("/robot/odom", spec())
    robot.every(0.1, odom, b"o")
    world.run(20.0)
    assert statuses(site) == {"robot": CONNECTED}
    taken_s = world.until(lambda: statuses(site) == {"robot": GONE})
    measured_s = world.relay.hub.links[robot.name].lane.flight.rtt.srtt_s
    assert measured_s == pytest.approx(rtt_s, abs=0.02)
    low_s, high_s = gone_within_s(measured_s, 0.025)
    assert low_s < taken_s < high_s + 0.01
    assert high_s <= 1.5 + max(0.5, 4 * rtt_s) + rtt_s / 2 + 0.1


@pytest.mark.parametrize("lossless", [True, False])
def test_a_robot_that_falls_silent_is_gone_and_comes_back(lossless: bool) -> None:
    world = World(lossless=lossless)
    model = LinkModel(rate_bps=THIN_BPS, delay_s=0.025, blackouts=(Window(10.0, 20.0),))
    robot = world.client("robot", model.as_stream() if lossless else model)
    site = world.client("site", patterns=["/robot/.*"])
    odom = robot.publish("/robot/odom", spec())
    robot.every(0.1, odom, b"o")
    world.run(9.9)
    assert statuses(site) == {"robot": CONNECTED}
    start_s = world.network.now
    assert world.until(lambda: statuses(site) == {"robot": GONE}) <= gone_within_s(0.06, 0.02)[1]
    world.run(5.0)
    view = peers(site)["robot"]
    assert view.age_s == pytest.approx(world.network.now - start_s - 0.1, abs=0.2)
    assert view.since_s == pytest.approx(5.0, abs=0.5)
    world.until(lambda: site.got[-1].at_s > start_s + 5.0)
    assert world.until(lambda: statuses(site) == {"robot": CONNECTED}) <= 1.5


def test_a_robot_that_the_relay_gives_up_stays_gone_until_it_is_back() -> None:
    world = World(hub_params=HubParams(resume_s=20.0)).watch()
    model = LinkModel(blackouts=(Window(5.0, 100.0),), disconnect_after_s=0.2).as_stream()
    robot = world.client("robot", model)
    site = world.client("site", patterns=["/robot/.*"])
    robot.publish("/robot/odom", spec())
    changes: list[PeerChange] = []
    site.core.peers.on_change = changes.append
    world.run(4.9)
    assert statuses(site) == {"robot": CONNECTED}
    assert world.until(lambda: statuses(site) == {"robot": GONE}) <= 2.0
    gone_s = world.network.now
    world.run(10.0)
    assert statuses(site) == {"robot": GONE} and not peers(site)["robot"].given_up
    world.until(lambda: site.closed, what="the relay lets go of the robot's streams")
    world.until(lambda: peers(site)["robot"].given_up, within_s=2.0)
    assert [change.given_up for change in changes] == [False, False, False, True]
    assert changes[-1].new is GONE and changes[-1].lasted_s == pytest.approx(world.network.now - gone_s, abs=0.1)
    world.run(30.0)
    assert statuses(site) == {"robot": GONE}
    assert peers(site)["robot"].since_s == pytest.approx(world.network.now - gone_s, abs=0.1)
    world.hops["site"].break_connection(reconnect_s=5.0)
    world.until(lambda: statuses(site) == {"robot": UNKNOWN})
    world.until(lambda: statuses(site) == {"robot": GONE})
    assert len(changes) == 6 and peers(site)["robot"].given_up  # said once
    world.until(lambda: statuses(site) == {"robot": CONNECTED}, within_s=100.0)
    assert not peers(site)["robot"].given_up
    world.run(20.0)
    assert len(changes) == 7 and changes[-1].new is CONNECTED  # it was never forgotten in between


def test_a_robot_that_is_given_up_while_our_own_link_is_down_stays_gone() -> None:
    world = World(hub_params=HubParams(resume_s=20.0)).watch()
    robot = world.client("robot", LinkModel(blackouts=(Window(5.0, 1e6),), disconnect_after_s=0.2).as_stream())
    site = world.client("site", patterns=["/robot/.*"])
    robot.publish("/robot/odom", spec())
    world.run(4.9)
    world.until(lambda: statuses(site) == {"robot": GONE})
    world.hops["site"].break_connection(reconnect_s=50.0)
    world.until(lambda: statuses(site) == {"robot": UNKNOWN})
    world.until(lambda: site.closed, within_s=1000.0, what="its streams end here")
    world.until(lambda: statuses(site) == {"robot": GONE}, within_s=2.0)
    assert peers(site)["robot"].given_up
    world.run(2 * LET_GO_S)
    assert statuses(site) == {"robot": GONE}


def test_a_robot_that_was_back_while_our_own_link_was_down_is_not_gone_though_nothing_of_it_is_left() -> None:
    world = World().watch()
    robot = world.client("robot", LinkModel(blackouts=(Window(5.0, 20.0),), disconnect_after_s=0.2).as_stream())
    site = world.client("site", patterns=["/robot/.*"])
    channel = robot.publish("/robot/odom", spec())
    world.run(4.9)
    world.until(lambda: statuses(site) == {"robot": GONE})
    changes: list[PeerChange] = []
    site.core.peers.on_change = changes.append
    world.hops["site"].break_connection(reconnect_s=60.0)
    world.until(lambda: robot.core.link.established, within_s=60.0)
    robot.core.unpublish(channel, now=robot.now)
    world.run(1.0)
    assert statuses(site) == {"robot": UNKNOWN}
    world.until(lambda: statuses(site) == {}, within_s=90.0)
    assert [(change.new, change.given_up, change.forgotten) for change in changes] == [
        (UNKNOWN, False, False),
        (CONNECTED, False, False),
        (CONNECTED, False, True),
    ]
    world.run(2 * LET_GO_S)
    assert statuses(site) == {} and len(changes) == 3


def test_a_robot_that_was_given_up_and_comes_back_with_nothing_for_us_is_gone_no_longer() -> None:
    world = World(hub_params=HubParams(resume_s=20.0)).watch()
    robot = world.client("robot", LinkModel(blackouts=(Window(5.0, 100.0),), disconnect_after_s=0.2).as_stream())
    site = world.client("site", patterns=["/robot/.*"])
    channel = robot.publish("/robot/odom", spec())
    world.run(4.9)
    world.until(lambda: statuses(site) == {"robot": GONE})
    world.until(lambda: peers(site)["robot"].given_up, within_s=60.0)
    robot.core.unpublish(channel, now=robot.now)
    changes: list[PeerChange] = []
    site.core.peers.on_change = changes.append
    world.until(lambda: statuses(site) == {}, within_s=100.0)
    assert robot.core.link.established
    assert [(change.new, change.forgotten) for change in changes] == [(CONNECTED, False), (CONNECTED, True)]


@pytest.mark.parametrize("given_up", [False, True])
@pytest.mark.parametrize("patterns", [(), ("/other/.*",), ("/other/.*", "/robot/map")])
def test_a_site_that_stops_taking_a_lost_robots_topics_forgets_it(patterns: tuple[str, ...], given_up: bool) -> None:
    world = World(hub_params=HubParams(resume_s=20.0)).watch()
    robot = world.client("robot", LinkModel(blackouts=(Window(5.0, 1e6),), disconnect_after_s=0.2).as_stream())
    site = world.client("site", patterns=["/robot/.*"])
    robot.publish("/robot/odom", spec())
    world.run(4.9)
    world.until(lambda: statuses(site) == {"robot": GONE})
    if given_up:
        world.until(lambda: peers(site)["robot"].given_up, within_s=60.0)
        site.subscribe("/other/.*", "/robot/odom")
        world.run(2.0)
        assert peers(site)["robot"].given_up  # still what it wants
    changes: list[PeerChange] = []
    site.core.peers.on_change = changes.append
    site.subscribe(*patterns)
    world.until(lambda: statuses(site) == {}, within_s=3.0)
    assert [(change.given_up, change.forgotten) for change in changes] == [(False, True)]
    world.run(60.0)
    assert statuses(site) == {} and len(changes) == 1
    assert site.core.peers._ended == {}


def test_a_robot_that_ends_its_streams_while_it_is_there_is_let_go() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    channel = robot.publish("/robot/odom", spec())
    world.until(lambda: statuses(site) == {"robot": CONNECTED})
    robot.core.unpublish(channel, now=robot.now)
    world.run(1.0)
    robot.core.link.close("bye", now=robot.now)
    world.run(2 * LET_GO_S)
    assert statuses(site) == {}


@pytest.mark.parametrize("disconnect_after_s", [0.2, 30.0])
def test_while_a_sites_own_link_is_down_nobody_knows_and_ages_grow(disconnect_after_s: float) -> None:
    """Also while its session goes on: it is the silence that counts."""
    world = World().watch()
    robot = world.client("robot")
    model = LinkModel(blackouts=(Window(5.0, 15.0),), disconnect_after_s=disconnect_after_s).as_stream()
    site = world.client("site", model, patterns=["/robot/.*"])
    odom = robot.publish("/robot/odom", spec())
    robot.every(0.1, odom, b"o")
    world.run(4.9)
    world.until(lambda: statuses(site) == {"robot": UNKNOWN}, within_s=2.5)
    began_s = world.network.now
    world.run(3.0)
    assert peers(site)["robot"].since_s == pytest.approx(3.0, abs=0.01)
    assert peers(site)["robot"].age_s == pytest.approx(world.network.now - 5.0 - world.network.start_s, abs=0.3)
    assert world.network.now > began_s
    world.until(lambda: statuses(site) == {"robot": CONNECTED})


def test_a_relay_that_begins_anew_tells_of_who_is_there() -> None:
    world = World().watch()
    changes: list[PeerChange] = []
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    robot.publish("/robot/odom", spec())
    world.until(lambda: statuses(site) == {"robot": CONNECTED})
    site.core.peers.on_change = changes.append
    world.restart_relay()
    world.until(lambda: [change.new for change in changes] == [UNKNOWN, CONNECTED])
    assert {change.name for change in changes} == {"robot"}


@pytest.mark.parametrize("said_gone", [True, False])
def test_a_robot_that_a_new_relay_never_hears_of_is_gone(said_gone: bool) -> None:
    """A robot that was gone is given up at once; one that was there has LET_GO_S to come to the new relay."""
    world = World().watch(0.5)
    robot = world.client("robot", LinkModel(blackouts=(Window(5.0, 1e6),), disconnect_after_s=0.2).as_stream())
    site = world.client("site", patterns=["/robot/.*"])
    robot.publish("/robot/odom", spec())
    world.run(4.9)
    assert statuses(site) == {"robot": CONNECTED}
    if said_gone:
        world.until(lambda: statuses(site) == {"robot": GONE})
    else:
        world.run(0.11)
    world.restart_relay()
    world.run(LET_GO_S / 2)
    assert statuses(site) == {"robot": GONE if said_gone else UNKNOWN}
    world.run(LET_GO_S)
    assert statuses(site) == {"robot": GONE}
    world.until(lambda: site.closed, within_s=1000.0, what="the site's retention is over")
    assert statuses(site) == {"robot": GONE} and peers(site)["robot"].given_up


def robot_at_a_site() -> tuple[World, SimClient, SimClient]:
    """A robot that is connected, and a site that takes its topic; the relay waits 20 s for whoever goes."""
    world = World(hub_params=HubParams(resume_s=20.0)).watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    robot.publish("/robot/odom", spec())
    world.until(lambda: statuses(site) == {"robot": CONNECTED})
    return world, robot, site


def test_a_robot_that_dies_while_our_own_link_is_down_is_gone_and_forgotten_with_its_topics() -> None:
    world, robot, site = robot_at_a_site()
    world.hops["site"].break_connection(reconnect_s=60.0)
    world.until(lambda: statuses(site) == {"robot": UNKNOWN})
    world.network.crash_node(robot)
    world.until(lambda: statuses(site) == {"robot": GONE}, within_s=60.0 + 2 * LET_GO_S)
    assert peers(site)["robot"].given_up
    world.run(2 * LET_GO_S)
    assert statuses(site) == {"robot": GONE}
    site.core.subscribe(("/other/.*",), now=site.now)
    assert statuses(site) == {}


def test_a_robot_that_died_is_gone_though_our_own_link_holds_for_less_than_it_has_to_come() -> None:
    world, robot, site = robot_at_a_site()
    world.hops["site"].break_connection(reconnect_s=30.0)
    world.network.crash_node(robot)
    world.run(30.0)
    for _ in range(2):
        assert statuses(site) == {"robot": UNKNOWN}
        world.run(LET_GO_S / 2)
        world.hops["site"].break_connection(reconnect_s=1.0)
        world.run(5.0)
    assert statuses(site) == {"robot": GONE} and peers(site)["robot"].given_up


def test_a_robot_that_ends_its_topics_while_our_own_link_is_down_is_let_go() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    channel = robot.publish("/robot/odom", spec())
    world.until(lambda: statuses(site) == {"robot": CONNECTED})
    world.hops["site"].break_connection(reconnect_s=10.0)
    world.until(lambda: statuses(site) == {"robot": UNKNOWN})
    robot.core.unpublish(channel, now=robot.now)
    world.until(lambda: statuses(site) == {}, within_s=20.0)


# --- under load -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("loaded", "lossless"),
    [
        (PriorityClass.CONTROL, True), (PriorityClass.CONTROL, False), (PriorityClass.STATE, True),
        (PriorityClass.BULK, False), (None, True), (None, False),
        *also((PriorityClass.STATE, False), (PriorityClass.BULK, True)),
    ],
)  # fmt: skip
def test_at_thirteen_times_what_the_link_carries_a_lost_robot_is_known_at_once(
    loaded: PriorityClass | None, lossless: bool
) -> None:
    """`loaded` None: all classes together. Another robot overloads the site's link; nobody who is there is taken for
    gone meanwhile, and who goes is known within two seconds of the relay's knowing."""
    world = World(lossless=lossless)
    down = LinkModel(rate_bps=THIN_BPS, delay_s=0.025)
    lost = LinkModel(delay_s=0.025, blackouts=(Window(6.0, 14.0),))
    away = world.client("away", lost.as_stream() if lossless else lost)
    loud = world.client("loud")
    site = world.client("site", down.as_stream() if lossless else down, patterns=["/.*/t.*"])
    away.every(0.1, away.publish("/away/t", spec(PriorityClass.STATE)), b"x" * 100)
    classes = list(PriorityClass) if loaded is None else [loaded]
    size = 2000
    period_s = size * 8 * len(classes) / (OVERLOAD * THIN_BPS)
    for number, priority in enumerate(classes):
        loud.every(period_s, loud.publish(f"/loud/t{number}", spec(priority, depth=10)), b"x" * size)
    world.until(lambda: statuses(site) == {"away": CONNECTED, "loud": CONNECTED}, within_s=5.0)
    changes: list[PeerChange] = []
    site.core.peers.on_change = changes.append
    world.run(5.5 - (world.network.now - world.network.start_s))
    assert changes == []
    relay = world.relay.hub.links[away.name]
    world.until(lambda: relay.lane.stalled or not relay.established, within_s=5.0)
    assert world.until(lambda: statuses(site)["away"] is GONE) <= 2.0
    assert statuses(site)["loud"] is CONNECTED
    world.until(lambda: relay.established and not relay.lane.stalled, within_s=30.0)
    assert world.until(lambda: statuses(site)["away"] is CONNECTED) <= 2.0
    assert {change.name for change in changes} == {"away"}
    world.validate()


def test_a_robot_that_overloads_its_own_link_thirteen_times_is_there() -> None:
    world = World()
    robot = world.client("robot", thin())
    site = world.client("site", patterns=["/robot/.*"])
    robot.every(2000 * 8 / (OVERLOAD * THIN_BPS), robot.publish("/robot/t", spec(PriorityClass.BULK)), b"x" * 2000)
    world.until(lambda: statuses(site) == {"robot": CONNECTED}, within_s=5.0)
    changes: list[PeerChange] = []
    site.core.peers.on_change = changes.append
    world.run(30.0)
    assert changes == []


def test_what_flaps_is_told_as_it_is_when_the_site_has_heard_of_what_was_said_before() -> None:
    """Control messages do not pile up: one waits at most, whatever happens meanwhile."""
    world = World()
    robot = world.client("robot")
    site = world.client("site", LinkModel(delay_s=2.0).as_stream(), patterns=["/robot/.*"])
    robot.publish("/robot/odom", spec())
    world.until(lambda: statuses(site) == {"robot": CONNECTED})
    link = world.relay.hub.links[site.name]
    most = 0
    told_before = link.control.out.next_seq
    for _ in range(40):
        world.hops["robot"].break_connection()
        world.run(0.3)
        waiting = len(link.control.out.retained)
        most = max(most, waiting)
    assert most <= 3
    assert link.control.out.next_seq - told_before < 40
    world.run(10.0)
    assert statuses(site) == {"robot": CONNECTED}


def test_many_peers_are_told_in_few_messages() -> None:
    world = World()
    robots = [world.client(f"robot{number}") for number in range(2 * MAX_TOLD + 2)]
    for robot in robots:
        robot.publish(f"/{robot.name}/odom", spec())
    world.run(2.0)
    site = world.client("site", patterns=["/robot.*"])
    world.until(lambda: statuses(site) == {robot.name: CONNECTED for robot in robots})
    world.validate()
