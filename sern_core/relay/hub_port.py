"""The relay's end of one transport connection: what the lane below hands its datagrams to. Pure.

A connection is not yet a client: who speaks is known from the key (or believed, without keys), a session exists after
HELLO, and a newer connection of the same client takes the session over. `Hub` keeps the links; a port finds its own.
"""

import math
from collections.abc import Container
from typing import Final, Protocol

from sern_core.link.end import microseconds
from sern_core.link.handshake import DISPLACED
from sern_core.link.link import Link
from sern_core.relay.hub_matching import Matching
from sern_core.vocabulary.errors import RemoteError, VersionError
from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_core.wire import framing

RESET_INTERVAL_S: Final = 0.5


class PortClients(Protocol):
    """What a port needs of the clients that there are."""

    port_of: "dict[ClientName, HubPort]"
    """The connection that has the session of each client."""

    def greet(self, port: "HubPort", hello: framing.Envelope, header: framing.Header, *, now: float) -> None: ...

    def call(self, port: "HubPort", *, now: float) -> None: ...

    def failed(self, client: ClientName, error: Exception, *, now: float) -> None: ...


class PortHub(Protocol):
    """What a port needs of the hub that keeps its link."""

    matching: Matching

    @property
    def clients(self) -> PortClients: ...

    @property
    def local_owners(self) -> Container[str]: ...

    def left(self, client: ClientName, *, now: float) -> None: ...

    def after(self) -> None: ...


class HubPort:
    """One transport connection of one client, as the lane below sees it. `client` is bound to the peer's key;
    `address` is where it comes from, for people. `greets`: it leads to another relay, to which we say HELLO."""

    def __init__(self, hub: PortHub, client: ClientName, address: str = "", *, greets: bool = False) -> None:
        self.hub = hub
        self.client = client
        self.address = address
        self._greets = greets
        self.link: Link | None = None
        self.replies: list[bytes] = []
        """What is to be said that is of no session."""
        self._reset_due_s = -float("inf")

    @property
    def current(self) -> bool:
        return self.link is not None and self.hub.clients.port_of.get(self.client) is self

    def connected(self, *, now: float) -> None:
        """A client speaks first."""
        if self._greets:
            self.hub.clients.call(self, now=now)

    def disconnected(self, *, now: float) -> None:
        if self.current and self.link is not None:
            del self.hub.clients.port_of[self.client]
            self.link.disconnected(now=now)
        self.link = None

    def receive(self, data: framing.Datagram, *, now: float) -> None:
        """One datagram. Raises WireError or VersionError; the caller closes the connection."""
        link = self.link
        if link is not None and self.current and data[2:3] != b"\x01":
            had_session = link.established
            link.receive(data, now=now)
            if had_session and data[2] == framing.Kind.CLOSE and not link.established:
                self.hub.left(self.client, now=now)
            return
        try:
            self._greeted(bytes(data), now)
        except RemoteError:
            raise
        except Exception as error:  # noqa: BLE001  (of ours: this client has no session then, nobody else notices)
            self.hub.clients.failed(self.client, error, now=now)

    def _greeted(self, data: bytes, now: float) -> None:
        """What comes before a session."""
        header = framing.decode_header(data)
        if header.kind == framing.Kind.HELLO:
            hello = framing.decode_handshake(data)
            name = framing.take_str(hello, "name", max_length=64)
            if name != self.client:
                self._refuse(header.tag, "name", f"your key belongs to {self.client}, not to {name}", now)
                return
            if name in self.hub.local_owners:
                self._refuse(header.tag, "name", f"{name} is the relay's own name for its feed; take another", now)
                return
            try:
                self.hub.clients.greet(self, hello, header, now=now)
            except VersionError as error:
                self._refuse(header.tag, "version", str(error), now)
        elif header.kind == framing.Kind.DATA and now >= self._reset_due_s:
            self._reset_due_s = now + RESET_INTERVAL_S
            self._reset(header.tag, now)

    def _reset(self, tag: int, now: float) -> None:
        self.replies.append(framing.encode_handshake(framing.Kind.RESET, tag, microseconds(now), {}))

    def forget(self, tag: int, *, now: float) -> None:
        """The client's link is gone, whose latest session was `tag`. A client that thinks it has that session still
        would wait for good for what it has sent: a stream loses nothing, so it asks for nothing twice."""
        self.link = None
        if not self._greets:
            self._reset(tag, now)

    def displace(self, tag: int, where: str, *, now: float) -> None:
        """Another process has connected under the client's name: say so to the one whose session `tag` was here.
        `where` is "from" an address or "at" another relay."""
        text = f"another process connected as {self.client} {where}".rstrip()
        text += "; one name has one connection: end one of the two, "
        self._refuse(tag, DISPLACED, text + "or give it a name and a key of its own", now)

    def _refuse(self, tag: int, code: str, text: str, now: float) -> None:
        self.replies.clear()
        self.replies.append(
            framing.encode_handshake(framing.Kind.REFUSE, tag, microseconds(now), {"code": code, "why": text})
        )

    def next_datagram(self, *, now: float) -> bytes | None:
        if self.replies:
            return self.replies.pop(0)
        link = self.link
        if link is None or self.hub.clients.port_of.get(self.client) is not self:
            return None
        return link.next_datagram(now=now)

    @property
    def priority(self) -> PriorityClass:
        """The most urgent class in the latest datagram."""
        return PriorityClass.STATE if self.link is None else self.link.lanes.lane.priority

    def next_deadline(self) -> float | None:
        link, hub = self.link, self.hub
        if link is None or hub.clients.port_of.get(self.client) is not self:
            return None
        deadline_s, due_s = link.next_deadline(), hub.matching.due_s
        if not due_s:
            return deadline_s
        match_s = due_s.get(self.client)
        return deadline_s if match_s is None or (deadline_s is not None and deadline_s < match_s) else match_s

    def handle_timeout(self, *, now: float) -> None:
        if self.link is not None and self.current:
            self.link.handle_timeout(now=now)
            if now >= self.hub.matching.due_s.get(self.client, math.inf):
                self.hub.matching.go_on(self.client, now=now)
                self.hub.after()

    @property
    def dirty(self) -> bool:
        if self.replies:
            return True
        link, hub = self.link, self.hub
        if link is None or hub.clients.port_of.get(self.client) is not self:
            return False
        return link.dirty or self.client in hub.matching.due_s
