"""The relay matches patterns in slices: what a client subscribes to holds up nobody, and all of it comes in the end."""

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import HubParams
from sern_core.relay.hub_matching import MATCHING_SHARE
from sern_core.relay.interest import ROUTE_UNITS, UNIT_S, RoutingLimits
from tests.fuzz.test_hostile_peer import Hostile
from tests.world import World, spec

HOSTILE = ["/.*a(?:.{0,100}){0,6}!", "/.*b(?:.{0,100}){0,6}!"]


def topics(world: World, count: int) -> None:
    robot = world.client("robot")
    for number in range(count):
        robot.publish(f"/robot/{'ab' * 20}/t{number}", spec())
    world.run(2.0)
    assert len(world.relay.hub.routing.infos()) == count


def test_a_large_interest_is_worked_out_over_time() -> None:
    world = World()
    topics(world, 400)
    site = world.client("site", patterns=[".*"])
    seen: list[int] = []
    cancel = world.network.every(0.002, lambda _now: seen.append(len(site.opened))).cancel
    world.until(lambda: len(site.opened) == 400, within_s=5.0, what="all topics at the site")
    cancel()
    assert len(set(seen)) > 3  # not all at once
    assert not world.relay.hub.matching.due_s
    site.subscribe()
    world.until(lambda: len(site.closed) == 400, within_s=5.0, what="no topic at the site")
    assert not world.relay.hub.matching.due_s
    world.validate()


def test_a_client_without_a_connection_gets_its_turn_too() -> None:
    """It asked, and its TCP connection is lost while the relay works on it."""
    world = World()
    topics(world, 400)
    site = world.client("site", patterns=[".*"])
    hub = world.relay.hub
    world.until(lambda: hub.matching.due_s, within_s=2.0, what="a slice")
    world.relay.port(site.name).disconnected(now=world.relay.now)
    world.run(30.0)
    assert not hub.matching.due_s
    assert len(hub.routing.received_by(site.name)) == 400
    hub.validate()


def flood(world: World, mallory: Hostile, *, subscriptions: int) -> list[int]:
    """Subscribe differently so many times in a second; the units of each piece of work that the relay did for them."""
    hub = world.relay.hub
    done: list[int] = []
    for number in range(subscriptions):
        before = hub.routing.spent.units = 0
        mallory.control({"t": "subscribe", "patterns": [f"/x{number}.+", *HOSTILE], "more": False})
        mallory.now += 1.0 / subscriptions
        mallory.port.handle_timeout(now=mallory.now)
        if hub.routing.spent.units != before:
            done.append(hub.routing.spent.units)
    return done


def test_a_flood_of_subscriptions_is_worth_its_share_of_time() -> None:
    world = World()
    topics(world, 300)
    mallory = Hostile(world, "mallory")
    mallory.now = world.relay.now
    done = flood(world, mallory, subscriptions=500)
    assert len(done) > 2
    assert max(done) < 1.5 * RoutingLimits().slice_units
    assert sum(done) * UNIT_S < 1.1 * MATCHING_SHARE + RoutingLimits().slice_units * UNIT_S
    while (due_s := world.relay.hub.matching.due_s.get(mallory.name)) is not None:
        mallory.port.handle_timeout(now=due_s)
    assert "/x499.+" in world.relay.hub.routing.interest._interests[mallory.name].patterns.texts  # the last one counts
    world.relay.hub.validate()


def test_without_rights_patterns_cost_next_to_nothing() -> None:
    world = World(access=AccessTable([AccessRule("robot", publish=("/robot/.*",))]))
    topics(world, 300)
    mallory = Hostile(world, "mallory")
    mallory.now = world.relay.now
    mallory.control({"t": "subscribe", "patterns": [".?" * 26 + "!"], "more": False})
    hub = world.relay.hub
    assert hub.routing.spent.units < 0.2 * RoutingLimits().slice_units
    assert not hub.matching.due_s


def test_new_access_rules_are_worked_out_over_time() -> None:
    world = World(hub_params=HubParams(routing=RoutingLimits(slice_units=10 * ROUTE_UNITS)))
    topics(world, 100)
    sites = [world.client(name, patterns=["/.*[ab].*"]) for name in ("site1", "site2", "site3")]
    world.run(2.0)
    hub = world.relay.hub
    hub.revoke(AccessTable([AccessRule("robot", publish=(".*",))]), now=world.relay.now)
    assert all(hub.routing.received_by(site.name) == () for site in sites)  # what is taken away goes at once
    hub.revoke(AccessTable([AccessRule(".*", publish=(".*",), subscribe=(".*",))]), now=world.relay.now)
    assert hub.matching.due_s
    world.run(5.0)
    assert all(len(hub.routing.received_by(site.name)) == 100 for site in sites)
    assert not hub.matching.due_s
    world.validate()
