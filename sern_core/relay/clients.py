"""The clients of a relay: their links and connections, the limits of each, and who stays away for how long. Pure."""

from collections.abc import Callable
from functools import partial
from typing import Final

from sern_core.link.handshake import DISPLACED
from sern_core.link.link import Link
from sern_core.relay.access import AccessTable, ClientLimits, RateGuard
from sern_core.relay.bound import QueueBound
from sern_core.relay.given_up import GivenUp
from sern_core.relay.hub_events import GuardedEvents
from sern_core.relay.hub_port import HubPort
from sern_core.vocabulary.limits import PeerLimits
from sern_core.vocabulary.names import is_peer
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing

ORPHAN_S: Final = 60.0
"""A session that a blackout cost its TCP connection has ended when its datagram lane says nothing for so long: longer
than any blackout that is worth waiting for with keys in hand. Where the connection ended while datagrams still came, it
is the client's process that ended, and the heartbeat's time is enough."""


class Clients:
    """`make_link` makes the relay's end of a client's link."""

    def __init__(
        self,
        access: AccessTable,
        events: GuardedEvents,
        make_link: Callable[[ClientName, float], Link],
        *,
        resume_s: float,
        limits: PeerLimits,
    ) -> None:
        self.access = access
        self._limits = limits
        self._events = events
        self._make_link = make_link
        self.resume_s = resume_s
        """How long an absent client is waited for."""
        self.links: dict[ClientName, Link] = {}
        """The links of all clients that are remembered, connected or not."""
        self.port_of: dict[ClientName, HubPort] = {}
        """The connection that has the session of each client."""
        self._guards: dict[ClientName, RateGuard] = {}
        self._bounds: dict[ClientName, QueueBound] = {}
        self._absent_since: dict[ClientName, float] = {}
        self.given_up = GivenUp()

    # --- coming and going -----------------------------------------------------------------------------------------

    def link(self, client: ClientName, now: float) -> Link:
        """The client's link; it may have one although it never came."""
        link = self.links.get(client)
        if link is None:
            link = self.links[client] = self._make_link(client, now)
            self._limit(client, now)
            self._absent_since[client] = now
            self.given_up.back(client)
        return link

    def greet(self, port: HubPort, hello: framing.Envelope, header: framing.Header, *, now: float) -> None:
        """A client says hello on a connection. A newer connection of the same client retires the older one."""
        link = self.link(port.client, now)
        older = self.port_of.get(port.client)
        another = older is not port
        tag, rival = link.end.tag, link.established and framing.take_int(hello, "boot") != link.end.peer_boot
        if not link.accept(hello, header.tag, header.stamp_us, now=now, another_connection=another):
            return
        if older is not None and older is not port:
            older.link = None
            if rival:  # its connection is up: it did not end before the other began
                older.displace(tag, f"from {port.address}" if port.address else "", now=now)
                self._events.refused(
                    port.client, DISPLACED, f"another process connected as {port.client} from {port.address or '?'}; "
                    f"the one from {older.address or '?'} has no session any more"
                )  # fmt: skip
        port.link = link
        self.port_of[port.client] = port
        self._absent_since.pop(port.client, None)

    def of_clients(self) -> list[Link]:
        """The links of all but other relays."""
        return [link for name, link in self.links.items() if not is_peer(name)]

    def call(self, port: HubPort, *, now: float) -> None:
        """Say hello on a connection to another relay."""
        older = self.port_of.get(port.client)
        if older is not None and older is not port:
            older.link = None
        port.link = self.link(port.client, now)
        self.port_of[port.client] = port
        port.link.connected(now=now)

    def came(self, client: ClientName) -> None:
        """A session has begun."""
        self._absent_since.pop(client, None)

    def went(self, client: ClientName, now: float) -> None:
        """A session has ended."""
        self._absent_since[client] = now

    def end_session(self, client: ClientName, reason: str, *, now: float) -> None:
        """The client's key no longer holds: its session ends, whatever lanes it has. It may come back with another."""
        link = self.links.get(client)
        if link is not None:
            link.close(reason, now=now)
            link.disconnected(now=now)

    def went_over(self, client: ClientName, relay: str, *, now: float) -> None:
        """A client that has a session here has begun another one at another relay."""
        link, port = self.links.get(client), self.port_of.get(client)
        if link is not None and link.established and port is not None:
            port.displace(link.end.tag, f"at the relay {relay}", now=now)
        self.end_session(client, f"{client} has connected to the relay {relay}", now=now)

    def forget(self, client: ClientName, now: float) -> None:
        """The last step of giving a client up (`Hub.forget`): nothing of it is relayed any more."""
        link = self.links.pop(client)
        port = self.port_of.pop(client, None)
        if port is not None:
            port.forget(link.end.tag, now=now)
        self._absent_since.pop(client, None)
        self._bounds.pop(client, None)

    # --- errors ---------------------------------------------------------------------------------------------------

    def failed(self, client: ClientName, error: Exception, *, now: float) -> None:
        """An error of ours about one client: its session ends, and nobody else's."""
        link = self.links.get(client)
        if link is None:
            self._events.fault(client, error)
        else:
            link.failed(error, now=now)

    def attempt(self, client: ClientName, now: float, call: Callable[[], object]) -> None:
        """Do something about a client that need not be the one whose datagram is being read: if it fails, that
        client's session ends."""
        try:
            call()
        except Exception as error:  # noqa: BLE001  (whoever is at work goes on, and the other clients get theirs)
            self.failed(client, error, now=now)

    def tell(self, client: ClientName, envelope: framing.Envelope, now: float) -> None:
        """Say something to a client, if it is there; whoever comes later says what it wants anew, and is told then."""
        link = self.links.get(client)
        if link is not None:
            self.attempt(client, now, partial(link.control.send, envelope, now=now))

    # --- limits ---------------------------------------------------------------------------------------------------

    def _limit(self, client: ClientName, now: float) -> None:
        """Put the limits of the access rules in force."""
        limits = ClientLimits(max_queue_bytes=None) if is_peer(client) else self.access.limits(client)
        guard = self._guards.get(client)
        if guard is None or not guard.holds(limits):  # else what it has used up stays used up
            self._guards[client] = RateGuard.of(limits, now=now)
        if limits.max_queue_bytes is None:
            self._bounds.pop(client, None)
        else:
            self._bounds[client] = QueueBound(limits.max_queue_bytes)

    def limit(self, access: AccessTable, now: float) -> None:
        """There are new access rules."""
        self.access = access
        for client in self.links:
            self._limit(client, now)

    def admits(self, client: ClientName, nbytes: int, now: float) -> bool:
        """Whether a message of the client is within its rates."""
        return self._guards[client].admit(nbytes, now=now)

    def bound(self, client: ClientName) -> QueueBound | None:
        """What bounds the bytes that wait for the client; None: nothing does."""
        return self._bounds.get(client)

    def max_queue_bytes(self, client: ClientName) -> int | None:
        """Bytes that may wait for the client; None: no limit."""
        bound = self._bounds.get(client)
        return None if bound is None else bound.max_bytes

    # --- time -----------------------------------------------------------------------------------------------------

    def lapse(self, now: float) -> bool:
        """Retention goes on while clients are away. True: there is more to do."""
        room = self._limits.lapsed_a_sweep  # for all together: each may have a little
        for client in list(self._absent_since):
            link = self.links[client]
            if link.established:
                continue
            lapsed = link.sender.lapsed
            link.handle_timeout(now=now)
            room -= link.sender.lapsed - lapsed
            if room <= 0:
                return True
        return False

    def gone(self, now: float) -> list[ClientName]:
        """Those that have stayed away for too long."""
        away = self._absent_since.items()
        return [c for c, since_s in away if not self.links[c].established and now - since_s > self.resume_s]

    def sweep_orphans(self, now: float) -> None:
        """End sessions of which only a silent datagram lane is left."""
        for client, link in list(self.links.items()):
            if client in self.port_of or not link.established:
                continue
            link.handle_timeout(now=now)
            view = link.observe(now=now)
            silent_s = view.waiting_s
            patience_s = ORPHAN_S if link.handshake.cut_off else link.end.params.heartbeat_timeout_s
            if view.stalled and silent_s is not None and silent_s > patience_s:
                link.close_lane(now=now, reason=f"its connection is gone and no datagram came for {silent_s:.0f} s")

    def sweep(self, now: float) -> None:
        """End sessions of clients that do not read, and let go of what is left of those that are forgotten."""
        for link in list(self.links.values()):
            if link.deaf:
                link.close("it does not read what it is told", now=now)
        for client in [client for client in self._guards.keys() - self.links.keys() if self._guards[client].full(now)]:
            del self._guards[client]  # by name, over sessions: one that comes back at once has no new burst
        self.given_up.sweep(now=now)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        for link in self.links.values():
            link.validate()
        for table in (self._absent_since, self._bounds):
            assert set(table) <= set(self.links), "something is kept for clients that are forgotten"
