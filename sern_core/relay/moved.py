"""Clients that have gone to another relay and said so, and when this one may forget them. Pure.

Such a client takes along what it owes: its reliable messages that not everyone has confirmed. How far it has got with
the streams of others it knows as well. So nothing of it is needed here but for those who are still here: they know by
its streams how far they have got, and what they send reliably must wait for it, because they would take it for
delivered. When they have gone, too, the origins of all that was kept are elsewhere, and have it.
"""

from collections.abc import Container

from sern_core.objects.changes import OBJECTS_TOPIC
from sern_core.relay.clients import Clients
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.routing import RoutingTable
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.types import ClientName


class MovedClients:
    """`local_owners`: the names under which the relay itself publishes."""

    def __init__(
        self,
        clients: Clients,
        routing: RoutingTable,
        streams: RelayedStreams,
        local_owners: Container[str],
    ) -> None:
        self._clients = clients
        self._routing = routing
        self._streams = streams
        self._local_owners = local_owners
        self._names: set[ClientName] = set()

    def __contains__(self, client: ClientName) -> bool:
        return client in self._names

    def add(self, client: ClientName) -> None:
        """The client has said goodbye, and goes on at another relay."""
        self._names.add(client)

    def discard(self, client: ClientName) -> None:
        """It has a session again, or is forgotten."""
        self._names.discard(client)

    def not_needed(self) -> list[ClientName]:
        """Those of which nobody here needs anything."""
        return [client for client in sorted(self._names) if not self._needed(client)]

    def _needed(self, client: ClientName) -> bool:
        for identity in self._routing.streams_of(client):
            relayed = self._streams.by_id.get(identity)
            if relayed is not None and any(taker not in self._names for taker in relayed.required()):
                return True
        return any(map(self._waited_for, self._clients.links[client].sender.channels.values()))

    def _waited_for(self, channel: OutChannel) -> bool:
        """Whether this is a stream whose messages may wait for the client here and nowhere else."""
        stream = channel.stream.id
        if not channel.reliable or stream.topic == OBJECTS_TOPIC or stream.origin in self._names:
            return False
        return bool(channel.retained) or stream.origin in self._clients.links or stream.origin in self._local_owners

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self._names <= self._clients.links.keys(), "clients that are forgotten count as moved"
