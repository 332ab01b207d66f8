"""Several relay cores, each with its clients, in the virtual-time network: every two relays have a hop."""

from collections.abc import Iterable, Iterator
from itertools import combinations

from sern_core.link.link import Link
from sern_core.objects.feed import PERIOD_S
from sern_core.vocabulary.names import is_peer, peer_name
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import ClientName
from sern_sim.models import LinkModel
from sern_sim.ports import Port
from tests.world import Clock, SimClient, SimHub, World


class FabricWorld(World):
    """`relays` by name. The relay of a plain world is none of them. `between`: what carries datagrams from one to
    another."""

    def __init__(self, relays: Iterable[str], seed: int = 1, *, between: LinkModel | None = None) -> None:
        super().__init__(seed)
        self.relays = {name: SimHub(self, boot=self._boot(), name=name) for name in relays}
        self.at: dict[str, str] = {}
        """The relay of each client."""
        for one, other in combinations(sorted(self.relays), 2):
            a, b = self.relays[one], self.relays[other]
            model = between or LinkModel(delay_s=0.01).as_stream()
            self.hops[f"{one}-{other}"] = self.network.join(
                a.peer_port(other), a, b.peer_port(one), b, model, model, name=f"{one}-{other}"
            )
        self.network.every(PERIOD_S, self._ask)

    def _ask(self, _now: float) -> None:
        for relay in self.relays.values():
            relay.hub.tell_objects(now=relay.now)

    def _sweep(self, now: float) -> None:
        super()._sweep(now)
        for relay in self.relays.values() if hasattr(self, "relays") else ():
            relay.hub.sweep(now=relay.now)
            while relay.hub.lapse(now=relay.now):
                pass

    def client_at(
        self, relay: str, name: str, link: LinkModel | None = None, *, patterns: Iterable[str] = ()
    ) -> SimClient:
        """A client that connects to that relay now."""
        client = self._process(name, Clock(), SchedulerParams(), patterns)
        hub = self.relays[relay]
        wire = link or LinkModel().as_stream()
        self.hops[name] = self.network.join(
            client.port, client, hub.port(client.name), hub, wire, wire, name=f"{name}-{relay}"
        )
        self.at[name] = relay
        return client

    def restart(self, name: str) -> None:
        """kill -9 of a relay: a new process in its place that knows nothing."""
        old = self.relays[name]
        new = self.relays[name] = SimHub(self, boot=self._boot(), name=name)
        pairs: list[tuple[Port, Port]] = []
        for side, port in old.sides.items():
            pairs.append((port, new.peer_port(side[1:]) if is_peer(side) else new.port(side)))
        self.network.replace_node(old, new, pairs)

    def links(self) -> Iterator[Link]:
        yield from (client.core.link for client in self.clients.values())
        for relay in self.relays.values():
            yield from relay.links()

    def validate(self) -> None:
        super().validate()
        for relay in self.relays.values():
            relay.hub.validate()

    def peers_up(self) -> bool:
        return all(
            relay.hub.links[peer_name(ClientName(other))].established
            for name, relay in self.relays.items()
            for other in self.relays
            if other != name
        )
