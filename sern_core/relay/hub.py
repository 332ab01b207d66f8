"""The relay's core: one link per client, who gets what, and who has got it. Pure.

Messages arrive whole and in their turn from one link and are offered, unchanged, to the links of all subscribers, each
with a scheduler and a window of its own: a slow subscriber sheds only its own traffic, by class.

Reliable streams: the origin is told "delivered up to n" when all *required* clients, those that subscribe to the
stream, have confirmed n. An origin remembers their names; a relay that starts anew learns them from the announcement
and holds messages for those clients before they have come back (they are *absent*). A client that stays away longer
than `resume_s` is dropped, and what it has not confirmed is reported to the origins. One that says goodbye and has
confirmed everything is dropped at once, and so is one whose name is revoked. One that says that it goes on at another
relay is dropped when nobody is left here who needs what is kept of it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from sern_core.link.definitions import DefinitionStore
from sern_core.link.housekeeping import TIDY_S
from sern_core.link.link import Link
from sern_core.objects.registry import ObjectRegistry
from sern_core.objects.xr_object import XrObject
from sern_core.path.lanes import LANE_PRIORITY
from sern_core.relay.absent import AbsentClients
from sern_core.relay.access import AccessTable
from sern_core.relay.claims import Claims
from sern_core.relay.clients import Clients
from sern_core.relay.far_objects import PEER_BYTES
from sern_core.relay.feed_owners import FeedOwners
from sern_core.relay.forwarding import Forwarding
from sern_core.relay.holding import Holding
from sern_core.relay.home_changes import HomeChanges
from sern_core.relay.hub_checks import check_channels, check_streams, taken
from sern_core.relay.hub_events import GuardedEvents, HubEvents, Relayed
from sern_core.relay.hub_link_handler import HubLinkHandler
from sern_core.relay.hub_matching import Matching
from sern_core.relay.hub_port import HubPort
from sern_core.relay.hub_subscriptions import Subscriptions
from sern_core.relay.interest import RoutingLimits
from sern_core.relay.local_streams import LocalStreams
from sern_core.relay.moved import MovedClients
from sern_core.relay.object_exchange import ObjectExchange
from sern_core.relay.peer_rules import RulesExchange
from sern_core.relay.peers import Peers, says_hello
from sern_core.relay.presence import Presence
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.revocations import Revocations
from sern_core.relay.route_change import RouteChange
from sern_core.relay.routing import RoutingTable
from sern_core.relay.traces import Traces
from sern_core.vocabulary.key_news import RelayKeys
from sern_core.vocabulary.names import is_peer, peer_name
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import ClientName, DropReason
from sern_core.wire import framing
from sern_core.wire.numbering import Numbering


@dataclass(frozen=True, slots=True)
class HubParams:
    """`cache_bytes`: latched messages kept in all. `resume_s`: how long an absent client is waited for. `routing`: what
    one client may hold in the table of topics."""

    cache_bytes: int = 64 * 2**20
    resume_s: float = 600.0
    routing: RoutingLimits = field(default_factory=RoutingLimits)


class Hub:
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
        wall_ns: Callable[[float], int],
        now: float,
        params: HubParams | None = None,
        traces: Traces | None = None,
        lossless: bool = True,
    ) -> None:
        self.name = name
        self.boot = boot
        params = params or HubParams()
        self.traces = traces or Traces(enabled=False)
        """Why messages to the clients were held or dropped."""
        self._link_params = link
        self._scheduler_params = scheduler
        self._lossless = lossless
        self._numbering = Numbering()  # of the relay's own streams that were closed
        self._tidy_due_s = now + TIDY_S
        self.after: Callable[[], None] = lambda: None
        """Called when something was done by time that may have given any client's link something to send; set by the
        shell."""
        self.events = GuardedEvents(events)
        self.definitions = DefinitionStore()
        self.objects = ObjectRegistry(epoch=boot)
        self.routing = RoutingTable(access, limits=params.routing)
        self.matching = Matching(self.routing, self._subscribed, self._apply)
        self.local_owners: set[ClientName] = set()
        """Names under which the relay itself publishes; no client may have one of them."""
        clients = self.clients = Clients(
            access, self.events, self._make_link, resume_s=params.resume_s, limits=link.limits
        )
        self.links = clients.links

        def wall_us(now: float) -> int:
            return wall_ns(now) // 1000

        self.feeds = FeedOwners(name, self.local_owners, clash=self._clash, contested=self._contested)
        self.peers = Peers(
            peer_name(name),
            clients,
            self.routing,
            self.feeds,
            displaced=self._displaced,
            changed=self._moved,
            wall_us=wall_us,
        )
        """The other relays, where there is a fabric."""
        self.routing.rights.stays = self.feeds.stay
        self.routing.rights.home = self.peers.home
        self.rules = RulesExchange(
            access.rules, clients, self.routing.rights, self.events, reached=self.peers.reached, judge=self._judge
        )
        self.revocations = Revocations(clients, self.events, self.peers.reached)
        self.presence = Presence(
            clients.links,
            self.local_owners,
            self.matching.due_s,
            clients.attempt,
            self._was_read,
            link.limits,
            home=self.peers.home,
        )
        streams = self.streams = RelayedStreams(
            clients,
            self.routing,
            self.presence,
            self.objects,
            self.events,
            cache_bytes=params.cache_bytes,
            wall_ns=wall_ns,
            ended=self._own_ended,
            limits=link.limits,
            home=self.peers.home,
            now=now,
        )
        self.relayed = streams.by_id
        self.claims = Claims(
            clients,
            self.routing,
            home=self.peers.home,
            wall_us=wall_us,
            give_way=lambda stream, why, now: streams.refuse(stream, "name_taken", why, now),
        )
        streams.check, streams.changed = self.claims.check, self.claims.changed
        self.forwarding = Forwarding(name, clients, streams, self.objects, self.events)
        self.received = self.forwarding.received
        self.local = LocalStreams(
            boot, self.local_owners, clients.links, self.routing, self._numbering, streams, self.forwarding,
            owned=self._owned,
        )  # fmt: skip
        self.exchange = ObjectExchange(
            self.objects,
            clients.links,
            access=lambda: clients.access,
            text_of=self._text_of,
            refused=self.events.refused,
            attempt=clients.attempt,
            home=self.peers.home,
            via=self.routing.via,
        )
        self.holding = Holding(clients, streams, self.definitions.get)
        """Durable streams, where the shell has a place on disk for them."""
        streams.on_disk = self.holding.position
        self.forwarding.hold = self.holding.message
        self.absent = AbsentClients(clients, streams, self.routing, self.events, known, link.limits)
        streams.moves.asked = self.absent.asked
        streams.moves.deserted = self.peers.deserted
        self.moved = MovedClients(clients, self.routing, streams, self.local_owners)
        self.subscriptions = Subscriptions(
            clients, self.events, self.presence, self.matching, self.routing, streams, self.exchange, self.absent
        )
        self._home_changes = HomeChanges(
            clients, self.routing, streams, self.events, self.presence, self.matching, self.exchange, self.absent,
            self.peers,
        )  # fmt: skip
        self.link_handler = HubLinkHandler(
            clients,
            self.routing,
            streams,
            self.objects,
            self.events,
            forwarding=self.forwarding,
            exchange=self.exchange,
            subscriptions=self.subscriptions,
            presence=self.presence,
            holding=self.holding,
            absent=self.absent,
            moved=self.moved,
            peers=self.peers,
            claims=self.claims,
            feeds=self.feeds,
            rules=self.rules,
            revocations=self.revocations,
            max_claims=params.routing.max_all_streams,
        )

    # --- how the parts hang together ------------------------------------------------------------------------------

    def _make_link(self, client: ClientName, now: float) -> Link:
        own = self.peers.own if is_peer(client) else self.name
        link = Link(
            name=own,
            boot=self.boot,
            peer=client,
            initiator=is_peer(client) and says_hello(own, client),
            towards_relay=is_peer(client),
            handler=self.link_handler,
            definitions=self.definitions,
            link=self._link_params,
            scheduler=self._scheduler_params,
            trace=self.traces.of(client),
            now=now,
            lossless=self._lossless and not is_peer(client),
            any_size=True if is_peer(client) else None,
            leased=is_peer(client),
            auto_confirm=False,
        )
        link.receiver.on_stray = self.received.stray
        link.end.fates = self.forwarding.fates
        link.reading.on_read = self._was_read
        link.finish = self._finish
        return link

    def _text_of(self, item: XrObject) -> str:
        """The text of an object's definition: of a topic's it is kept once for all streams of a type."""
        about = self.objects.about(item.id)
        relayed = None if about is None or about[2] is None else self.relayed.get(about[2])
        if item.definition or relayed is None:
            return item.definition or self.exchange.peers.far.text(item.id)[0]
        digest = relayed.stream.stream.definition_hash
        return self.definitions.get(digest) if digest in self.definitions else ""

    def _was_read(self) -> None:
        self.after()

    def _finish(self, link: Link, now: float) -> bool:
        return self.streams.fanout.go_on(link, now=now)

    def _apply(self, change: RouteChange, now: float) -> None:
        self.streams.apply(change, now)

    def _subscribed(self, client: ClientName, parts: list[str], now: float) -> None:
        self.subscriptions.take(client, parts, now)

    def _own_ended(self, relayed: Relayed, now: float) -> None:
        """A stream of the relay's own has ended: should it come again, it counts on."""
        self._numbering.ended(relayed.stream.stream.id, relayed.stream.delivered, now=now)

    # --- clients --------------------------------------------------------------------------------------------------

    def ports(self) -> list[HubPort]:
        return list(self.clients.port_of.values())

    def sweep(self, *, now: float) -> None:
        """Let go of clients that stay away, and of ended streams that are fully delivered. Call about once a second,
        and then `lapse`."""
        self.lapse(now=now)
        for client in (*self.clients.gone(now), *self.moved.not_needed(), *self.streams.moves.not_needed()):
            if client in self.links and not self.holding.owes(client):
                self.clients.attempt(client, now, partial(self._forget, client, now))
        self.clients.sweep_orphans(now)
        self.streams.draining.sweep(now=now)
        self.streams.sweep(now)
        self.streams.moves.sweep(now=now)
        self.holding.look(now=now)
        self.clients.sweep(now)
        if now >= self._tidy_due_s:
            self._tidy_due_s = now + TIDY_S
            self.received.tidy({identity.topic for identity in self.relayed}, now=now)
            self._numbering.tidy(now=now)
        self.matching.sweep(now=now)
        for client in self.streams.fanout.announcers():  # those who read on when it is due have done so
            link = self.links[client]
            if link.reading.due_s is None:
                link.reassembly.work_us = 0
                self.streams.fanout.go_on(link, now=now)
        self.presence.sweep(now=now)

    def tell_objects(self, *, now: float) -> None:
        """Tell clients what has changed of the objects that they subscribe to, and peers what is wanted here. Call ten
        times a second."""
        self.exchange.pump(now=now)
        self.exchange.peers.work(now=now)
        self.peers.ask(now=now)
        self.claims.tell(now=now)
        self.after()

    def lapse(self, *, now: float) -> bool:
        """Retention goes on while clients are away, and clients are told of their peers. True: there is more to do;
        call again in another turn."""
        return self.clients.lapse(now) or self.presence.tell(now=now)

    def left(self, client: ClientName, *, now: float) -> None:
        """A client has said goodbye. One that has streams, or wants reliable ones, may come back to them (a daemon that
        is started anew), and is waited for like any other; the others are forgotten. So is one that goes on at another
        relay, once nobody here needs what is kept of it."""
        if is_peer(client):
            return
        channels = self.links[client].sender.channels.values()
        if not self.routing.streams_of(client) and not any(channel.reliable for channel in channels):
            self._forget(client, now)
        elif self.links[client].moved:
            self.moved.add(client)

    def forget(self, client: ClientName, reason: str, *, now: float) -> None:
        """The client's name is revoked: its session ends, and with it whatever is held of it or for it."""
        if client in self.links:
            self.clients.end_session(client, reason, now=now)
            self._forget(client, now, reason=DropReason.FORBIDDEN)

    def _forget(self, client: ClientName, now: float, *, reason: DropReason = DropReason.DISCONNECTED) -> None:
        link = self.links[client]
        reliable = {channel.counters.topic for channel in link.sender.channels.values() if channel.reliable}
        self.streams.drop_client(client, reason, now)
        self.events.lane_closed(client)
        link.close_streams()
        self.clients.forget(client, now)
        lost = [counters for counters in link.counters.values() if counters.topic in reliable]
        self.clients.given_up.keep(client, lost, now=now)
        self.traces.forget(client)
        self.subscriptions.forget(client)
        self.matching.forget(client)
        self.absent.forget(client)
        self.moved.discard(client)
        self.exchange.forget(client)
        if is_peer(client):
            self.peers.lost(client, now=now)
            self.claims.lost(client)
            self.rules.lost(client)
        else:
            self.peers.left(client, now=now)

    # --- other relays ---------------------------------------------------------------------------------------------

    def add_peer(self, relay: ClientName, address: str = "") -> HubPort:
        """There is another relay of the fabric, which `address` leads to: the port of the hop between the two."""
        peer = peer_name(relay)
        if peer not in self.peers.names:
            self.objects.make_room(PEER_BYTES)
        self.peers.add(peer)
        return HubPort(self, peer, address, greets=says_hello(self.peers.own, peer))

    def _owned(self, now: float) -> None:
        """The relay is about to publish under a name of its own."""
        self.peers.tell_feeds(now=now)

    def _clash(self, peer: ClientName, text: str) -> None:
        self.events.refused(peer, "name_taken", text)

    def _contested(self, owner: ClientName, now: float) -> None:
        """A name of the relay's own has become one that another relay has, too, or is that no more."""
        self.streams.apply(self.routing.judge(owner), now)

    def _displaced(self, client: ClientName, peer: ClientName, now: float) -> None:
        self._home_changes.displaced(client, peer, now)

    def _moved(self, client: ClientName, now: float) -> None:
        self._home_changes.moved(client, now)

    def _judge(self, peer: ClientName, now: float) -> None:
        """What the rules of a peer grant has changed."""
        self.streams.rejudge(peer, now)
        for client in self.links:
            self.matching.look(client, now=now)

    def revoke(self, access: AccessTable, *, now: float) -> None:
        """New access rules: what they no longer allow ends now."""
        self.clients.limit(access, now)
        self.streams.revoke(access, now)
        self.exchange.revoke()
        self.rules.use(access.rules, now=now)
        for client in self.links:
            self.matching.look(client, now=now)

    def offer_lane(self, client: ClientName, parameters: framing.Envelope, *, now: float) -> None:
        """Tell a client the keys of its datagram session (inside CURVE), and use that lane when it works."""
        link = self.links[client]
        lane = {
            "t": "lane",
            "sid": parameters["sid"],
            "secret": parameters["secret"],
            "cipher": parameters["cipher"],
            "port": parameters["port"],
        }
        link.control.send(lane, now=now)
        link.open_lane(now=now)

    def tell_keys(self, client: ClientName, keys: RelayKeys, *, now: float) -> None:
        """Tell a client of the relay's keys; only one that asked since it connected."""
        link = self.links[client]
        said: framing.Envelope = {"t": "keys", "relay": list(keys.relay), "takes": keys.takes, "key": keys.key,
                                  "code": keys.code, "why": keys.why[:400]}  # fmt: skip
        link.control.send(said, now=now)

    def join(self, client: ClientName, data: bytes, *, now: float) -> bool:
        """A connection belongs to the session of the client: open the priority lane, unless it is open. `client`
        is bound to the connection's key. False: there is no such session. Raises WireError."""
        header = framing.decode_header(data)
        envelope = framing.decode_handshake(data)
        link = self.links.get(client)
        if link is None or framing.take_str(envelope, "name", max_length=64) != client:
            return False
        if not link.handshake.joins(envelope, header.tag):
            return False
        if LANE_PRIORITY not in link.lanes.by_id:
            link.open_lane(now=now, lane_id=LANE_PRIORITY)
        return True

    def validate(self) -> None:
        """Internal consistency, for tests."""
        self.clients.validate()
        self.routing.validate()
        self.objects.validate()
        self.streams.replays.validate()
        self.definitions.validate()
        self.traces.validate()
        check_streams(self.streams, self.routing, self.links)
        check_channels(self.streams, self.links, self.exchange.channels())
        self.presence.validate(taken(self.streams, self.local_owners))
        self.exchange.validate()
        self.absent.validate(self.links)
        self.peers.validate()
        self.claims.validate()
        self.revocations.validate()
        self.feeds.validate()
        self.streams.moves.validate()
        self.moved.validate()
