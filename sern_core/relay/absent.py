"""Clients that an earlier run of the relay owed messages to, and that have not come back yet. Pure."""

from collections.abc import Callable, Container, Sequence
from typing import Final

from sern_core.link.link import Link
from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import GuardedEvents
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.routing import Denied, Match, RouteChange, RoutingTable
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.limits import PeerLimits
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.names import is_client_name
from sern_core.vocabulary.types import ClientName, TopicName

AWAIT_US: Final = 50
OWED_PER_US: Final = 2
"""What an origin is charged with, in microseconds: to wait for a client that is owed a stream, and how many names of
such clients are looked at in one."""
MAX_AWAITED_CLIENTS: Final = 1024
"""Clients that have not come back yet and are waited for."""


class Awaited:
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
        self._most_topics = limits.awaited_topics
        self._topics: dict[ClientName, set[TopicName]] = {}
        self._heard: set[ClientName] = set()  # said what they want, to this run of the relay

    def __len__(self) -> int:
        return len(self._topics)

    def heard(self, client: ClientName) -> None:
        """The client has said what it wants."""
        self._topics.pop(client, None)
        self._heard.add(client)

    def forget(self, client: ClientName) -> None:
        """The client is given up."""
        self._topics.pop(client, None)
        self._heard.discard(client)

    def hold(self, owed: Sequence[str], identity: StreamId, source: Link, now: float) -> None:
        """Hold a reliable stream for the clients of these names to whom an earlier run of this relay owed it."""
        source.reassembly.work_us += len(owed) // OWED_PER_US
        own: list[Match] = []
        others: list[Match] = []  # of the same name (many_writers)
        denied: list[Denied] = []
        for text in owed:
            client = ClientName(text)
            # Connected is not enough: it may not have come to say what it wants yet.
            if client in self._heard or client == identity.origin:
                continue
            if not is_client_name(client) or not self.known(client):
                continue
            if client not in self._clients.links and len(self._topics) >= MAX_AWAITED_CLIENTS:
                continue
            source.reassembly.work_us += AWAIT_US
            self._clients.link(client, now)
            topics = self._topics.setdefault(client, set())
            if len(topics) >= self._most_topics and identity.topic not in topics:
                continue
            topics.add(identity.topic)
            if self._routing.info(identity) is None or client in self._routing.subscribers(identity):
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
        for table in (self._topics, self._heard):
            assert all(client in clients for client in table), "something is kept for clients that are forgotten"
        assert all(len(topics) <= self._most_topics for topics in self._topics.values()), "too much is awaited"
