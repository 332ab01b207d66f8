"""Weeks of clients that come and go: what is kept of them ends as small as it began, and is bounded under way.

Time is virtual and jumps between visits. Each visit is of clients with new boots, stream names, definitions, objects
and subscriptions, of which some leave without a word, some never fetch what waits for them, and some are refused.
"""

import gc
from collections import Counter
from random import Random

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import HubParams
from sern_core.site.peers import LET_GO_S
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import CLASSES, ClientName, Encoding, ObjectKind, TopicName
from tests.sizes import sizes
from tests.world import Clock, SimClient, World, spec

RULES = AccessTable(
    [
        AccessRule(client="secret.*", publish=("/{self}/.*",), max_rate_hz=5.0),
        AccessRule(client=".*", publish=("/{self}/.*", "/tf", "/shared/.*"), subscribe=("/[^s].*", "/s[^e].*")),
    ]
)
VISITS = 10
PAUSE_S = 2 * 24 * 3600.0
STATIC = frozenset(
    {
        ".clients.access._cache",  # decisions, at most CACHE_ENTRIES
        ".clients.access._grants",
        ".clients.access._grants[][]._exact",
        ".objects._log._deletions",  # a ring
        ".link.lanes.clock._stepped",  # a ring
        ".link.taking._had",  # where reliable streams ended: at most MAX_REMEMBERED
        ".exchange.counts",  # outcomes, of which there are eight
        ".objects.registry._log._deletions",  # of a client's own
        ".presence._watchers[].missing",  # those that a client shows as gone, in its session: at most MAX_ASKED
        ".peers._ended",  # those of whom is shown that they are gone: at most MAX_GIVEN_UP, with MAX_ENDED topics each
        ".peers._ended[]",
        ".peers._heard_s",
        ".peers._peers",
        ".trace._rings",  # DEFAULT_MAX_BYTES of all together
        ".trace._rings[]",
        ".trace._rings[][][]",
        ".received.topics[].by_reason",  # one row with all topics that have ended
    }
)
"""Tables of a fixed size that fill up and stay."""


def relay_sizes(world: World) -> Counter[str]:
    hub = world.relay.hub
    return sizes(hub, stop=lambda path, value: value is world.relay or value is world or path.startswith(".events"))


def core_sizes(client: SimClient) -> Counter[str]:
    return sizes(client.core, stop=lambda path, value: value is client or value is client.world)


def tidy(world: World) -> None:
    """Time goes by in which nobody comes: longer than anything is kept."""
    for _ in range(3):
        skip(world, 3700.0)
        world.run(1.0)
    world.run(LET_GO_S + 3.0)
    for client in world.clients.values():
        client.core.look_at_peers(now=client.now)  # as its daemon does twice a second
    gc.collect()


def skip(world: World, seconds: float) -> None:
    """Let time pass in which all connections are down and nothing happens: every clock jumps."""
    for hop in world.hops.values():
        hop.break_connection(reconnect_s=2.0)
    world.run(1.0)
    later = Clock(world.relay.clock.offset_s + seconds)
    world.relay.clock = later
    for port in world.relay.sides.values():
        port.clock = later
    for client in world.clients.values():
        client.clock = client.port.clock = later
    world.run(2.5)


class Visits:
    """What comes to the relay, from day to day."""

    def __init__(self, world: World, seed: int) -> None:
        self.world = world
        self.random = Random(seed)
        self.day = 0

    def visit(self) -> None:
        world, random = self.world, self.random
        self.day += 1
        robot = self.come(f"robot{self.day % 3}", [f"/tf{self.day}", "/shared/.*"])
        site = self.come(f"site{self.day % 3}", ["/robot.*", "/secret/x", f"/x{self.day}.*"])
        secret = self.come(f"secret{self.day % 2}", [".*"])
        odd = self.come(f"odd{self.day % 2}", ["/(a", *(f"/n{self.day}_{n}" for n in range(5))])
        world.run(0.5)
        channels = []
        for index in range(6):
            name = f"/{robot.name}/t{self.day}_{index}"
            channels.append(
                robot.publish(
                    name,
                    spec(random.choice(CLASSES), reliable=index % 2 == 0, latched=index == 3, retention_s=900),
                    f"uint8 day{self.day}_{index}\n",
                )
            )
        secrets = [secret.publish(f"/{secret.name}/t{self.day}", spec(reliable=True), f"uint8 secret{self.day}\n")]
        odd.publish(f"/robot0/stolen{self.day}", spec(reliable=True))
        odd.publish("/tf", spec(many_writers=True))
        for object_id in (f"/{robot.name}/o{self.day}@{robot.name}", f"node:{robot.name}", "node:other", "forbidden"):
            robot.core.objects.put(
                object_id, ObjectKind.NODE, "a", attributes={"a": "b"}, value=b"x" * 100, wall_ns=0, now=robot.now
            )
        world.run(1.0)
        for _ in range(8):
            for channel in channels:
                robot.send(channel, bytes(random.choice([1, 100, 2000])))
            for channel in secrets:  # above its rate
                secret.send(channel, b"x")
            world.run(0.05)
        self.local()
        site.subscribe(f"/{robot.name}/t{self.day}_0")
        world.run(0.5)
        world.hops[str(site.name)].break_connection(reconnect_s=60.0)
        for channel in channels[:3]:
            robot.send(channel, b"owed")
        world.run(0.5)
        robot.core.unpublish(channels.pop(), now=robot.now)
        world.run(0.5)
        for client in (robot, secret, odd):
            if random.random() < 0.7:
                client.core.link.close("bye", now=client.now)
        world.run(1.0)

    def come(self, name: str, patterns: list[str]) -> SimClient:
        """A client of this name: a new process, with a new boot."""
        if name in self.world.clients:
            self.world.hops[name].break_connection(reconnect_s=0.0)
            return self.world.restart_client(name, patterns=patterns)
        return self.world.client(name, patterns=patterns)

    def local(self) -> None:
        """A stream of the relay itself, as its feed has."""
        hub, now = self.world.relay.hub, self.world.relay.now
        info = TopicInfo(
            TopicName(f"/shared/feed{self.day}"), "a/b", Encoding.CDR, definition=f"uint8 feed{self.day}\n"
        )
        handle = hub.local.open(info, spec(reliable=True), ClientName("feed"), now=now)
        hub.local.inject(handle, b"x", 0, now=now)
        self.world.run(0.1)
        hub.local.close(handle, now=self.world.relay.now)


def test_tables_end_as_small_as_they_began() -> None:
    world = World(access=RULES, hub_params=HubParams(resume_s=600.0))
    hub = world.relay.hub
    world.tell_objects()
    stays = world.client("stays", patterns=["/robot.*"])
    kept = stays.publish("/stays/kept", spec())
    world.run(5.0)
    tidy(world)
    began, stays_began = relay_sizes(world), core_sizes(stays)
    visits = Visits(world, 1)
    most: Counter[str] = Counter()
    first_half: Counter[str] = Counter()
    for day in range(VISITS):
        visits.visit()
        assert {"forbidden", "bad_pattern", "not_owner"} <= {code for code, _text in world.relay.refusals}
        for path, count in relay_sizes(world).items():
            most[path] = max(most[path], count)
        if day == VISITS // 2 - 1:
            first_half = most.copy()
        skip(world, PAUSE_S)
        world.until(lambda: hub.links[stays.name].established)
    world.validate()
    assert hub.received.topics and sum(c.delivered for c in hub.received.topics.values()) > VISITS * 20
    for name in list(world.clients):
        if name != "stays":
            world.network.crash_node(world.clients[name])
    world.hops = {"stays": world.hops["stays"]}
    tidy(world)
    world.until(lambda: kept.ready and kept.wanted is False)
    grown = {path: (began[path], count) for path, count in relay_sizes(world).items() if count > began[path] + 2}
    assert not {path: counts for path, counts in grown.items() if path not in STATIC}, grown
    grown = {p: (stays_began[p], count) for p, count in core_sizes(stays).items() if count > stays_began[p] + 2}
    assert not {path: counts for path, counts in grown.items() if path not in STATIC}, grown
    # Under way nothing grows with the days: the second half needs no more room than the first.
    more = {path: (first_half[path], count) for path, count in most.items() if count > 1.3 * first_half[path] + 20}
    assert not {path: counts for path, counts in more.items() if path not in STATIC}, more
