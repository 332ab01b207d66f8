"""What clients say that they want to have: topics by pattern, objects, and who is there. Pure."""

from typing import Final

from sern_core.link.link import Link
from sern_core.relay.absent import AbsentClients
from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import HubEvents
from sern_core.relay.hub_matching import Matching
from sern_core.relay.interest import PEER_TIMES, BadPatternError
from sern_core.relay.object_exchange import ObjectExchange
from sern_core.relay.presence import Presence
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.routing import RoutingTable
from sern_core.vocabulary.errors import RefusedError, WireError
from sern_core.vocabulary.names import is_client_name, is_peer, name_problem
from sern_core.vocabulary.types import ClientName, DropReason, TopicName
from sern_core.wire import framing

MAX_SUBSCRIPTION_PARTS: Final = 64
"""Messages that a subscription may come in."""


class Subscriptions:
    """Those that arrive, in their parts, and what is done about them when their turn has come."""

    def __init__(
        self,
        clients: Clients,
        events: HubEvents,
        presence: Presence,
        matching: Matching,
        routing: RoutingTable,
        streams: RelayedStreams,
        exchange: ObjectExchange,
        absent: AbsentClients,
    ) -> None:
        self._clients = clients
        self._events = events
        self._presence = presence
        self._matching = matching
        self._routing = routing
        self._streams = streams
        self._exchange = exchange
        self._absent = absent
        self._parts: dict[ClientName, list[str]] = {}

    def forget(self, client: ClientName) -> None:
        """Whatever has come of one is part of nothing."""
        self._parts.pop(client, None)

    def told(self, client: ClientName, envelope: framing.Envelope, now: float) -> None:
        """A part of one. Raises WireError."""
        parts = self._parts.setdefault(client, [])
        parts += framing.take_strings(envelope, "patterns")
        if "known" in envelope:
            known = framing.take_strings(envelope, "known", max_length=64)
            self._presence.ask(client, map(ClientName, filter(is_client_name, known)))
        if framing.take_bool(envelope, "more"):
            most = MAX_SUBSCRIPTION_PARTS * framing.MAX_ENVELOPE_ITEMS * (PEER_TIMES if is_peer(client) else 1)
            if len(parts) > most:
                raise WireError(f"more than {most} subscription patterns")
            return
        self._matching.ask(client, self._parts.pop(client), now=now)
        if framing.take_bool(envelope, "peers"):
            self._presence.watch(client, now=now)
        if framing.take_bool(envelope, "keys"):
            self._events.keys_asked(client)

    def take(self, client: ClientName, parts: list[str], now: float) -> None:
        """It is the turn of a whole one."""
        self._absent.subscribed(client)
        # What is a name and no pattern is denied by name: that gives nothing away about what there is.
        names = {TopicName(part) for part in parts if name_problem(part) is None}
        patterns = [part for part in parts if part not in names]
        try:
            self._streams.apply(self._routing.subscribe(client, patterns, exact=names), now)
            if self._streams.draining.has(client):
                self._streams.draining.keep(
                    lambda other, stream: other != client or self._routing.takes(client, stream.topic),
                    DropReason.UNWANTED,
                    now=now,
                )
        except RefusedError as refusal:
            self._deny(client, refusal, refusal.pattern if isinstance(refusal, BadPatternError) else "", now)

    def objects(self, link: Link, envelope: framing.Envelope, now: float) -> None:
        """A client says which objects it wants. Raises WireError."""
        try:
            self._exchange.subscribe(link, envelope, now=now)
        except RefusedError as refusal:
            self._deny(link.peer, refusal, "", now)

    def _deny(self, client: ClientName, refusal: RefusedError, pattern: str, now: float) -> None:
        self._events.refused(client, refusal.code, str(refusal))
        said: framing.Envelope = {"t": "denied", "pattern": pattern, "code": refusal.code, "why": str(refusal)[:400]}
        self._clients.tell(client, said, now)
