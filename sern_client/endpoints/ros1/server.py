"""The TCPROS port of the node: local subscribers and local callers of services connect here."""

import asyncio
import logging
from contextlib import suppress
from itertools import count
from typing import Final, Protocol

from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.ros1.frames import Frames
from sern_client.endpoints.ros1.header import encode_header, shown
from sern_client.endpoints.ros1.listener import Listener
from sern_client.endpoints.ros1.publication import Feed, Publication
from sern_client.endpoints.ros1.returning import Returning
from sern_core.vocabulary.errors import WireError

MAX_CONNECTIONS: Final = 2048
FLUSH_S: Final = 0.5
"""How long `stop` waits for what was written before."""
REQUEST_S: Final = 60.0
"""How long a begun request to a service may take to arrive."""
MAX_REFUSALS: Final = 256
"""Refusals that are remembered, so that each is logged once."""

_log = logging.getLogger(__name__)


class Caller(Protocol):
    """The other half of a connection that calls a service: its requests, and its end."""

    def request(self, body: bytes) -> None: ...

    def ended(self) -> None: ...


class Services(Protocol):
    """What the port asks about services."""

    def accept(self, link: "Inbound", fields: dict[str, str]) -> Caller | str:
        """Who takes the requests of a connection with this header, after its answer was sent; or why nobody does."""
        ...


class Inbound(Frames):
    """One connection from another node; what it is for is in its header."""

    def __init__(self, server: "TcprosServer") -> None:
        super().__init__(server.max_frame_bytes)
        self.frame_s = REQUEST_S
        self.server = server
        self._feed: Feed | None = None
        self._caller: Caller | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if len(self.server.connections) >= MAX_CONNECTIONS:
            self.server.complain(f"more than {MAX_CONNECTIONS} connections; {self.peer} is refused")
            self.close()
            return
        self.server.connections.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._end()

    def close(self) -> None:
        super().close()
        self._end()

    def _end(self) -> None:
        self.server.connections.discard(self)
        if self._feed is not None:
            self._feed.ended()
            self._feed = None
        if self._caller is not None:
            self._caller.ended()
            self._caller = None

    def header(self, fields: dict[str, str]) -> None:
        if "service" in fields:
            accepted = self.server.services.accept(self, fields)
            if isinstance(accepted, str):
                self.refuse(accepted)
            else:
                self._caller = accepted
            return
        topic = fields.get("topic", "")
        publication = self.server.publications.get(topic)
        if publication is None:
            self.refuse(f"{self.server.name} does not publish [{topic[:200]}]", loud=False)
            return
        if (problem := publication.refusal(fields)) is not None:
            self.refuse(problem)
            return
        caller = shown(fields, "callerid", self.peer)
        if self.server.returning.too_early(topic, caller):
            self.close()
            return
        self.server.returning.served(topic, caller)
        self.max_frame_bytes = 0
        self.answer(publication.answer)
        self._feed = Feed(self, publication, caller, next(self.server.numbers))
        publication.join(self._feed)

    def answer(self, fields: dict[str, str]) -> None:
        """Our half of the handshake."""
        if self.transport is not None:
            self.transport.write(encode_header(fields))

    def refuse(self, problem: str, *, loud: bool = True) -> None:
        """Tell the other side why, in the header's `error`, and end the connection."""
        if loud:
            self.server.complain(problem)
        self.answer({"error": problem})
        if self.transport is not None:
            self.transport.close()

    def message(self, body: bytes) -> None:
        if self._caller is not None:
            self._caller.request(body)
        elif self._feed is not None:
            self.too_large(len(body))

    def too_large(self, size_bytes: int) -> None:
        if self._feed is not None:
            name = self._feed.caller
            self.server.complain(f"{name}: a message of {size_bytes} bytes; a subscriber has nothing to say")
            self.close()
            return
        self.server.complain(f"{self.peer} sends {size_bytes} bytes, the limit is {self.max_frame_bytes}")
        self.close()

    def failed(self, error: WireError) -> None:
        self.server.complain(f"{self.peer}: {error}")

    def pause_writing(self) -> None:
        if self._feed is not None:
            self._feed.pause()

    def resume_writing(self) -> None:
        if self._feed is not None:
            self._feed.resume()


class TcprosServer(Listener):
    """Listens from `start` to `stop`. `publications` are the endpoint's, by name at the master."""

    def __init__(
        self, name: str, publications: dict[str, Publication], services: Services, *, max_frame_bytes: int
    ) -> None:
        super().__init__(lambda: Inbound(self))
        self.name = name
        self.publications = publications
        self.services = services
        self.max_frame_bytes = max_frame_bytes
        self.connections: set[Inbound] = set()
        self.returning = Returning()
        self.numbers = count(1)
        self.complain = SayOnce(_log, logging.ERROR, most=MAX_REFUSALS)
        """Say what a peer does wrong."""

    async def end_connections(self) -> None:
        for connection in list(self.connections):
            if connection.transport is not None:
                connection.transport.close()
        with suppress(TimeoutError):
            async with asyncio.timeout(FLUSH_S):
                while self.connections:  # noqa: ASYNC110  they leave the set one by one
                    await asyncio.sleep(0.005)
        for connection in list(self.connections):
            connection.close()
