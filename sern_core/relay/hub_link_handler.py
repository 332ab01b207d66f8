"""What the relay does when the link of a client, or of another relay, tells it something. Pure."""

from collections.abc import Sequence
from functools import partial
from typing import Final

from sern_core.link.link import Link
from sern_core.objects.registry import ObjectRegistry
from sern_core.relay.absent import AbsentClients
from sern_core.relay.claims import Claims
from sern_core.relay.clients import Clients
from sern_core.relay.feed_owners import FeedOwners
from sern_core.relay.forwarding import Forwarding
from sern_core.relay.holding import Holding
from sern_core.relay.hub_events import GuardedEvents
from sern_core.relay.hub_subscriptions import Subscriptions
from sern_core.relay.moved import MovedClients
from sern_core.relay.object_exchange import OBJECTS_TOPIC, ObjectExchange
from sern_core.relay.offers_again import NOT_THERE, OffersAgain
from sern_core.relay.peer_control import PeerControl
from sern_core.relay.peer_rules import RulesExchange
from sern_core.relay.peers import Peers
from sern_core.relay.presence import Presence
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.revocations import Revocations
from sern_core.relay.routing import RoutingTable
from sern_core.stream.in_stream import InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.errors import RefusedError, WireError
from sern_core.vocabulary.key_news import ClientKeys
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.names import is_peer
from sern_core.vocabulary.types import ClientName, DropReason
from sern_core.wire import framing
from sern_core.wire.announce import Announcement

STREAMS_PER_US: Final = 10
"""Streams that are looked at in a microsecond."""
LANE_US: Final = 300
KEYS_US: Final = 100
CONFIRMED_PER_US: Final = 8
"""What a client is charged with, in microseconds: to open a datagram lane for it, to look at its keys, and how many
subscribers are asked for their share of a confirmation in one."""


class HubLinkHandler:
    """The `LinkHandler` of every link of a relay. Links call it directly, because every message passes through here.

    `max_claims`: of names that one other relay may make.
    """

    def __init__(
        self,
        clients: Clients,
        routing: RoutingTable,
        streams: RelayedStreams,
        objects: ObjectRegistry,
        events: GuardedEvents,
        *,
        forwarding: Forwarding,
        exchange: ObjectExchange,
        subscriptions: Subscriptions,
        presence: Presence,
        holding: Holding,
        absent: AbsentClients,
        moved: MovedClients,
        peers: Peers,
        claims: Claims,
        feeds: FeedOwners,
        rules: RulesExchange,
        revocations: Revocations,
        max_claims: int,
    ) -> None:
        self._clients = clients
        self._links = clients.links
        self._routing = routing
        self._streams = streams
        self._relayed = streams.by_id
        self._objects = objects
        self._events = events
        self._forwarding = forwarding
        self._received = forwarding.received
        self._exchange = exchange
        self._subscriptions = subscriptions
        self._presence = presence
        self._holding = holding
        self._absent = absent
        self._moved = moved
        self._peers = peers
        self._claims = claims
        self._rules = rules
        self._revocations = revocations
        self._offers_again = OffersAgain(streams, peers.epoch)
        self._from_peers = PeerControl(
            clients,
            streams,
            events,
            peers=peers,
            claims=claims,
            feeds=feeds,
            rules=rules,
            revocations=revocations,
            presence=presence,
            max_claims=max_claims,
        )

    def on_fault(self, link: Link, error: Exception, *, now: float) -> None:
        self._events.fault(link.peer, error)

    def on_up(self, link: Link, *, resumed: bool, now: float) -> None:
        self._clients.came(link.peer)
        if is_peer(link.peer):
            self._rules.up(link, now=now)  # before anything is announced
            self._streams.moves.up(link.peer)
            self._peers.up(link, now=now)
            self._claims.up(link, now=now)
            self._revocations.up(link, now=now)
            self._exchange.came(link, resumed=resumed, now=now)
            if not resumed:
                self._streams.prime(link, now)
            self._presence.relay_changed(link.peer, now=now)
            self._events.peer_up(link.peer)
            return
        before = self._peers.home(link.peer)
        self._peers.came(link.peer, now=now)
        self._streams.moves.came_home(link.peer, now)
        self._offers_again.came(self._routing.streams_of(link.peer), now=now)
        if before is not None:
            self._events.went_over(link.peer, before, came=True)
        self._moved.discard(link.peer)
        if link.end.peer_boot is not None:
            self._routing.returned(link.peer, link.end.peer_boot)
        self._subscriptions.forget(link.peer)  # half of one that was said in an earlier session
        if not resumed:
            self._streams.prime(link, now)
        self._exchange.came(link, resumed=resumed, now=now)
        self._presence.changed(link.peer, now=now)
        self._events.client_up(link.peer, resumed=resumed)

    def on_down(self, link: Link, reason: str, *, now: float) -> None:
        self._clients.went(link.peer, now)
        if is_peer(link.peer):
            self._presence.relay_changed(link.peer, now=now)
            self._events.peer_down(link.peer, reason)
            return
        self._presence.changed(link.peer, now=now)
        self._holding.went(link.peer)
        self._events.client_down(link.peer, reason)

    def on_lane_closed(self, link: Link) -> None:
        self._events.lane_closed(link.peer)

    def on_rejected(self, link: Link, code: str, text: str, *, now: float) -> None:
        """Another relay does not take us: it says why."""
        self._events.refused(link.peer, code, text)

    def on_announce(self, link: Link, announcement: Announcement, *, now: float) -> bool | None:
        stream = link.taking.streams[announcement.stream.id]
        identity = stream.stream.id
        if is_peer(link.peer) and identity.topic != OBJECTS_TOPIC:
            if self._peers.home(identity.origin) != link.peer:
                raise RefusedError(
                    "origin", f"{link.peer[1:]} announced a stream of {identity.origin}, who is not there"
                )
        # What is kept on disk has the number of its store, which is the origin's to draw.
        elif identity.origin != link.peer or (identity.boot != link.end.peer_boot and not stream.stream.spec.durable):
            raise RefusedError("origin", f"{link.peer} announced a stream of {identity.origin}")
        if identity.topic == OBJECTS_TOPIC:
            return True
        on_disk = self._holding.position(identity)
        if on_disk > stream.delivered:  # an earlier run of ours has it, and its origin may not know yet
            stream.delivered = stream.confirmed = on_disk
        try:
            relayed = self._streams.take(link, stream, now)
        except RefusedError as refusal:
            self._events.refused(link.peer, refusal.code, str(refusal))
            if refusal.code == "name_taken" and is_peer(link.peer):
                self._claims.refused(identity, link.peer)
            raise
        if stream.reliable:
            relayed.source = None  # one answer for all who are absent
            moves = self._streams.moves
            moves.named_by_source = frozenset(map(ClientName, announcement.required))
            self._absent.hold(announcement.required, identity, link, now)
            moves.named_by_source = frozenset()
        relayed.source = link
        self._streams.moves.came(relayed, now=now)
        self._streams.answer(relayed, now)
        return None

    def on_retract(self, link: Link, stream: InStream, *, now: float) -> None:
        identity = stream.stream.id
        relayed = self._relayed.get(identity)
        if relayed is not None and relayed.source is not link and (is_peer(link.peer) or self._routing.via(identity)):
            return  # it comes from elsewhere by now
        if is_peer(link.peer) and not self._streams.moves.ends_for_good(identity, link.peer, now=now):
            return
        if identity.topic != OBJECTS_TOPIC:
            self._streams.retract(link, stream, now)

    def on_message(self, link: Link, stream: InStream, message: Message, *, now: float) -> None:
        if stream.stream.id.topic == OBJECTS_TOPIC:
            self._exchange.message(link, stream, message, now=now)
        else:
            self._forwarding.message(link, stream, message, now)

    def on_in_drop(self, link: Link, stream: InStream, reason: DropReason, nbytes: int, count: int) -> None:
        self._received.of(stream.stream).drop_arrived(reason, count)

    def on_out_drop(self, link: Link, channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None:
        self._exchange.dropped(link, channel)
        relayed = self._streams.reports(link, channel, reason)
        if relayed is None or relayed.source is None:
            return
        now, source = link.now, relayed.source
        first, last = outs[0].seq, outs[-1].seq  # the origin counts what it has not counted of them
        report = partial(source.answers.report, relayed.stream, first, reason, link.peer, last - first + 1)
        self._clients.attempt(source.peer, now, report)

    def on_delivered(self, link: Link, channel: OutChannel, *, now: float) -> None:
        relayed = self._relayed.get(channel.stream.id)
        if relayed is not None:
            link.reassembly.work_us += len(relayed.outs) // CONFIRMED_PER_US
            self._streams.confirm(relayed)
        else:
            self._exchange.delivered(link, channel, now=now)

    def on_refused(self, link: Link, channel: OutChannel, code: str, text: str, *, now: float) -> None:
        self._events.refused(link.peer, code, text)
        if code == NOT_THERE and is_peer(link.peer):
            self._offers_again.refused(link.peer, channel, now=now)

    def on_skipped(self, link: Link, stream: InStream, count: int, *, now: float) -> None:
        """Messages of the origin that were given up before they got here: subscribers go on behind them."""
        relayed = self._relayed.get(stream.stream.id)
        if relayed is None or not stream.reliable:
            return
        for client, (out_link, channel) in relayed.outs.items():
            skip = partial(out_link.outgoing.skip, channel, stream.delivered + 1, now=now, silent=stream.paused)
            self._clients.attempt(client, now, skip)

    def on_wanted(self, link: Link, channel: OutChannel, *, now: float) -> None:
        """What a client subscribed to it gets; a peer says who gets it behind it, and the origin is to know."""
        if is_peer(link.peer):
            self._streams.refresh_interest([channel.stream.id], now=now)
            self._streams.moves.named(link, channel, now=now)

    def on_definition(self, link: Link, digest: str, *, now: float) -> None:
        link.reassembly.work_us += len(self._links) + len(self._relayed) // STREAMS_PER_US
        for identity, relayed in self._relayed.items():
            if relayed.stream.stream.definition_hash == digest:
                self._objects.redescribe(identity, now=now)
        for client, other in self._links.items():
            self._clients.attempt(client, now, partial(other.definition_known, digest, now=now))

    def on_control(self, link: Link, envelope: framing.Envelope, attachment: bytes, *, now: float) -> None:
        kind = envelope["t"]
        if kind == "subscribe":
            self._subscriptions.told(link.peer, envelope, now)
        elif kind == "objects":
            self._subscriptions.objects(link, envelope, now)
        elif is_peer(link.peer):
            self._from_peers.message(link, kind, envelope, attachment, now)
        elif kind == "key":
            link.reassembly.work_us += KEYS_US
            told = ClientKeys(
                relay=tuple(framing.take_strings(envelope, "relay", max_length=64)),
                kept=framing.take_bool(envelope, "kept"),
                key=framing.take_str(envelope, "key", max_length=64, default=""),
            )
            self._events.keys_told(link.peer, told)
        elif kind == "lane_ask":
            link.reassembly.work_us += LANE_US
            self._events.lane_asked(link.peer, framing.take_strings(envelope, "ciphers", max_length=64))
        else:
            raise WireError(f"unknown control message {kind!r}")
