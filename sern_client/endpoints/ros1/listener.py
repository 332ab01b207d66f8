"""What the two ports of a node have in common: one listening socket, from `start` to `stop`."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable


class Listener(ABC):
    """`protocol` makes the protocol of each connection that is accepted."""

    def __init__(self, protocol: Callable[[], asyncio.BaseProtocol]) -> None:
        self._protocol = protocol
        self._server: asyncio.Server | None = None

    async def start(self, address: str) -> int:
        """Listen on a free port of this address; the port. OSError when that is impossible."""
        self._server = await asyncio.get_running_loop().create_server(self._protocol, address, 0)
        return int(self._server.sockets[0].getsockname()[1])

    async def stop(self) -> None:
        """Listen no more, and end what was accepted. Nothing happens when it does not listen."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
            await self.end_connections()
            await server.wait_closed()

    @abstractmethod
    async def end_connections(self) -> None:
        """End every connection that was accepted, and wait for its end."""
