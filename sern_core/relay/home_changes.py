"""What the relay does when a client has come to another relay, or has left it. Pure."""

from sern_core.relay.absent import AbsentClients
from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import GuardedEvents
from sern_core.relay.hub_matching import Matching
from sern_core.relay.object_exchange import ObjectExchange
from sern_core.relay.peers import Peers
from sern_core.relay.presence import Presence
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.routing import RoutingTable
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.types import ClientName


class HomeChanges:
    """Brings what is kept here of a client, and for it, in line with where the client is, which `peers` knows."""

    def __init__(
        self,
        clients: Clients,
        routing: RoutingTable,
        streams: RelayedStreams,
        events: GuardedEvents,
        presence: Presence,
        matching: Matching,
        exchange: ObjectExchange,
        absent: AbsentClients,
        peers: Peers,
    ) -> None:
        self._clients = clients
        self._links = clients.links
        self._routing = routing
        self._streams = streams
        self._relayed = streams.by_id
        self._events = events
        self._presence = presence
        self._matching = matching
        self._exchange = exchange
        self._absent = absent
        self._peers = peers

    def displaced(self, client: ClientName, peer: ClientName, now: float) -> None:
        """A client that has a session here has begun another one at a peer."""
        self._clients.went_over(client, peer[1:], now=now)
        self._events.went_over(client, peer, came=False)

    def moved(self, client: ClientName, now: float) -> None:
        """A client has come to a peer, or left it. What is held for it here goes there."""
        self._presence.changed(client, now=now)
        peer = self._peers.home(client)
        if peer is not None:
            self._exchange.went(client, now=now)
            self._from_peer(client, peer, now)
            for identity in self._routing.streams_of(client):
                if self._routing.via(identity) is None:
                    self._streams.relocate(identity, peer, now)
            if self._routing.rights.saw(peer, client):
                self._routing.peer_has(peer)
                self._matching.look(peer, now=now)
        if peer is not None and client in self._links:
            self._absent.forget(client)
            self._matching.forget(client)
            self._streams.moves.went(client, peer, now=now)

    def _from_peer(self, client: ClientName, peer: ClientName, now: float) -> None:
        """Streams of the client that the peer has announced all along come from there now."""
        link = self._links.get(peer)
        if link is None:
            return
        for identity in self._routing.streams_of(client):
            stream, relayed = link.taking.streams.get(identity), self._relayed[identity]
            if stream is None or stream.channel_id is None or relayed.source is link:
                continue
            try:
                self._streams.take(link, stream, now).source = link
            except RefusedError as refusal:
                self._events.refused(peer, refusal.code, str(refusal))
            else:
                self._streams.answer(relayed, now)
