"""Whether the relay's name resolves, and to what. libzmq asks again and again by itself, and tells neither."""

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


class UnresolvedError(Exception):
    """A name has no IPv4 address now; why, as the resolver says it."""


async def resolve(host: str, port: int) -> str:
    """The addresses that `host` has now, with commas; sorted, as name servers change the order at each answer. IPv4,
    because libzmq asks for no other. Raises UnresolvedError."""
    loop = asyncio.get_running_loop()
    try:
        found = await loop.getaddrinfo(host, port, family=socket.AF_INET, type=socket.SOCK_STREAM)
    except socket.gaierror as error:
        raise UnresolvedError((error.strerror or str(error)).lower()) from error
    except (OSError, UnicodeError) as error:
        raise UnresolvedError(str(error)) from error
    return ", ".join(sorted({str(address[0]) for *_, address in found}))


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
        self.at = ""
        """Where it leads, for the same; empty: it is not known."""
        self._endpoint = endpoint
        self._host = host
        self._port = port
        self._task: asyncio.Task[None] | None = None
        self._ask_s = 0.0
        self._since_s = 0.0
        self._say_s = 0.0
        self._pause_s = SAY_AGAIN_S[0]
        self._address = ""  # the last one that was known

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
        try:
            address = await resolve(self._host, self._port)
        except UnresolvedError as error:
            self._unresolved(str(error))
        else:
            self._resolved(address)

    def _unresolved(self, why: str) -> None:
        now = clock.now()
        first = self.problem is None
        self.at = ""
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

    def _resolved(self, address: str = "") -> None:
        """Say that it does again, and where it leads if that is another place than before. Empty: whoever made the
        connection knows the address."""
        before, self._address = self._address, address or self._address
        if address:
            self.at = f"{self._host} is {address}"
        if self.problem is not None:
            self.problem = None
            to = f", to {address}" if address else ""
            down_s = clock.now() - self._since_s
            _log.warning("%s: %s resolves again%s, after %.0f s", self._endpoint, self._host, to, down_s)
        elif address and not before:
            _log.info("%s: %s", self._endpoint, self.at)
        elif address and address != before:
            _log.warning("%s: %s is %s now, and was %s", self._endpoint, self._host, address, before)

    def close(self) -> None:
        """Idempotent."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
