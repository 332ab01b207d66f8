"""How many may be connected to the HTTP server at a time: each takes a file of the process, which others need."""

import asyncio
from collections.abc import Callable
from typing import Final, cast

MAX_CONNECTIONS: Final = 128
MAX_OF_ONE_SOURCE: Final = 32
"""Connections of one address, which could take the places of all others otherwise."""


class HttpConnections:
    """A factory of protocols for `loop.create_server`: what is one too many is closed at once, and counted."""

    def __init__(self, make: Callable[[], asyncio.BaseProtocol]) -> None:
        self.refused = 0
        self._make = make
        self._open: dict[asyncio.Transport, str] = {}

    def __call__(self) -> asyncio.BaseProtocol:
        return _Newcomer(self)

    def came(self, transport: asyncio.Transport) -> None:
        """Hand a new connection to a protocol of its own, if there is room for it."""
        self._open = {known: source for known, source in self._open.items() if not known.is_closing()}
        peer = transport.get_extra_info("peername")
        source = str(peer[0]) if isinstance(peer, tuple) else ""
        sources = list(self._open.values())
        if len(sources) >= MAX_CONNECTIONS or sources.count(source) >= MAX_OF_ONE_SOURCE:
            self.refused += 1
            transport.abort()
            return
        self._open[transport] = source
        protocol = self._make()
        transport.set_protocol(protocol)
        protocol.connection_made(transport)


class _Newcomer(asyncio.Protocol):
    """A connection that is not let in yet."""

    def __init__(self, table: HttpConnections) -> None:
        self._table = table

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._table.came(cast("asyncio.Transport", transport))  # which uvloop's are not by their class
