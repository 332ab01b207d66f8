"""The streams that a relay relays: who gets each, who has got it, and what is kept of it. Pure."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Final

from sern_core.link.link import Link
from sern_core.objects.registry import ObjectRegistry
from sern_core.relay.access import AccessTable, Right
from sern_core.relay.clients import Clients
from sern_core.relay.draining import Draining
from sern_core.relay.hub_events import GuardedEvents, Relayed
from sern_core.relay.hub_fanout import Fanout
from sern_core.relay.interest import UNIT_S
from sern_core.relay.moves import Moves
from sern_core.relay.presence import Presence
from sern_core.relay.route_change import RouteChange
from sern_core.relay.routing import RoutingTable
from sern_core.stream.in_stream import InStream
from sern_core.stream.latched import ReplayStore, as_replays, newest_that_fit, waiting_bytes
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import RefusedError, UsageError, WireError
from sern_core.vocabulary.limits import PeerLimits
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.names import is_peer
from sern_core.vocabulary.types import ClientName, DropReason, TopicName
from sern_core.wire.announce import check_onwards

STREAM_US: Final = 50
REPLAY_US: Final = 2
"""What it is charged with, in microseconds, to take or end a stream, and to replay a message."""
LEARNING_S: Final = 30.0
"""For so long after its start a relay does not say of a durable stream that nobody wants it. Who does may not have come
back yet, and where the robot died as well before it had on disk who that is, nobody else can tell."""
MAX_DENIED: Final = 64
"""Topics of one subscription that a client is told it may not have; a client has no use for a longer list."""


class RelayedStreams:
    """`ended` is told of the end of a stream of the relay's own; `home` is of `Moves`."""

    def __init__(
        self,
        clients: Clients,
        routing: RoutingTable,
        presence: Presence,
        objects: ObjectRegistry,
        events: GuardedEvents,
        *,
        cache_bytes: int,
        wall_ns: Callable[[float], int],
        ended: Callable[[Relayed, float], None],
        limits: PeerLimits,
        home: Callable[[ClientName], ClientName | None],
        now: float,
    ) -> None:
        self._clients = clients
        self._routing = routing
        self._presence = presence
        self._objects = objects
        self._events = events
        self._wall_ns = wall_ns
        self._ended = ended
        self._home = home
        self.moves = Moves(clients, routing, self, home=home)
        routing.interest.route_units = self._replay_units
        self.by_id: dict[StreamId, Relayed] = {}
        self.replays = ReplayStore(cache_bytes)
        self.fanout = Fanout(self.offer, self.told, self._let_go)
        self.draining = Draining(self._end_channel, limits)
        self.check: Callable[[StreamInfo], None] = lambda _stream: None
        """Raises RefusedError where there is anything against a stream beside what routing knows; set by the owner."""
        self.changed: Callable[[TopicName, float], None] = lambda _topic, _now: None
        """Told that a stream of that name has begun, ended, or comes from elsewhere; set by the owner."""
        self.tap: Callable[[StreamInfo], bool] = lambda _stream: False
        """Whether the relay itself wants a stream (a subscriber of the feed); set by the shell."""
        self.on_disk: Callable[[StreamId], int] = lambda _stream: 0
        """Up to which seq a durable stream is on disk here; set by the owner."""
        self._learns_until_s: float | None = now + LEARNING_S
        self._unsubscribed: OutChannel | None = None  # is being closed because its subscriber wants it no more
        self._room: tuple[ClientName, float, int] | None = None  # for replays to a client at this time

    # --- streams come and go --------------------------------------------------------------------------------------

    def take(self, source: Link | None, stream: InStream, now: float) -> Relayed:
        """Relay this stream from now on, or go on with it. Raises RefusedError; then it is not relayed any more."""
        identity = stream.stream.id
        relayed = self.by_id.get(identity)
        if relayed is None:
            relayed = self.by_id[identity] = Relayed(source, stream, self.replays)
        relayed.stream = stream
        try:
            try:
                check_onwards(stream.stream)
            except WireError as error:
                text = f"{identity.origin} may not publish {identity.topic[:80]!r}: nobody would take its announcement"
                raise RefusedError("bad_announcement", f"{text}: {error}") from None
            via = source.peer if source is not None and is_peer(source.peer) else None
            self.check(stream.stream)
            change = self._routing.announce(stream.stream, via=via)
        except RefusedError:
            self.apply(self._routing.withdraw(identity), now)
            refused = self.by_id.pop(identity, None)
            if refused is not None:
                self.fanout.end(refused)
                self.moves.ended(identity)
                if refused.cache is not None:
                    self.replays.close(refused.cache)
            raise
        if source is not None:  # beside the channels that it opens or ends
            matching_us = int(self._routing.spent.units * UNIT_S * 1e6)
            source.reassembly.work_us += STREAM_US * (1 + len(change.removed)) + matching_us
        relayed.keep_latched(self.replays)
        if change.added:
            self._events.stream_added(stream.stream)
            try:
                self._objects.put_stream(stream.stream, wall_ns=self._wall_ns(now), now=now)
            except RefusedError as refusal:
                self._events.refused(identity.origin, refusal.code, str(refusal))
        self.apply(change, now, source=source)
        self.changed(identity.topic, now)
        return relayed

    def relocate(self, identity: StreamId, peer: ClientName, now: float) -> None:
        """The origin of a stream has gone to a peer: from there other relays get it, and from there it is to come, if
        anybody here takes it."""
        self.apply(self._routing.relocate(identity, peer), now)
        if self.by_id[identity].outs:
            self.moves.left_for(identity, now)
            self.changed(identity.topic, now)
        else:
            self.apply(self._routing.withdraw(identity), now)

    def refuse(self, identity: StreamId, code: str, text: str, now: float) -> None:
        """Take a stream no more that was taken."""
        relayed = self.by_id[identity]
        if relayed.source is not None:
            relayed.source.taking.refuse(relayed.stream, code, text, now=now)
        self._events.refused(identity.origin, code, text)
        self.apply(self._routing.withdraw(identity), now)

    def retract(self, link: Link, stream: InStream, now: float) -> None:
        """A client has a stream no more."""
        link.reassembly.work_us += STREAM_US
        self.apply(self._routing.withdraw(stream.stream.id), now, source=link)
        self._remove(stream.stream.id, now)

    def apply(
        self,
        change: RouteChange,
        now: float,
        *,
        reason: DropReason = DropReason.UNWANTED,
        source: Link | None = None,
    ) -> None:
        """Open and close channels as the routes have changed; `reason`: of dropping what no longer has a subscriber;
        `source`: whose announcement it was, so that subscribers are told of it in slices."""
        touched: set[StreamId] = set(change.wanted) | set(change.unwanted)
        for identity in change.removed:
            self._remove(identity, now, drain=reason is not DropReason.FORBIDDEN, source=source)
        removed = frozenset(change.removed)
        for client, identity in change.unmatched:
            if identity in removed:
                continue  # its channels are closed by now, or will be
            self.close(client, identity, reason, now)
            touched.add(identity)
        for identity in change.updated:  # the origin offers it anew, with other properties: so is it offered onwards
            self._offer_all(identity, self._routing.subscribers(identity), source, now)
            touched.add(identity)
        matched: dict[StreamId, list[ClientName]] = {}
        for client, identity in change.matched:
            matched.setdefault(identity, []).append(client)
        for identity, clients in matched.items():
            self._offer_all(identity, clients, source, now)
            touched.add(identity)
        if source is not None:
            self.fanout.go_on(source, now=now)
        for identity in sorted(touched):
            relayed = self.by_id.get(identity)
            if relayed is not None:
                self.told(relayed, now)
        for denied in change.denied[:MAX_DENIED]:
            whose = f" of the relay {denied.by[1:]}, where it comes from," if denied.by else ""
            text = f"{denied.client} may not subscribe to {denied.topic}: no access rule{whose} grants it"
            self._events.refused(denied.client, "forbidden", text)
            said = {"t": "denied", "topic": denied.topic, "code": "forbidden", "why": text}
            self._clients.tell(denied.client, said, now)

    def _remove(self, identity: StreamId, now: float, *, drain: bool = True, source: Link | None = None) -> None:
        """The stream has ended. `drain`: what waits of it is still delivered; `source`: who said so, so that
        subscribers are told in slices."""
        relayed = self.by_id.pop(identity, None)
        if relayed is None:
            return
        self.fanout.end(relayed)
        self.moves.ended(identity)
        if relayed.cache is not None:
            self.replays.close(relayed.cache)
        if relayed.source is None:
            self._ended(relayed, now)
        for client in relayed.outs:
            self._presence.parted(identity.origin, client)
        if source is not None and drain:
            self.fanout.close_later(relayed, source.peer)
        else:
            for client, (link, channel) in relayed.outs.items():
                if drain:
                    self._let_go(client, link, channel, now)
                else:
                    self._end_channel(client, link, channel, DropReason.FORBIDDEN, now)
        self._objects.delete_stream(identity)
        self._events.stream_removed(relayed.stream.stream)
        self.changed(identity.topic, now)

    def revoke(self, access: AccessTable, now: float) -> None:
        """There are new access rules, and clients have their limits: what they no longer allow ends now."""
        for client in self._clients.links:
            self.draining.limit(client, self._clients.max_queue_bytes(client), now=now)
        change = self._routing.set_access(access)
        for identity in change.removed:
            relayed = self.by_id[identity]
            if relayed.source is not None:
                text = f"{identity.origin} may no longer publish {identity.topic}: the access rules have changed"
                relayed.source.taking.refuse(relayed.stream, "forbidden", text, now=now)
                self._events.refused(identity.origin, "forbidden", text)
        self.apply(change, now, reason=DropReason.FORBIDDEN)
        self.draining.keep(self._may_drain, DropReason.FORBIDDEN, now=now)

    def rejudge(self, peer: ClientName, now: float) -> None:
        """The rules of a peer are others than before: what they no longer allow ends now."""
        self.apply(self._routing.rejudge(peer), now, reason=DropReason.FORBIDDEN)
        self.draining.keep(self._may_drain, DropReason.FORBIDDEN, now=now)

    def drop_client(self, client: ClientName, reason: DropReason, now: float) -> None:
        """The client is given up: its streams end, and what waits for it is dropped for `reason`."""
        link = self._clients.links[client]
        self.fanout.forget(client, now=now)
        self.apply(self._routing.drop_client(client), now, reason=reason)
        for channel in list(link.sender.channels.values()):
            link.outgoing.close(channel, reason, now=now)
        self.draining.forget(client)
        if reason is DropReason.FORBIDDEN:
            self.draining.keep(lambda _client, stream: stream.origin != client, reason, now=now)

    def _may_drain(self, client: ClientName, stream: StreamId) -> bool:
        """Whether the rules allow what an ended stream left behind."""
        access, topic = self._clients.access, stream.topic
        granted = self._routing.rights.grants(self._home(stream.origin), client, topic, Right.SUBSCRIBE)
        may = is_peer(client) or (granted and access.may_subscribe(client, topic))
        return may and access.may_publish(stream.origin, stream.topic)

    # --- to subscribers -------------------------------------------------------------------------------------------

    def _offer_all(self, identity: StreamId, clients: Sequence[ClientName], source: Link | None, now: float) -> None:
        if source is not None:
            self.fanout.begin(self.by_id[identity], clients, source.peer)
            return
        for client in clients:
            self.offer(client, identity, now)

    def offer(self, client: ClientName, identity: StreamId, now: float, *, first: int | None = None) -> None:
        """Open a channel, in place of the one there may be. `first`: the seq of its first message; None: what is next
        from the origin."""
        self.close(client, identity, DropReason.DISCONNECTED, now)
        self._open(client, identity, now, first)

    def _open(self, client: ClientName, identity: StreamId, now: float, first: int | None) -> None:
        relayed = self.by_id[identity]
        if first is None and self.moves.holds_back(client, relayed, now=now):
            return
        link = self._clients.link(client, now)
        stream = relayed.stream.stream
        self.fanout.close(client, identity, now=now)  # of the same stream, before it ended
        if first is None:
            first = relayed.stream.delivered + 1
        ended = self.draining.take(client, stream, first, now=now)
        if ended is not None:  # it came back before it was gone
            relayed.outs[client] = ended
            self._presence.joined(identity.origin, client)
            return
        held = self.moves.begin_for(client, relayed, first) if self._routing.peers else None
        if held is not None:
            first = held.watermark + 1
        try:
            replays = self.latched(link, relayed, first, now)
            channel = link.outgoing.open(stream, first=first, now=now, replays=replays)
        except UsageError as full:
            relayed.unopened.add(client)
            self._events.refused(client, "too_many_streams", str(full))
            said = {"t": "denied", "topic": identity.topic, "code": "too_many_streams", "why": str(full)[:400]}
            self._clients.tell(client, said, now)
        except Exception as error:  # noqa: BLE001  (of this client's link: the origin and the others go on)
            relayed.unopened.add(client)
            self._clients.failed(client, error, now=now)
        else:
            relayed.outs[client] = (link, channel)
            self._presence.joined(identity.origin, client)
            if held is not None:
                self.moves.go_on_with(held, link, channel, now)
            if self._routing.peers:
                self.moves.began(client, relayed, now)

    def close(self, client: ClientName, identity: StreamId, reason: DropReason, now: float) -> None:
        """Close the channel, if there is one."""
        relayed = self.by_id.get(identity)
        if relayed is None:
            return
        self.moves.leave(client, identity)
        if reason is DropReason.UNWANTED and client in relayed.outs and is_peer(client):
            self.moves.keep(relayed, client, now)
        relayed.unopened.discard(client)
        relayed.waiting.pop(client, None)
        pair = relayed.outs.pop(client, None)
        if pair is not None:
            self._presence.parted(identity.origin, client)
            self._unsubscribed = pair[1] if reason is DropReason.UNWANTED else None
            self._end_channel(client, *pair, reason, now)
            self._unsubscribed = None

    def _end_channel(self, client: ClientName, link: Link, channel: OutChannel, reason: DropReason, now: float) -> None:
        self._clients.attempt(client, now, partial(link.outgoing.close, channel, reason, now=now))

    def rest(self, relayed: Relayed, peer: ClientName, now: float) -> None:
        """Nobody behind a peer that is out of reach needs the stream from there: keep nothing for it until it says that
        it wants it."""
        link, channel = relayed.outs[peer]
        self._unsubscribed = channel
        self._clients.attempt(peer, now, partial(link.outgoing.rest, channel, now=now))
        self._unsubscribed = None
        self.confirm(relayed)

    def _let_go(self, client: ClientName, link: Link, channel: OutChannel, now: float) -> None:
        """The channel's stream has ended: deliver what still waits, or close it."""
        stream = channel.stream.id
        if not channel.reliable or not channel.retained:
            self._end_channel(client, link, channel, DropReason.DISCONNECTED, now)
        elif not self._may_drain(client, stream):
            self._end_channel(client, link, channel, DropReason.FORBIDDEN, now)
        else:
            self.draining.add(client, link, channel, max_bytes=self._clients.max_queue_bytes(client), now=now)

    def prime(self, link: Link, now: float) -> None:
        """The client is another process than before: it gets what is latched of all that it takes."""
        for relayed in self.by_id.values():
            if link.peer in relayed.outs:
                channel = relayed.outs[link.peer][1]
                link.outgoing.prime(channel, self.latched(link, relayed, channel.first_seq, now), now=now)

    def latched(self, link: Link, relayed: Relayed, first: int, now: float) -> list[Message]:
        """The latched messages that a late joiner may have before `first`: of those that are not too many for what may
        wait for it the newest, the others are counted as `queue_full`."""
        client, stream, cache = link.peer, relayed.stream.stream, relayed.cache
        if cache is None or cache.empty:
            return []
        if not self._routing.may_replay(client, stream.id):
            return []
        messages = self.replays.below(cache, first)
        for payer in (link, relayed.source):  # whoever of them is being read has set it off, and it counts there
            if payer is not None:
                payer.reassembly.work_us += REPLAY_US * len(messages)
        bound = self._clients.bound(client)
        if bound is None:
            return as_replays(messages)
        bound.recount()
        if self._room is None or self._room[:2] != (client, now):
            # Adding up is too dear to be done for each of the streams that a client subscribes to at once.
            held_bytes = sum(channel.kept_bytes for channel in link.sender.channels.values())
            self._room = client, now, bound.max_bytes - held_bytes
        room_bytes = self._room[2]
        start = len(messages) - newest_that_fit(messages, room_bytes)
        counters = link.sender.ledger.topic(stream.id.topic, stream.spec.priority)
        for message in messages[:start]:
            counters.offer(len(message.body))
            counters.drop(DropReason.QUEUE_FULL, len(message.body))
        self._room = client, now, room_bytes - sum(map(waiting_bytes, messages[start:]))
        return as_replays(messages[start:])

    def _replay_units(self, identity: StreamId) -> int:
        """What replaying a stream costs, in the routing table's unit."""
        relayed = self.by_id.get(identity)
        if relayed is None or relayed.cache is None:
            return 0
        return int(relayed.cache.count * REPLAY_US * 1e-6 / UNIT_S)

    # --- to origins -----------------------------------------------------------------------------------------------

    def told(self, relayed: Relayed, now: float) -> None:
        """All subscribers have been told of a stream; to some it may have been impossible."""
        self._answer(relayed, now)
        self.confirm(relayed)

    def answer(self, relayed: Relayed, now: float) -> None:
        """Tell the origin whether anybody wants its stream, unless that is not known yet."""
        source = relayed.source
        if source is None:
            return
        wanted, required = self.wanted(relayed), relayed.required()
        waiting = self.moves.waiting(relayed.stream.stream.id)
        if waiting:
            wanted, required = True, tuple(dict.fromkeys((*required, *waiting)))
        if not wanted and relayed.stream.stream.spec.durable and self._learns_until_s is not None:
            return
        source.answers.answer(relayed.stream, wanted, now=now, required=required)

    def _answer(self, relayed: Relayed, now: float) -> None:
        if relayed.source is not None:
            self._clients.attempt(relayed.source.peer, now, partial(self.answer, relayed, now))

    def sweep(self, now: float) -> None:
        """Call about once a second: clients have had the time to come back."""
        if self._learns_until_s is not None and now >= self._learns_until_s:
            self._learns_until_s = None
            durable = [identity for identity, relayed in self.by_id.items() if relayed.stream.stream.spec.durable]
            self.refresh_interest(durable, now=now)

    def wanted(self, relayed: Relayed) -> bool:
        """Whether anybody takes the stream, or may later."""
        return bool(relayed.outs or relayed.waiting) or relayed.cache is not None or self.tap(relayed.stream.stream)

    def announced(self) -> Iterator[tuple[StreamInfo, bool]]:
        """Every stream there is, and whether anybody takes it: a client, or a program on the feed."""
        for relayed in self.by_id.values():
            stream = relayed.stream.stream
            yield stream, bool(relayed.outs or relayed.waiting) or self.tap(stream)

    def refresh_interest(self, streams: Iterable[StreamId] | None = None, *, now: float) -> None:
        """The answer of `tap` may have changed: tell the origins of these streams that there still are, or of all."""
        for identity in list(self.by_id) if streams is None else streams:
            relayed = self.by_id.get(identity)
            if relayed is not None:
                self._answer(relayed, now)

    def confirm(self, relayed: Relayed) -> None:
        """Tell the origin how far all required clients have got."""
        stream, source = relayed.stream, relayed.source
        if source is None or not stream.reliable:
            return
        delivered = stream.delivered
        for _link, channel in relayed.outs.values():
            delivered = min(delivered, channel.watermark)
        below = self.moves.confirms_below(stream.stream.id)
        if below is not None:
            delivered = min(delivered, below - 1)
        if stream.stream.spec.durable:  # what is on disk is ours to deliver
            delivered = max(delivered, min(self.on_disk(stream.stream.id), stream.delivered))
        source.taking.confirm(stream, delivered)

    def reports(self, link: Link, channel: OutChannel, reason: DropReason) -> Relayed | None:
        """The stream whose origin is to hear that messages for this client were dropped; None: nobody is."""
        relayed = self.by_id.get(channel.stream.id)
        if not channel.reliable or relayed is None or relayed.source is None:
            return None
        if channel is self._unsubscribed or (reason is DropReason.UNWANTED and link.peer not in relayed.outs):
            return None  # it is not required any more, also for what was sent whole, and others may have the message
        if is_peer(link.peer) and channel is link.outgoing.declined and not channel.required:
            return None  # nor is anybody behind a peer
        return relayed
