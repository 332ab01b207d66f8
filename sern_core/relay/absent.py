"""Clients that reliable streams require and that have not come back since an earlier run of the relay. Pure."""

from collections.abc import Callable, Container, Sequence
from typing import Final

from sern_core.link.link import Link
from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import GuardedEvents
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.route_change import Denied, Match, RouteChange
from sern_core.relay.routing import RoutingTable
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.limits import PeerLimits
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.names import is_client_name
from sern_core.vocabulary.types import ClientName, TopicName

ABSENT_US: Final = 50
NAMES_PER_US: Final = 2
"""What an origin is charged with, in microseconds: to wait for a client that a stream requires, and how many names of
such clients are looked at in one."""
MAX_ABSENT_CLIENTS: Final = 1024
"""Clients that have not come back yet and are waited for."""


class AbsentClients:
    """`known` says whether a name is in the directory of clients."""

    def __init__(
        self,
        clients: Clients,
        streams: RelayedStreams,
        routing: RoutingTable,
        events: GuardedEvents,
        known: Callable[[ClientName], bool],
        limits: PeerLimits,
    ) -> None:
        self._clients = clients
        self._streams = streams
        self._routing = routing
        self._events = events
        self.known = known
        self._most_topics = limits.absent_topics
        self._topics: dict[ClientName, set[TopicName]] = {}
        self._subscribed: set[ClientName] = set()  # said what they want, to this run of the relay

    def __len__(self) -> int:
        return len(self._topics)

    def subscribed(self, client: ClientName) -> None:
        """The client has said what it wants."""
        self._topics.pop(client, None)
        self._subscribed.add(client)

    def asked(self, client: ClientName) -> bool:
        """Whether the client has said what it wants."""
        return client in self._subscribed

    def forget(self, client: ClientName) -> None:
        """The client is given up."""
        self._topics.pop(client, None)
        self._subscribed.discard(client)

    def hold(self, required: Sequence[str], identity: StreamId, source: Link, now: float) -> None:
        """Hold a reliable stream for the clients of these names, which an earlier run of this relay required."""
        source.reassembly.work_us += len(required) // NAMES_PER_US
        own: list[Match] = []
        others: list[Match] = []  # of the same name (many_writers)
        denied: list[Denied] = []
        known = self._routing.info(identity) is not None
        for text in required:
            client = ClientName(text)
            # Connected is not enough: it may not have come to say what it wants yet.
            if client in self._subscribed or client == identity.origin:
                continue
            if known and self._streams.moves.settled(identity, client):
                continue
            if not is_client_name(client) or not self.known(client):
                continue
            if client not in self._clients.links and len(self._topics) >= MAX_ABSENT_CLIENTS:
                continue
            source.reassembly.work_us += ABSENT_US
            self._clients.link(client, now)
            topics = self._topics.setdefault(client, set())
            if len(topics) >= self._most_topics and identity.topic not in topics:
                continue
            topics.add(identity.topic)
            if not known or client in self._routing.subscribers(identity):
                continue
            try:
                change = self._routing.also(client, identity.topic)
            except RefusedError as refusal:
                self._events.refused(client, refusal.code, str(refusal))
                continue
            denied += change.denied
            for match in change.matched:
                (own if match.stream == identity else others).append(match)
        self._streams.apply(RouteChange(matched=tuple(others), denied=tuple(denied)), now)
        self._streams.apply(RouteChange(matched=tuple(own)), now, source=source)

    def validate(self, clients: Container[ClientName]) -> None:
        """Internal consistency, for tests."""
        for table in (self._topics, self._subscribed):
            assert all(client in clients for client in table), "something is kept for clients that are forgotten"
        assert all(len(topics) <= self._most_topics for topics in self._topics.values()), "too much is held"
