"""Whether the relay's name resolves. libzmq asks again and again by itself, and never says that there is no answer."""

import asyncio
import ipaddress
import logging
import socket
from typing import Final

from sern_runtime import clock
from sern_runtime.config.base import split_tcp

ASK_AGAIN_S: Final = 5.0
SAY_AGAIN_S: Final = (10.0, 600.0)
"""First and longest pause before it is said again that the name still does not resolve."""

_log = logging.getLogger(__name__)


async def unresolved(host: str, port: int) -> str | None:
    """Why `host` has no IPv4 address now, as the resolver says it; None when it has one. libzmq asks for IPv4 only."""
    try:
        await asyncio.get_running_loop().getaddrinfo(host, port, family=socket.AF_INET, type=socket.SOCK_STREAM)
    except socket.gaierror as error:
        return (error.strerror or str(error)).lower()
    except (OSError, UnicodeError) as error:
        return str(error)
    return None


def name_in(endpoint: str) -> tuple[str, int] | None:
    """Host name and port of `tcp://host:port`; None for an address, and for ipc."""
    parts = split_tcp(endpoint)
    if parts is None:
        return None
    try:
        ipaddress.ip_address(parts[0])
    except ValueError:
        return parts
    return None


class RelayName:
    """Looks the name up while there is no connection. `tick` about twice a second, `close` at the end."""

    def __init__(self, endpoint: str, host: str, port: int) -> None:
        self.problem: str | None = None
        """What is wrong, for `/readyz` and the status; None: it resolved, or is not known yet."""
        self._endpoint = endpoint
        self._host = host
        self._port = port
        self._task: asyncio.Task[None] | None = None
        self._ask_s = 0.0
        self._since_s = 0.0
        self._say_s = 0.0
        self._pause_s = SAY_AGAIN_S[0]

    def tick(self, *, connected: bool) -> None:
        """`connected`: the relay answers, so its address is known."""
        if self._task is not None and self._task.done():
            self._task.result()
            self._task = None
        if connected:
            self._resolved()
        elif self._task is None and clock.now() >= self._ask_s:
            self._ask_s = clock.now() + ASK_AGAIN_S
            self._task = asyncio.get_running_loop().create_task(self._look(), name="relay-name")

    async def _look(self) -> None:
        why = await unresolved(self._host, self._port)
        if why is None:
            self._resolved()
            return
        now = clock.now()
        first = self.problem is None
        self.problem = f"the relay's name {self._host} does not resolve: {why}"
        if first:
            self._since_s = now
            self._pause_s = SAY_AGAIN_S[0]
            _log.warning("%s: %s; trying again until it does", self._endpoint, self.problem)
        elif now >= self._say_s:
            _log.warning("%s: %s, for %.0f s now", self._endpoint, self.problem, now - self._since_s)
            self._pause_s = min(2 * self._pause_s, SAY_AGAIN_S[1])
        else:
            return
        self._say_s = now + self._pause_s

    def _resolved(self) -> None:
        if self.problem is not None:
            self.problem = None
            _log.warning("%s: %s resolves again, after %.0f s", self._endpoint, self._host, clock.now() - self._since_s)

    def close(self) -> None:
        """Idempotent."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
