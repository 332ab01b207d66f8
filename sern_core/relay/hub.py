"""The relay's core: one link per client, who gets what, and who has got it. Pure.

Messages arrive whole and in their turn from one link and are offered, unchanged, to the links of all subscribers, each
with a scheduler and a window of its own: a slow subscriber sheds only its own traffic, by class.

Reliable streams: the origin is told "delivered up to n" when every client that is owed the stream has confirmed n.
An origin remembers who is owed; a relay that starts anew learns it from the announcement and holds messages for
those clients before they have come back (they are *awaited*). A client that stays away longer than `resume_s` is
dropped, and what it was owed is reported to the origins. One that says goodbye and is owed nothing is dropped at once,
and so is one whose name is revoked.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from sern_core.link.definitions import DefinitionStore
from sern_core.link.handshake import DISPLACED
from sern_core.link.link import TIDY_S, Link
from sern_core.path.lanes import LANE_EXPRESS
from sern_core.relay.access import AccessTable, RateGuard
from sern_core.relay.bound import QueueBound
from sern_core.relay.draining import Draining
from sern_core.relay.hub_events import GuardedEvents, HubEvents, Relayed
from sern_core.relay.hub_fanout import Fanout
from sern_core.relay.hub_local import LocalStreams
from sern_core.relay.hub_matching import Matching
from sern_core.relay.hub_port import HubPort
from sern_core.relay.object_control import apply_object
from sern_core.relay.objects import ObjectRegistry
from sern_core.relay.presence import Presence
from sern_core.relay.routing import UNIT_S, BadPatternError, Denied, Match, RouteChange, RoutingTable
from sern_core.stream.in_stream import InStream
from sern_core.stream.latched import ReplayStore, as_replays, newest_that_fit, waiting_bytes
from sern_core.stream.out_channel import LAPSED_A_SWEEP, OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.errors import RefusedError, UsageError, WireError
from sern_core.vocabulary.fates import Fates
from sern_core.vocabulary.ledger import ReceiveLedger
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.names import is_client_name, name_problem
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import DROP_CODES, ClientName, DropReason, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import Announcement, check_onwards

STREAM_US: Final = 50
FORWARD_US: Final = 5
LANE_US: Final = 300
CONFIRMED_PER_US: Final = 8
REPLAY_US: Final = 2
AWAIT_US: Final = 50
OWED_PER_US: Final = 2
"""What work for a client is charged to it, in microseconds: to take or end a stream, to hand on a message to a
subscriber, to open a datagram lane, and how many subscribers are asked for their share of a confirmation; to replay a
message; to wait for a client that is owed a stream, and how many names of such clients are looked at."""
MAX_SUBSCRIPTION_PARTS: Final = 64
ORPHAN_S: Final = 60.0
"""A session that a blackout cost its TCP connection has ended when its datagram lane says nothing for so long: longer
than any blackout that is worth waiting for with keys in hand. Where the connection ended while datagrams still came, it
is the client's process that ended, and the heartbeat's time is enough."""
MAX_AWAITED_CLIENTS: Final = 1024
"""Clients that have not come back yet and are waited for."""
MAX_AWAITED_TOPICS: Final = 2048
"""Streams held for one client that has not come back yet; origins name them, so there must be an end to it."""
MAX_DENIED: Final = 64
"""Topics of one subscription that a client is told it may not have; a client has no use for a longer list."""


@dataclass(frozen=True, slots=True)
class HubParams:
    """`cache_bytes`: latched messages kept in all. `resume_s`: how long an absent client is waited for."""

    cache_bytes: int = 64 * 2**20
    resume_s: float = 600.0


class Hub(LocalStreams):
    """See the module's text. `known` says whether a name is in the directory of clients."""

    def __init__(
        self,
        *,
        name: ClientName,
        boot: int,
        access: AccessTable,
        known: Callable[[ClientName], bool],
        events: HubEvents,
        link: LinkParams,
        scheduler: SchedulerParams,
        params: HubParams | None = None,
        wall_ns: Callable[[float], int],
        trace: DecisionTrace | None = None,
        now: float,
        lossless: bool = True,
    ) -> None:
        super().__init__()
        self.name = name
        self.boot = boot
        self.access = access
        self.known = known
        self.events = GuardedEvents(events)
        self.params = params or HubParams()
        self.routing = RoutingTable(access)
        self.routing.route_units = self._replay_units
        self.objects = ObjectRegistry(epoch=boot)
        self.definitions = DefinitionStore()
        self.trace = trace or DecisionTrace(enabled=False)
        self.received = ReceiveLedger()
        self.links: dict[ClientName, Link] = {}
        self.port_of: dict[ClientName, HubPort] = {}
        self.relayed: dict[StreamId, Relayed] = {}
        self.fates: Fates | None = None
        """Told what becomes of each message here; set before the first client comes."""
        self._link_params = link
        self._scheduler_params = scheduler
        self._lossless = lossless
        self._wall_ns = wall_ns
        self.replays = ReplayStore(self.params.cache_bytes)
        self._guards: dict[ClientName, RateGuard] = {}
        self._bounds: dict[ClientName, QueueBound] = {}
        self._subscriptions: dict[ClientName, list[str]] = {}  # parts that have arrived
        self.matching = Matching(self.routing, self._subscribed, self._apply)
        self._fanout = Fanout(self._offer, self._told, self._let_go)
        self.presence = Presence(self.links, self.local_owners, self.matching.due_s, self._for, self._was_read)
        self._awaited: dict[ClientName, set[TopicName]] = {}
        self._heard: set[ClientName] = set()  # said what they want, to this run of the relay
        self._absent_since: dict[ClientName, float] = {}
        self._draining = Draining(self._end_channel)
        self._unsubscribed: OutChannel | None = None  # is being closed because its taker wants it no more
        self._room: tuple[ClientName, float, int] | None = None  # for replays to a client at this time
        self._tidy_due_s = now + TIDY_S
        self.after: Callable[[], None] = lambda: None
        """Called when something was done by time that may have given any client's link something to send; set by the
        shell."""
        self.tap: Callable[[StreamInfo], bool] = lambda _stream: False
        """Whether the relay itself wants a stream (a subscriber of the feed); set by the shell."""

    # --- connections ----------------------------------------------------------------------------------------------

    def greet(self, port: HubPort, hello: framing.Envelope, header: framing.Header, *, now: float) -> None:
        """A client says hello on a connection. A newer connection of the same client retires the older one."""
        link = self._link(port.client, now)
        older = self.port_of.get(port.client)
        another = older is not port
        tag, rival = link.end.tag, link.established and framing.take_int(hello, "boot") != link.end.peer_boot
        if not link.accept(hello, header.tag, header.stamp_us, now=now, another_connection=another):
            return
        if older is not None and older is not port:
            older.link = None
            if rival:  # its connection is up: it did not end before the other began
                older.displace(tag, port, now=now)
                self.events.refused(
                    port.client, DISPLACED, f"another process connected as {port.client} from {port.address or '?'}; "
                    f"the one from {older.address or '?'} has no session any more"
                )  # fmt: skip
        port.link = link
        self.port_of[port.client] = port
        self._absent_since.pop(port.client, None)

    def _link(self, client: ClientName, now: float) -> Link:
        link = self.links.get(client)
        if link is None:
            link = self.links[client] = Link(
                name=self.name,
                boot=self.boot,
                peer=client,
                initiator=False,
                handler=self,
                definitions=self.definitions,
                link=self._link_params,
                scheduler=self._scheduler_params,
                trace=self.trace,
                now=now,
                lossless=self._lossless,
                auto_confirm=False,
            )
            link.receiver.on_stray = self.received.stray
            link.outgoing.fates = self.fates
            link.reading.on_read = self._was_read
            link.finish = self._finish
            self._limit(client, now)
            self._absent_since[client] = now
        return link

    def _was_read(self) -> None:
        self.after()

    def _finish(self, link: Link, now: float) -> bool:
        return self._fanout.go_on(link, now=now)

    def _limit(self, client: ClientName, now: float) -> None:
        """Put the limits of the access rules in force."""
        limits = self.access.limits(client)
        guard = self._guards.get(client)
        if guard is None or not guard.holds(limits):  # else what it has used up stays used up
            self._guards[client] = RateGuard.of(limits, now=now)
        if limits.max_queue_bytes is None:
            self._bounds.pop(client, None)
        else:
            self._bounds[client] = QueueBound(limits.max_queue_bytes)

    def failed(self, client: ClientName, error: Exception, *, now: float) -> None:
        """An error of ours about one client: its session ends, and nobody else's."""
        link = self.links.get(client)
        if link is None:
            self.events.fault(client, error)
        else:
            link.failed(error, now=now)

    def _for(self, client: ClientName, now: float, call: Callable[[], object]) -> None:
        """Do something about a client that need not be the one whose datagram is being read: if it fails, that
        client's session ends."""
        try:
            call()
        except Exception as error:  # noqa: BLE001  (whoever is at work goes on, and the other clients get theirs)
            self.failed(client, error, now=now)

    def ports(self) -> list[HubPort]:
        return list(self.port_of.values())

    def sweep(self, *, now: float) -> None:
        """Let go of clients that stay away, and of ended streams that are fully delivered. Call about once a second,
        and then `lapse`."""
        self.lapse(now=now)
        for client, since_s in list(self._absent_since.items()):
            if not self.links[client].established and now - since_s > self.params.resume_s:
                self._for(client, now, partial(self._forget, client, now))
        for client, link in list(self.links.items()):
            if client not in self.port_of and link.established:  # only its datagram lane is left
                link.handle_timeout(now=now)
                waiting_s = link.lane.flight.waiting_since_s
                patience_s = ORPHAN_S if link.handshake.cut_off else link.end.params.heartbeat_timeout_s
                if link.lane.stalled and waiting_s is not None and now - waiting_s > patience_s:
                    silent_s = now - waiting_s
                    link.close_lane(now=now, reason=f"its connection is gone and no datagram came for {silent_s:.0f} s")
        self._draining.sweep(now=now)
        for link in list(self.links.values()):
            if link.deaf:
                link.close("it does not read what it is told", now=now)
        for client in [client for client in self._guards.keys() - self.links.keys() if self._guards[client].full(now)]:
            del self._guards[client]  # by name, over sessions: one that comes back at once has no new burst
        if now >= self._tidy_due_s:
            self._tidy_due_s = now + TIDY_S
            self.received.tidy({identity.topic for identity in self.relayed}, now=now)
            self._numbering.tidy(now=now)
        self.matching.sweep(now=now)
        for client in self._fanout.origins():  # those who read on when it is due have done so
            link = self.links[client]
            if link.reading.due_s is None:
                link.reassembly.work_us = 0
                self._fanout.go_on(link, now=now)
        self.presence.sweep(now=now)

    def lapse(self, *, now: float) -> bool:
        """Retention goes on while clients are away, and clients are told of their peers. True: there is more to do;
        call again in another turn."""
        room = LAPSED_A_SWEEP  # for all together: each may have a little
        for client in list(self._absent_since):
            link = self.links[client]
            if link.established:
                continue
            lapsed = link.sender.lapsed
            link.handle_timeout(now=now)
            room -= link.sender.lapsed - lapsed
            if room <= 0:
                return True
        return self.presence.tell(now=now)

    def left(self, client: ClientName, *, now: float) -> None:
        """A client has said goodbye. One that has streams, or wants reliable ones, may come back to them (a daemon that
        is started anew), and is waited for like any other; the others are forgotten."""
        link = self.links[client]
        if not self.routing.streams_of(client) and not any(
            channel.reliable for channel in link.sender.channels.values()
        ):
            self._forget(client, now)

    def end_session(self, client: ClientName, reason: str, *, now: float) -> None:
        """The client's key no longer holds: its session ends, whatever lanes it has. It may come back with another."""
        link = self.links.get(client)
        if link is not None:
            link.close(reason, now=now)
            link.disconnected(now=now)

    def forget(self, client: ClientName, reason: str, *, now: float) -> None:
        """The client's name is revoked: its session ends, and with it whatever is held of it or for it."""
        if client in self.links:
            self.end_session(client, reason, now=now)
            self._forget(client, now, reason=DropReason.FORBIDDEN)

    def _forget(self, client: ClientName, now: float, *, reason: DropReason = DropReason.DISCONNECTED) -> None:
        link = self.links[client]
        self._fanout.forget(client, now=now)
        self._apply(self.routing.drop_client(client), now, reason=reason)
        for channel in list(link.sender.channels.values()):
            link.outgoing.close(channel, reason, now=now)
        self._draining.forget(client)
        if reason is DropReason.FORBIDDEN:
            self._draining.keep(lambda _client, stream: stream.origin != client, reason, now=now)
        self.events.lane_closed(client)
        link.close_streams()
        del self.links[client]
        port = self.port_of.pop(client, None)
        if port is not None:
            port.link = None
        self._subscriptions.pop(client, None)
        self.matching.forget(client)
        self._absent_since.pop(client, None)
        self._awaited.pop(client, None)
        self._heard.discard(client)
        self._bounds.pop(client, None)
        self.objects.delete_owned(client)

    def revoke(self, access: AccessTable, *, now: float) -> None:
        """New access rules: what they no longer allow ends now."""
        self.access = access
        for client in self.links:
            self._limit(client, now)
            self._draining.limit(client, self._max_queue_bytes(client), now=now)
        change = self.routing.set_access(access)
        for identity in change.removed:
            relayed = self.relayed[identity]
            if relayed.source is not None:
                text = f"{identity.origin} may no longer publish {identity.topic}: the access rules have changed"
                relayed.source.taking.refuse(relayed.stream, "forbidden", text, now=now)
                self.events.refused(identity.origin, "forbidden", text)
        self._apply(change, now, reason=DropReason.FORBIDDEN)
        self._draining.keep(self._may_drain, DropReason.FORBIDDEN, now=now)
        for client in self.links:
            self.matching.look(client, now=now)

    def _may_drain(self, client: ClientName, stream: StreamId) -> bool:
        """Whether the rules allow what an ended stream left behind."""
        access = self.access
        return access.may_subscribe(client, stream.topic) and access.may_publish(stream.origin, stream.topic)

    def _max_queue_bytes(self, client: ClientName) -> int | None:
        bound = self._bounds.get(client)
        return None if bound is None else bound.max_bytes

    # --- routes -----------------------------------------------------------------------------------------------------

    def _apply(
        self,
        change: RouteChange,
        now: float,
        *,
        reason: DropReason = DropReason.UNWANTED,
        source: Link | None = None,
    ) -> None:
        """Open and close channels as the routes have changed; `reason`: of dropping what no longer has a taker;
        `source`: whose announcement it was, so that subscribers are told of it in slices."""
        touched: set[StreamId] = set(change.wanted) | set(change.unwanted)
        for identity in change.removed:
            self._remove(identity, now, drain=reason is not DropReason.FORBIDDEN, source=source)
        removed = frozenset(change.removed)
        for client, identity in change.unmatched:
            if identity in removed:
                continue  # its channels are closed by now, or will be
            self._close(client, identity, reason, now)
            touched.add(identity)
        for identity in change.updated:  # the origin offers it anew, with other properties: so is it offered onwards
            self._offer_all(identity, self.routing.subscribers(identity), source, now)
            touched.add(identity)
        matched: dict[StreamId, list[ClientName]] = {}
        for client, identity in change.matched:
            matched.setdefault(identity, []).append(client)
        for identity, clients in matched.items():
            self._offer_all(identity, clients, source, now)
            touched.add(identity)
        if source is not None:
            self._fanout.go_on(source, now=now)
        for identity in sorted(touched):
            relayed = self.relayed.get(identity)
            if relayed is not None:
                self._answer(relayed, now)
                self._confirm(relayed)
        for denied in change.denied[:MAX_DENIED]:
            text = f"{denied.client} may not subscribe to {denied.topic}: no access rule grants it"
            self.events.refused(denied.client, "forbidden", text)
            self._tell(denied.client, {"t": "denied", "topic": denied.topic, "code": "forbidden", "why": text}, now)

    def _offer_all(self, identity: StreamId, clients: Sequence[ClientName], source: Link | None, now: float) -> None:
        if source is not None:
            self._fanout.begin(self.relayed[identity], clients)
            return
        for client in clients:
            self._offer(client, identity, now)

    def _offer(self, client: ClientName, identity: StreamId, now: float, *, first: int | None = None) -> None:
        """Open a channel, in place of the one there may be. `first`: the seq of its first message; None: what is next
        from the origin."""
        self._close(client, identity, DropReason.DISCONNECTED, now)
        self._open(client, identity, now, first)

    def _told(self, relayed: Relayed, now: float) -> None:
        """All subscribers have been told of a stream; to some it may have been impossible."""
        self._answer(relayed, now)
        self._confirm(relayed)

    def _answer(self, relayed: Relayed, now: float) -> None:
        """Tell the origin whether anybody wants its stream."""
        source = relayed.source
        if source is not None:
            owed = relayed.owed()
            wanted = self._wanted(relayed)
            self._for(source.peer, now, partial(source.answers.answer, relayed.stream, wanted, now=now, owed=owed))

    def _tell(self, client: ClientName, envelope: framing.Envelope, now: float) -> None:
        """Say something to a client, if it is there; whoever comes later says what it wants anew, and is told then."""
        link = self.links.get(client)
        if link is not None:
            self._for(client, now, partial(link.control.send, envelope, now=now))

    def _close(self, client: ClientName, identity: StreamId, reason: DropReason, now: float) -> None:
        relayed = self.relayed.get(identity)
        if relayed is None:
            return
        relayed.unopened.discard(client)
        relayed.waiting.pop(client, None)
        pair = relayed.outs.pop(client, None)
        if pair is not None:
            self.presence.parted(identity.origin, client)
            self._unsubscribed = pair[1] if reason is DropReason.UNWANTED else None
            self._end_channel(client, *pair, reason, now)
            self._unsubscribed = None

    def _end_channel(self, client: ClientName, link: Link, channel: OutChannel, reason: DropReason, now: float) -> None:
        self._for(client, now, partial(link.outgoing.close, channel, reason, now=now))

    def _wanted(self, relayed: Relayed) -> bool:
        return bool(relayed.outs or relayed.waiting) or relayed.cache is not None or self.tap(relayed.stream.stream)

    def announced(self) -> Iterator[tuple[StreamInfo, bool]]:
        """Every stream there is, and whether anybody takes it: a client, or a program on the feed."""
        for relayed in self.relayed.values():
            stream = relayed.stream.stream
            yield stream, bool(relayed.outs or relayed.waiting) or self.tap(stream)

    def refresh_interest(self, streams: Iterable[StreamId] | None = None, *, now: float) -> None:
        """The answer of `tap` may have changed: tell the origins of these streams that there still are, or of all."""
        for identity in list(self.relayed) if streams is None else streams:
            relayed = self.relayed.get(identity)
            if relayed is not None:
                self._answer(relayed, now)

    def _open(self, client: ClientName, identity: StreamId, now: float, first: int | None) -> None:
        relayed = self.relayed[identity]
        link = self._link(client, now)
        stream = relayed.stream.stream
        self._fanout.close(client, identity, now=now)  # of the same stream, before it ended
        if first is None:
            first = relayed.stream.delivered + 1
        ended = self._draining.take(client, stream, first, now=now)
        if ended is not None:  # it came back before it was gone
            relayed.outs[client] = ended
            self.presence.joined(identity.origin, client)
            return
        try:
            channel = link.outgoing.open(
                stream,
                first=first,
                now=now,
                replays=self._replays(link, relayed, first, now),
            )
        except UsageError as error:
            relayed.unopened.add(client)
            self.events.refused(client, "too_many_streams", str(error))
            text = str(error)[:400]
            self._tell(client, {"t": "denied", "topic": identity.topic, "code": "too_many_streams", "why": text}, now)
        except Exception as error:  # noqa: BLE001  (of this client's link: the origin and the others go on)
            relayed.unopened.add(client)
            self.failed(client, error, now=now)
        else:
            relayed.outs[client] = (link, channel)
            self.presence.joined(identity.origin, client)

    def _replays(self, link: Link, relayed: Relayed, first: int, now: float) -> list[Message]:
        """The latched messages that a late joiner may have before `first`: of those that are not too many for what may
        wait for it the newest, the others are counted as `queue_full`."""
        client, stream, cache = link.peer, relayed.stream.stream, relayed.cache
        if cache is None or cache.empty or not self.access.may_replay(client, stream.id.topic):
            return []
        messages = self.replays.below(cache, first)
        for payer in (link, relayed.source):  # whoever of them is being read has set it off, and it counts there
            if payer is not None:
                payer.reassembly.work_us += REPLAY_US * len(messages)
        bound = self._bounds.get(client)
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
        relayed = self.relayed.get(identity)
        if relayed is None or relayed.cache is None:
            return 0
        return int(relayed.cache.count * REPLAY_US * 1e-6 / UNIT_S)

    def _remove(self, identity: StreamId, now: float, *, drain: bool = True, source: Link | None = None) -> None:
        """The stream has ended. `drain`: what was owed of it is still delivered; `source`: who said so, so that
        subscribers are told in slices."""
        relayed = self.relayed.pop(identity, None)
        if relayed is None:
            return
        self._fanout.end(relayed)
        if relayed.cache is not None:
            self.replays.close(relayed.cache)
        if relayed.source is None:
            self._closed_local(relayed, now)
        for client in relayed.outs:
            self.presence.parted(identity.origin, client)
        if source is not None and drain:
            self._fanout.close_later(relayed)
        else:
            for client, (link, channel) in relayed.outs.items():
                if drain:
                    self._let_go(client, link, channel, now)
                else:
                    self._end_channel(client, link, channel, DropReason.FORBIDDEN, now)
        self.objects.delete_stream(identity)
        self.events.stream_removed(relayed.stream.stream)

    def _let_go(self, client: ClientName, link: Link, channel: OutChannel, now: float) -> None:
        """The channel's stream has ended: deliver what is still owed, or close it."""
        stream = channel.stream.id
        if not channel.reliable or not channel.retained:
            self._end_channel(client, link, channel, DropReason.DISCONNECTED, now)
        elif not self._may_drain(client, stream):
            self._end_channel(client, link, channel, DropReason.FORBIDDEN, now)
        else:
            self._draining.add(client, link, channel, max_bytes=self._max_queue_bytes(client), now=now)

    def _confirm(self, relayed: Relayed) -> None:
        """Tell the origin how far everybody who is owed has got."""
        stream, source = relayed.stream, relayed.source
        if source is None or not stream.reliable:
            return
        delivered = stream.delivered
        for _link, channel in relayed.outs.values():
            delivered = min(delivered, channel.watermark)
        source.taking.confirm(stream, delivered)

    # --- LinkHandler ----------------------------------------------------------------------------------------------

    def on_fault(self, link: Link, error: Exception, *, now: float) -> None:
        self.events.fault(link.peer, error)

    def on_up(self, link: Link, *, resumed: bool, now: float) -> None:
        self._absent_since.pop(link.peer, None)
        if link.end.peer_boot is not None:
            self.routing.returned(link.peer, link.end.peer_boot)
        self._subscriptions.pop(link.peer, None)  # half of one that was said in an earlier session
        if not resumed:
            for relayed in self.relayed.values():
                if link.peer in relayed.outs:
                    channel = relayed.outs[link.peer][1]
                    channel.prime(self._replays(link, relayed, channel.first_seq, now), now=now)
        self.presence.changed(link.peer, now=now)
        self.events.client_up(link.peer, resumed=resumed)

    def on_down(self, link: Link, reason: str, *, now: float) -> None:
        self._absent_since[link.peer] = now
        self.presence.changed(link.peer, now=now)
        self.events.client_down(link.peer, reason)

    def on_lane_closed(self, link: Link) -> None:
        self.events.lane_closed(link.peer)

    def offer_lane(self, client: ClientName, parameters: framing.Envelope, *, now: float) -> None:
        """Tell a client the keys of its datagram session (inside CURVE), and use that lane when it works."""
        link = self.links[client]
        link.control.send(
            {
                "t": "lane",
                "sid": parameters["sid"],
                "secret": parameters["secret"],
                "cipher": parameters["cipher"],
                "port": parameters["port"],
            },
            now=now,
        )
        link.open_lane(now=now)

    def join(self, client: ClientName, data: bytes, *, now: float) -> bool:
        """A connection says that it belongs to the client's session: open the express lane, unless it is open. `client`
        is bound to the connection's key. False: there is no such session. Raises WireError."""
        header = framing.decode_header(data)
        envelope = framing.decode_handshake(data)
        link = self.links.get(client)
        if link is None or framing.take_str(envelope, "name", max_length=64) != client:
            return False
        if not link.handshake.joins(envelope, header.tag):
            return False
        if LANE_EXPRESS not in link.lanes.by_id:
            link.open_lane(now=now, lane_id=LANE_EXPRESS)
        return True

    def on_rejected(self, link: Link, code: str, text: str, *, now: float) -> None:
        """A relay is never the initiator."""
        raise WireError("REFUSE is not for a relay")

    def on_announce(self, link: Link, announcement: Announcement, *, now: float) -> bool | None:
        stream = link.taking.streams[announcement.stream.id]
        identity = stream.stream.id
        if identity.origin != link.peer or identity.boot != link.end.peer_boot:
            raise RefusedError("origin", f"{link.peer} announced a stream of {identity.origin}")
        try:
            relayed = self._take(link, stream, now)
        except RefusedError as refusal:
            self.events.refused(link.peer, refusal.code, str(refusal))
            raise
        if stream.reliable:
            relayed.source = None  # one answer for all who are awaited
            self._await(announcement.owed, identity, link, now)
        relayed.source = link
        link.answers.answer(stream, self._wanted(relayed), now=now, owed=relayed.owed())
        return None

    def _take(self, source: Link | None, stream: InStream, now: float) -> Relayed:
        """Relay this stream from now on, or go on with it. Raises RefusedError; then it is not relayed any more."""
        identity = stream.stream.id
        relayed = self.relayed.get(identity)
        if relayed is None:
            relayed = self.relayed[identity] = Relayed(source, stream, self.replays)
        relayed.stream = stream
        try:
            try:
                check_onwards(stream.stream)
            except WireError as error:
                text = f"{identity.origin} may not publish {identity.topic[:80]!r}: nobody would take its announcement"
                raise RefusedError("bad_announcement", f"{text}: {error}") from None
            change = self.routing.announce(stream.stream)
        except RefusedError:
            self._apply(self.routing.withdraw(identity), now)
            refused = self.relayed.pop(identity, None)
            if refused is not None:
                self._fanout.end(refused)
                if refused.cache is not None:
                    self.replays.close(refused.cache)
            raise
        if source is not None:
            self._charge(source, change)
        relayed.keep_latched(self.replays)
        if change.added:
            self.events.stream_added(stream.stream)
            try:
                self.objects.put_stream(stream.stream, wall_ns=self._wall_ns(now), now=now)
            except RefusedError as refusal:
                self.events.refused(identity.origin, refusal.code, str(refusal))
        self._apply(change, now, source=source)
        return relayed

    def _await(self, owed: Sequence[str], identity: StreamId, source: Link, now: float) -> None:
        """Hold a reliable stream for clients that an earlier run of this relay owed it to."""
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
            if client not in self.links and len(self._awaited) >= MAX_AWAITED_CLIENTS:
                continue
            source.reassembly.work_us += AWAIT_US
            self._link(client, now)
            topics = self._awaited.setdefault(client, set())
            if len(topics) >= MAX_AWAITED_TOPICS and identity.topic not in topics:
                continue
            topics.add(identity.topic)
            if self.routing.info(identity) is None or client in self.routing.subscribers(identity):
                continue
            try:
                change = self.routing.also(client, identity.topic)
            except RefusedError as refusal:
                self.events.refused(client, refusal.code, str(refusal))
                continue
            denied += change.denied
            for match in change.matched:
                (own if match.stream == identity else others).append(match)
        self._apply(RouteChange(matched=tuple(others), denied=tuple(denied)), now)
        self._apply(RouteChange(matched=tuple(own)), now, source=source)

    def on_retract(self, link: Link, stream: InStream, *, now: float) -> None:
        link.reassembly.work_us += STREAM_US
        self._apply(self.routing.withdraw(stream.stream.id), now, source=link)
        self._remove(stream.stream.id, now)

    def _charge(self, link: Link, change: RouteChange) -> None:
        """What an announcement has cost is on the account of who made it, beside the channels that it opens or ends."""
        matching_us = int(self.routing.spent_units * UNIT_S * 1e6)
        link.reassembly.work_us += STREAM_US * (1 + len(change.removed)) + matching_us

    def on_message(self, link: Link, stream: InStream, message: Message, *, now: float) -> None:
        relayed = self.relayed.get(stream.stream.id)
        if relayed is None:
            return
        if relayed.waiting:  # nothing is read before they were told, unless an error of ours came in between
            for client in list(relayed.waiting):
                self._offer(client, stream.stream.id, now, first=message.seq)
        nbytes = len(message.body)
        link.reassembly.work_us += FORWARD_US * len(relayed.outs)
        if not self._guards[link.peer].admit(nbytes, now=now):
            self._discarded(link, stream, message.seq, DropReason.RATE_CAP)
            if not stream.reliable:
                return
            code = DROP_CODES[DropReason.RATE_CAP]
            message = Message(message.stream, message.seq, bytes([code]), message.stamp_ns, message.born_s, code)
            link.answers.report(stream, message.seq, DropReason.RATE_CAP, self.name)
        elif message.tombstone:
            self._discarded(link, stream, message.seq, message.drop_reason)
        else:
            self.received.of(stream.stream).arrived(nbytes, now - message.born_s, now)
            if self.fates is not None:
                self.fates.received(stream.stream, message, link.peer)
            if not relayed.outs:
                self._taken_by_nobody(relayed, link, message.seq)
        if self._forward(relayed, message, now) and stream.reliable:
            self._confirm(relayed)

    def _discarded(self, link: Link, stream: InStream, seq: int, reason: DropReason) -> None:
        self.received.of(stream.stream).drop_arrived(reason)
        if self.fates is not None:
            self.fates.discarded(stream.stream, seq, reason, link.peer)

    def _taken_by_nobody(self, relayed: Relayed, link: Link, seq: int) -> None:
        """Who wanted it has left while it was under way. It is dropped, unless it is kept, or read here."""
        stream = relayed.stream
        if relayed.cache is None and not self.tap(stream.stream):
            self._discarded(link, stream, seq, DropReason.UNWANTED)
        elif self.fates is not None:
            self.fates.held(stream.stream, seq, ClientName(""), exposed=False)

    def _forward(self, relayed: Relayed, message: Message, now: float) -> bool:
        """Offer a message to all who get it. True: with that, the stream may be delivered further than before."""
        stream = relayed.stream
        behind = not relayed.outs
        for client, (out_link, channel) in relayed.outs.items():
            try:
                if message.seq != channel.next_seq:
                    if message.seq < channel.next_seq:
                        self.received.of(stream.stream).drop_arrived(DropReason.DUPLICATE)  # it has gone that way
                        continue
                    if stream.reliable:
                        out_link.outgoing.skip(
                            channel, message.seq, now=now
                        )  # what lies between was given up before that
                bound = self._bounds.get(client)
                if bound is None:
                    out_link.sender.submit(channel, message, now=now, forced=True)
                else:
                    spent_us = bound.submit(out_link, channel, message, now=now)
                    if relayed.source is not None:
                        relayed.source.reassembly.work_us += spent_us
            except Exception as error:  # noqa: BLE001  (of that client's link: the others get theirs)
                self._not_taken(relayed, out_link, channel, message, error, now)
            behind = behind or channel.watermark >= message.seq
        if not message.tombstone:
            try:
                if relayed.cache is not None:
                    self.replays.add(relayed.cache, message)
                self.objects.observe(
                    stream.stream.id, message.seq, message.body, wall_ns=message.stamp_ns, now=now, codec=message.codec
                )
                self.events.shell.message(stream.stream, message, now=now)
            except Exception as error:  # noqa: BLE001  (the subscribers have it: it must not be taken for lost)
                self.events.fault(stream.stream.id.origin, error)
        return behind

    def _not_taken(
        self, relayed: Relayed, link: Link, channel: OutChannel, message: Message, error: Exception, now: float
    ) -> None:
        """A client's link failed at a message: its session ends, and unless it has the message, the origin is told."""
        link.failed(error, now=now)
        if channel.next_seq > message.seq:
            return
        try:
            link.sender.reject(channel, message, DropReason.FAULT, now=now)
        except Exception as again:  # noqa: BLE001
            link.fault(again)
            if channel.reliable and relayed.source is not None:
                relayed.source.answers.report(relayed.stream, message.seq, DropReason.FAULT, link.peer)

    def on_in_drop(self, link: Link, stream: InStream, reason: DropReason, nbytes: int, count: int) -> None:
        self.received.of(stream.stream).drop_arrived(reason, count)

    def on_out_drop(self, link: Link, channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None:
        if not channel.reliable:
            return
        relayed = self.relayed.get(channel.stream.id)
        if relayed is None or relayed.source is None:
            return
        if channel is self._unsubscribed or (reason is DropReason.UNWANTED and link.peer not in relayed.outs):
            return  # it is owed nothing any more, also of what was sent whole, and others may have the message
        now, source = link.now, relayed.source
        first, last = outs[0].seq, outs[-1].seq  # the origin counts what it has not counted of them
        report = partial(source.answers.report, relayed.stream, first, reason, link.peer, last - first + 1)
        self._for(source.peer, now, report)

    def on_delivered(self, link: Link, channel: OutChannel, *, now: float) -> None:
        relayed = self.relayed.get(channel.stream.id)
        if relayed is not None:
            link.reassembly.work_us += len(relayed.outs) // CONFIRMED_PER_US
            self._confirm(relayed)

    def on_refused(self, link: Link, channel: OutChannel, code: str, text: str, *, now: float) -> None:
        self.events.refused(link.peer, code, text)

    def on_skipped(self, link: Link, stream: InStream, count: int, *, now: float) -> None:
        """Messages of the origin that were given up before they got here: subscribers go on behind them."""
        relayed = self.relayed.get(stream.stream.id)
        if relayed is None or not stream.reliable:
            return
        for client, (out_link, channel) in relayed.outs.items():
            skip = partial(out_link.outgoing.skip, channel, stream.delivered + 1, now=now, silent=stream.paused)
            self._for(client, now, skip)

    def on_wanted(self, link: Link, channel: OutChannel, *, now: float) -> None:
        """Nothing depends on it here: what a client subscribed to it gets."""

    def on_definition(self, link: Link, digest: str, *, now: float) -> None:
        link.reassembly.work_us += len(self.links)
        for client, other in self.links.items():
            self._for(client, now, partial(other.definition_known, digest, now=now))

    def on_control(self, link: Link, envelope: framing.Envelope, attachment: bytes, *, now: float) -> None:
        kind = envelope["t"]
        if kind == "subscribe":
            self._subscribe(link.peer, envelope, now)
        elif kind == "object":
            try:
                apply_object(self.objects, self.access, link.peer, envelope, attachment, now=now)
            except RefusedError as refusal:
                self.events.refused(link.peer, refusal.code, str(refusal))
        elif kind == "lane_ask":
            link.reassembly.work_us += LANE_US
            self.events.lane_asked(link.peer, framing.take_strings(envelope, "ciphers", max_length=64))
        else:
            raise WireError(f"unknown control message {kind!r}")

    def _subscribe(self, client: ClientName, envelope: framing.Envelope, now: float) -> None:
        parts = self._subscriptions.setdefault(client, [])
        parts += framing.take_strings(envelope, "patterns")
        if "known" in envelope:
            known = framing.take_strings(envelope, "known", max_length=64)
            self.presence.ask(client, map(ClientName, filter(is_client_name, known)))
        if framing.take_bool(envelope, "more"):
            if len(parts) > MAX_SUBSCRIPTION_PARTS * framing.MAX_ENVELOPE_ITEMS:
                raise WireError(
                    f"more than {MAX_SUBSCRIPTION_PARTS * framing.MAX_ENVELOPE_ITEMS} subscription patterns"
                )
            return
        self.matching.ask(client, self._subscriptions.pop(client), now=now)
        if framing.take_bool(envelope, "peers"):
            self.presence.watch(client, now=now)

    def _subscribed(self, client: ClientName, parts: list[str], now: float) -> None:
        self._awaited.pop(client, None)
        self._heard.add(client)
        # What is a name and no pattern is denied by name: that gives nothing away about what there is.
        names = {TopicName(part) for part in parts if name_problem(part) is None}
        patterns = [part for part in parts if part not in names]
        try:
            self._apply(self.routing.subscribe(client, patterns, exact=names), now)
            if self._draining.has(client):
                self._draining.keep(
                    lambda other, stream: other != client or self.routing.takes(client, stream.topic),
                    DropReason.UNWANTED,
                    now=now,
                )
        except RefusedError as refusal:
            self.events.refused(client, refusal.code, str(refusal))
            bad = refusal.pattern if isinstance(refusal, BadPatternError) else ""
            self._tell(client, {"t": "denied", "pattern": bad, "code": refusal.code, "why": str(refusal)[:400]}, now)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        for link in self.links.values():
            link.validate()
        self.routing.validate()
        self.objects.validate()
        self.replays.validate()
        self.definitions.validate()
        for identity, relayed in self.relayed.items():
            outs = set(self.routing.subscribers(identity))
            held = set(relayed.outs) | relayed.unopened | relayed.waiting.keys()
            assert not relayed.waiting or self._fanout.holds(relayed), f"{identity.topic}: some are never told of it"
            assert relayed.unopened.isdisjoint(relayed.waiting), f"{identity.topic}: who waits was told already"
            assert held == outs, f"{identity.topic}: channels {held} but routes {outs}"
            assert not relayed.unopened & set(relayed.outs), f"{identity.topic}: a channel that could not be opened"
            latched = relayed.stream.stream.spec.latched
            assert (relayed.cache is not None) == latched, f"{identity.topic}: its cache does not fit its spec"
            for client, (link, channel) in relayed.outs.items():
                assert self.links.get(client) is link, f"{identity.topic} goes to a link of {client} that is gone"
                assert link.outgoing.by_stream.get(identity) is channel, (
                    f"{identity.topic}: a closed channel to {client}"
                )
        for origin in self._fanout.origins():
            assert origin in self.links, f"streams of {origin}, who is gone, are to be told of"
        taken: dict[ClientName, Counter[ClientName]] = defaultdict(Counter)
        for identity, relayed in self.relayed.items():
            for client in relayed.outs if identity.origin not in self.local_owners else ():
                taken[client][identity.origin] += 1
        self.presence.validate(taken)
        known = {info.id for info in self.routing.infos()}
        assert known == self.relayed.keys(), f"routes and streams differ: {known ^ self.relayed.keys()}"
        held_channels = {id(pair[1]) for relayed in self.relayed.values() for pair in relayed.outs.values()}
        held_channels |= self._fanout.closing()
        held_channels |= self._draining.validate(self.links)
        for client, link in self.links.items():
            for channel in link.sender.channels.values():
                assert id(channel) in held_channels, f"{channel.stream.id.topic}: nobody's channel to {client}"
        for table in (self._absent_since, self._awaited, self._bounds, self._heard):
            assert set(table) <= set(self.links), "something is kept for clients that are forgotten"
        assert all(len(topics) <= MAX_AWAITED_TOPICS for topics in self._awaited.values()), "too much is awaited"
