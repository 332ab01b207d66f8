"""What another relay says in control messages: read, and handed to whom it is for. Pure."""

from sern_core.link.link import Link
from sern_core.relay.claims import Claims
from sern_core.relay.clients import Clients
from sern_core.relay.feed_owners import FeedOwners
from sern_core.relay.hub_events import GuardedEvents
from sern_core.relay.peer_rules import RulesExchange
from sern_core.relay.peers import Peers
from sern_core.relay.presence import Presence
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.revocations import Revocations
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, TopicName
from sern_core.wire import framing


class PeerControl:
    """`max_claims`: of names that one peer may make."""

    def __init__(
        self,
        clients: Clients,
        streams: RelayedStreams,
        events: GuardedEvents,
        *,
        peers: Peers,
        claims: Claims,
        feeds: FeedOwners,
        rules: RulesExchange,
        revocations: Revocations,
        presence: Presence,
        max_claims: int,
    ) -> None:
        self._clients = clients
        self._streams = streams
        self._moves = streams.moves
        self._events = events
        self._peers = peers
        self._claims = claims
        self._feeds = feeds
        self._rules = rules
        self._revocations = revocations
        self._presence = presence
        self._max_claims = max_claims

    def message(self, link: Link, kind: str, envelope: framing.Envelope, attachment: bytes, now: float) -> None:
        """One that only relays say to each other. Raises WireError."""
        if kind == "here":
            self._peers.told(link.peer, envelope, now=now)
        elif kind == "left":
            self._peers.told_left(link.peer, envelope, now=now)
        elif kind == "peers":
            self._presence.told(link.peer, envelope, now=now)
        elif kind == "claims":
            self._claims.told(link.peer, envelope, max_claims=self._max_claims, now=now)
        elif kind == "offer":
            self._offer_again(link.peer, TopicName(framing.take_str(envelope, "topic")), now)
        elif kind == "feeds":
            self._feeds.told(link.peer, envelope, now=now)
        elif kind == "rules":
            self._rules.told(link, envelope, attachment, now=now)
        elif kind == "revoked":
            self._revocations.told(link, envelope, now=now)
        elif kind == "again":
            self._moves.expect_again(_stream(envelope))
        elif kind == "takes":
            first = framing.take_int(envelope, "next", low=1, high=framing.MAX_SEQ)
            begins = framing.take_bool(envelope, "begins")
            self._moves.takes(link, _client(envelope), _stream(envelope), first, begins=begins, now=now)
        elif kind in ("go", "released", "owed", "parted"):
            self._kept(link.peer, kind, _client(envelope), TopicName(framing.take_str(envelope, "topic")), now)
        elif kind == "denied":
            code = framing.take_str(envelope, "code", max_length=64)
            self._events.refused(link.peer, code, framing.take_str(envelope, "why"))
        else:
            raise WireError(f"unknown control message {kind!r}")

    def _kept(self, peer: ClientName, kind: str, client: ClientName, topic: TopicName, now: float) -> None:
        """Who keeps a topic for a client."""
        if kind == "go":
            self._moves.go(client, topic, now=now)
        elif kind == "owed":
            self._moves.owed(peer, client, topic, now=now)
        elif kind == "parted":
            self._moves.parted(peer, client, topic, now=now)
        elif client in self._clients.links and not self._clients.links[client].established:
            self._moves.released(client, topic, now=now)

    def _offer_again(self, peer: ClientName, topic: TopicName, now: float) -> None:
        """A peer could not take a stream for its name, and can now."""
        for identity in self._claims.offer(topic):
            pair = self._streams.by_id[identity].outs.get(peer)
            if pair is not None and pair[1].wanted is False:
                self._streams.offer(peer, identity, now)


def _client(envelope: framing.Envelope) -> ClientName:
    """Raises WireError."""
    return ClientName(framing.take_str(envelope, "client", max_length=64))


def _stream(envelope: framing.Envelope) -> StreamId:
    """Raises WireError."""
    origin, boot = framing.take_str(envelope, "origin", max_length=64), framing.take_int(envelope, "boot")
    return StreamId(ClientName(origin), boot, TopicName(framing.take_str(envelope, "topic")))
