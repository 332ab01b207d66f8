"""Several relay cores, each with its clients, in the virtual-time network: every two relays have a hop."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations

from sern_core.link.link import Link
from sern_core.objects.feed import PERIOD_S
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import HubParams
from sern_core.vocabulary.names import is_peer, peer_name
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import ClientName
from sern_sim.models import LinkModel
from sern_sim.ports import Port
from tests.world import Clock, SimClient, SimHub, World


class RoamingPort:
    """A client's end of its hop to one relay of several. Only the one that it is `at` leads to it."""

    def __init__(self, client: SimClient, at: dict[str, str], relay: str) -> None:
        self._client = client
        self._at = at
        self._relay = relay
        self.reached = False

    @property
    def here(self) -> bool:
        return self._at[self._client.name] == self._relay

    @property
    def dirty(self) -> bool:
        return self.here and self._client.port.dirty

    def receive(self, data: bytes, *, now: float) -> None:
        if self.here:
            self._client.port.receive(data, now=now)

    def next_datagram(self, *, now: float) -> bytes | None:
        return self._client.port.next_datagram(now=now) if self.here else None

    def next_deadline(self) -> float | None:
        return self._client.port.next_deadline() if self.here else None

    def handle_timeout(self, *, now: float) -> None:
        if self.here:
            self._client.port.handle_timeout(now=now)

    def connected(self, *, now: float) -> None:
        self.reached = True
        if self.here:
            self._client.port.connected(now=now)

    def disconnected(self, *, now: float) -> None:
        self.reached = False
        if self.here:
            self._client.port.disconnected(now=now)


class FabricWorld(World):
    """`relays` by name. The relay of a plain world is none of them. `between`: what carries datagrams from one to
    another. `rules`: the access rules of those relays that have not those of the world."""

    def __init__(
        self,
        relays: Iterable[str],
        seed: int = 1,
        *,
        between: LinkModel | None = None,
        rules: Mapping[str, Sequence[AccessRule]] | None = None,
        hub_params: HubParams | None = None,
    ) -> None:
        super().__init__(seed, hub_params=hub_params)
        self.rules = dict(rules or {})
        self.relays = {name: self._relay(name) for name in relays}
        self.at: dict[str, str] = {}
        """The relay of each client."""
        self.roaming: dict[tuple[str, str], RoamingPort] = {}
        for one, other in combinations(sorted(self.relays), 2):
            a, b = self.relays[one], self.relays[other]
            model = between or LinkModel(delay_s=0.01).as_stream()
            self.hops[f"{one}-{other}"] = self.network.join(
                a.peer_port(other), a, b.peer_port(one), b, model, model, name=f"{one}-{other}"
            )
        self.network.every(PERIOD_S, self._ask)

    def _relay(self, name: str) -> SimHub:
        rules = self.rules.get(name)
        return SimHub(self, boot=self._boot(), name=name, access=None if rules is None else AccessTable(rules))

    def reload(self, name: str, *rules: AccessRule) -> None:
        """A relay reads these access rules, as soon as the world runs on."""
        self.rules[name] = rules
        relay = self.relays[name]
        self.network.after(0.0, lambda _now: relay.hub.revoke(AccessTable(rules), now=relay.now), node=relay)

    def _ask(self, _now: float) -> None:
        for relay in self.relays.values():
            relay.hub.tell_objects(now=relay.now)
        for client in self.clients.values():
            client.core.objects.pump(now=client.now)

    def _sweep(self, now: float) -> None:
        super()._sweep(now)
        for relay in self.relays.values() if hasattr(self, "relays") else ():
            relay.hub.sweep(now=relay.now)
            while relay.hub.lapse(now=relay.now):
                pass

    def client_at(
        self,
        relay: str,
        name: str,
        link: LinkModel | None = None,
        *,
        patterns: Iterable[str] = (),
        among: Iterable[str] | None = None,
    ) -> SimClient:
        """A client that connects to that relay now, and may move to the others, or to those `among` them."""
        client = self._process(name, Clock(), SchedulerParams(), patterns)
        wire = link or LinkModel().as_stream()
        self.at[name] = relay
        client.more_ports = []
        for other in self.relays if among is None else among:
            hub = self.relays[other]
            port = self.roaming[name, other] = RoamingPort(client, self.at, other)
            client.more_ports.append(port)
            self.hops[f"{name}-{other}"] = self.network.join(
                port, client, hub.port(client.name), hub, wire, wire, name=f"{name}-{other}"
            )
        return client

    def rival_at(self, relay: str, name: str) -> SimClient:
        """Another process of a client's name, which connects to that relay now, where the client never is."""
        own = self.clients[name]
        rival = self._process(name, Clock(), SchedulerParams(), ())
        self.clients[name] = own
        self.clients[f"{name}_rival"] = rival
        hub, wire = self.relays[relay], LinkModel().as_stream()
        port = RoamingPort(rival, {name: relay}, relay)
        rival.more_ports = [port]
        self.hops[f"{name}_rival"] = self.network.join(
            port, rival, hub.port(rival.name), hub, wire, wire, name=f"{name}_rival"
        )
        return rival

    def move(self, name: str, relay: str) -> None:
        """The client goes over to another relay, as one does whose relay does not answer."""
        old, new = self.roaming[name, self.at[name]], self.roaming[name, relay]
        now = self.now
        if old is new:
            return
        if old.reached:
            self.clients[name].port.disconnected(now=now)
        self.at[name] = relay
        if new.reached:
            self.clients[name].port.connected(now=now)

    def restart_client(self, name: str, *, patterns: Iterable[str] | None = None) -> SimClient:
        """kill -9 of a client: a new process in its place that knows nothing, at the same relay."""
        old = self.clients[name]
        new = self._process(
            name, old.clock, SchedulerParams(), old.core.subscription.patterns if patterns is None else patterns
        )
        new.more_ports = []
        pairs: list[tuple[Port, Port]] = []
        for relay in self.relays:
            port = RoamingPort(new, self.at, relay)
            pairs.append((self.roaming[name, relay], port))
            self.roaming[name, relay] = port
            new.more_ports.append(port)
        self.network.replace_node(old, new, pairs)
        return new

    def restart(self, name: str) -> None:
        """kill -9 of a relay: a new process in its place that knows nothing."""
        old = self.relays[name]
        new = self.relays[name] = self._relay(name)
        pairs: list[tuple[Port, Port]] = []
        for side, port in old.sides.items():
            pairs.append((port, new.peer_port(side[1:]) if is_peer(side) else new.port(side)))
        self.network.replace_node(old, new, pairs)

    def links(self) -> Iterator[Link]:
        yield from (client.core.link for client in self.clients.values())
        for relay in self.relays.values():
            yield from relay.links()

    def watch(self, period_s: float = 0.1) -> "FabricWorld":
        super().watch(period_s)
        return self

    def validate(self) -> None:
        super().validate()
        for relay in self.relays.values():
            relay.hub.validate()

    def homes(self, name: str) -> list[str]:
        """The relays at which a client has a session."""
        client = ClientName(name)
        links = {relay: hub.hub.links.get(client) for relay, hub in self.relays.items()}
        return [relay for relay, link in links.items() if link is not None and link.established]

    def settled(self) -> bool:
        """Everybody is connected, and nothing of a reliable stream waits anywhere, also for nobody."""
        if not self.peers_up() or any(self.homes(name) != [relay] for name, relay in self.at.items()):
            return False
        return not any(
            channel.retained for link in self.links() for channel in link.sender.channels.values() if channel.reliable
        )

    def peers_up(self) -> bool:
        links = (
            relay.hub.links.get(peer_name(ClientName(other)))
            for name, relay in self.relays.items()
            for other in self.relays
            if other != name
        )
        return all(link is not None and link.established for link in links)
