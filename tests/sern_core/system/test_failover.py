"""Two relays that do not know of each other, and clients that go from one to the other and back, in any order."""

from collections.abc import Callable
from itertools import permutations

import pytest

from sern_core.relay.hub_port import HubPort
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import ClientName
from sern_sim.models import LinkModel
from sern_sim.ports import Port
from tests.world import SimClient, SimHub, World, spec

A, B = 0, 1
WIRE = LinkModel(rate_bps=10e6, delay_s=0.02).as_stream()


class Switch:
    """What a client is connected to: a port of the one relay or of the other."""

    def __init__(self, relays: list[SimHub], client: ClientName) -> None:
        self.at = A
        self._ports = [HubPort(relay.hub, client) for relay in relays]

    @property
    def port(self) -> HubPort:
        return self._ports[self.at]

    @property
    def dirty(self) -> bool:
        return self.port.dirty

    def receive(self, data: bytes, *, now: float) -> None:
        self.port.receive(data, now=now)

    def next_datagram(self, *, now: float) -> bytes | None:
        return self.port.next_datagram(now=now)

    def next_deadline(self) -> float | None:
        return self.port.next_deadline()

    def handle_timeout(self, *, now: float) -> None:
        self.port.handle_timeout(now=now)

    def connected(self, *, now: float) -> None:
        self.port.connected(now=now)

    def disconnected(self, *, now: float) -> None:
        self.port.disconnected(now=now)


class Relays:
    """Both relays, as one node of the network."""

    def __init__(self, *names: str) -> None:
        self.world = world = World()
        self.hubs = [world.relay, SimHub(world, boot=2)]
        self.switches: dict[str, Switch] = {}
        self.clients: dict[str, SimClient] = {}
        self.stop_playing: Callable[[], None] = lambda: None
        for name in names:
            client = self.clients[name] = SimClient(ClientName(name), world, world.relay_clock)
            client.start(
                boot=len(self.clients), lossless=True, link=world.link, scheduler=SchedulerParams(), coder=None
            )
            world.clients[name] = client
            self.switches[name] = Switch(self.hubs, client.name)
        for name, client in self.clients.items():
            world.hops[name] = world.network.join(client.port, client, self.switches[name], self, WIRE, WIRE, name=name)
        world.network.every(1.0, self._sweep)
        world.watch()

    def ports(self) -> list[Port]:
        return list(self.switches.values())

    def _sweep(self, now: float) -> None:
        for each in self.hubs:
            each.hub.sweep(now=now)
            each.hub.validate()

    def move(self, name: str, to: int, *, clean: bool = True) -> None:
        """A client goes to a relay. `clean`: it says goodbye to the one it leaves."""
        client, hop = self.clients[name], self.world.hops[name]
        if clean:
            client.core.link.close("goes to another relay", now=client.now, moved=True)
            left = self.switches[name].port
            self.world.until(lambda: left.link is None or not left.link.established)
        hop.break_connection(reconnect_s=0.1)
        self.switches[name].at = to

    def remembered(self, at: int) -> set[str]:
        """Whom a relay remembers."""
        return set(self.hubs[at].hub.links)


def playing(relays: Relays) -> OutChannel:
    """The robot publishes a numbered reliable stream, forty messages a second, that the site wants."""
    robot, site = relays.clients["robot"], relays.clients["site"]
    site.subscribe("/robot/.*")
    log = robot.publish("/robot/log", spec(reliable=True))
    relays.world.until(lambda: log.required == ("site",))
    relays.stop_playing = robot.every(0.025, log, bytes(50))
    relays.world.run(1.0)
    return log


def whole_and_once(relays: Relays, log: OutChannel) -> None:
    """What was sent until now arrives, once and in order, and no more."""
    site, sent = relays.clients["site"], log.next_seq - 1
    relays.world.until(lambda: log.watermark >= sent)
    seqs = site.seqs("/robot/log")
    assert seqs == list(range(1, len(seqs) + 1)) and len(seqs) >= sent
    assert not relays.clients["robot"].dropped_out


@pytest.mark.parametrize("order", list(permutations(("robot", "site"))))
@pytest.mark.parametrize("apart_s", [0.0, 0.5, 5.0])
@pytest.mark.parametrize("clean", [True, False])
def test_a_reliable_stream_is_whole_and_once_there_and_back(
    order: tuple[str, ...], apart_s: float, clean: bool
) -> None:
    relays = Relays("robot", "site")
    log = playing(relays)
    for to in (B, A, B, A):
        for name in order:
            relays.move(name, to, clean=clean and to == A)
            relays.world.run(apart_s)
        whole_and_once(relays, log)
        relays.world.run(1.0)


@pytest.mark.parametrize("order", list(permutations(("robot", "site"))))
def test_a_relay_that_all_have_left_cleanly_forgets_them(order: tuple[str, ...]) -> None:
    relays = Relays("robot", "site")
    log = playing(relays)
    first, second = order
    relays.move(first, B)
    relays.world.run(3.0)
    assert relays.remembered(A) >= {first}, "what it has, or owes, is needed by the one that is still here"
    relays.move(second, B)
    relays.world.until(lambda: not relays.remembered(A))
    whole_and_once(relays, log)


def test_a_client_that_others_here_do_not_need_is_forgotten_though_they_stay() -> None:
    relays = Relays("robot", "site", "other")
    playing(relays)
    relays.clients["other"].publish("/other/log", spec(reliable=True))
    relays.clients["other"].subscribe("/nothing")
    relays.world.run(1.0)
    relays.move("other", B)
    relays.world.until(lambda: "other" not in relays.remembered(A))
    assert relays.remembered(A) == {"robot", "site"}


def test_who_is_left_behind_is_told_that_its_peer_has_moved() -> None:
    relays = Relays("robot", "site")
    playing(relays)
    peers = relays.clients["site"].core.peers
    assert not peers.moved
    relays.move("robot", B)
    relays.world.until(lambda: peers.moved == {"robot"}, within_s=0.5)
    relays.move("site", B)
    assert not peers.moved
    relays.move("robot", A, clean=False)
    relays.world.run(2.0)
    assert not peers.moved, "that one may be back at any time"


def test_a_client_that_breaks_off_is_waited_for_as_ever() -> None:
    relays = Relays("robot", "site")
    playing(relays)
    for name in ("robot", "site"):
        relays.move(name, B, clean=False)
    relays.world.run(20.0)
    assert relays.remembered(A) == {"robot", "site"}


def test_what_an_ended_robot_left_for_a_site_is_kept_when_the_site_moves() -> None:
    relays = Relays("robot", "site")
    log = playing(relays)
    site = relays.clients["site"]
    relays.move("site", B)
    relays.world.run(1.0)
    relays.stop_playing()
    relays.clients["robot"].core.unpublish(log, now=relays.clients["robot"].now)
    relays.world.run(1.0)
    relays.move("robot", B)
    relays.world.run(10.0)
    assert "site" in relays.remembered(A)
    had = len(site.seqs("/robot/log"))
    relays.move("site", A)
    relays.world.until(lambda: len(site.seqs("/robot/log")) > had)


def test_latched_messages_and_objects_are_those_of_the_relay_that_one_is_at() -> None:
    relays = Relays("robot", "site")
    robot, site = relays.clients["robot"], relays.clients["site"]
    site.subscribe("/robot/.*")
    plan = robot.publish("/robot/map", spec(reliable=True, latched=True))
    robot.send(plan, b"one")
    relays.world.until(lambda: site.seqs("/robot/map") == [1])
    for to in (B, A):
        for name in ("site", "robot"):
            relays.move(name, to, clean=False)
        relays.world.run(2.0)
        robot.send(plan, b"next")
        relays.world.until(lambda: site.seqs("/robot/map")[-1] == plan.next_seq - 1)
    assert site.seqs("/robot/map") == [1, 2, 3]
    hub = relays.hubs[A].hub
    assert not hub.links[site.name].end.resumed, "what it was told here it may have forgotten there"
