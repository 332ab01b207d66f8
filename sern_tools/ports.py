"""Numbers that one of several processes may use for itself: ports on loopback, until their owners listen.

A port that is free now may be taken by the time that its owner listens. Who looks for one here claims it first, by an
abstract socket of its name, which every process of this network namespace sees and which ends with its process.
"""

import atexit
import random
import socket
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from sern_core.vocabulary.errors import SernError

HOST: Final = "127.0.0.1"
OUTGOING: Final = Path("/proc/sys/net/ipv4/ip_local_port_range")
"""First and last port that the kernel gives to outgoing connections, which could take one before its owner listens."""
USUAL: Final = range(15_000, 32_000)
"""Ports below those, unless it was told otherwise."""
DDS_PORTS: Final = 100
"""The first so many of every 250 ports from 7400 on are those of a DDS domain (DDSI-RTPS, 9.6.1.1) with up to 44
participants on this host. They are taken whenever a node starts."""


def own_ports(outgoing: Path = OUTGOING) -> list[int]:
    """The ports of USUAL that neither DDS nor outgoing connections take. Also those of outgoing connections where that
    leaves none, or cannot be read."""
    ports = [port for port in USUAL if (port - 7400) % 250 >= DDS_PORTS]
    try:
        first, last = map(int, outgoing.read_text().split())
    except (OSError, ValueError):
        return ports
    return [port for port in ports if not first <= port <= last] or ports


PORTS: Final[Sequence[int]] = own_ports()
CLAIMS: Final = 128
"""How many of the last claims of a process hold; by then the owners of those before listen, or have ended."""

_claims: Final[dict[int, deque[socket.socket]]] = {}


def claim(name: str, last: int = CLAIMS) -> bool:
    """Whether `name` is this process's now: no other process, and no earlier call here, holds a claim to it. Of names
    that are claimed with the same `last`, so many of the last claims hold."""
    held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        held.bind(f"\0sern-claim-{name}")
    except OSError:
        held.close()
        return False
    claims = _claims.setdefault(last, deque())
    claims.append(held)
    if len(claims) > last:
        claims.popleft().close()
    return True


def release_claims() -> None:
    """Let others have everything that this process claimed."""
    for claims in _claims.values():
        while claims:
            claims.popleft().close()


atexit.register(release_claims)


def free_ports(count: int) -> list[int]:
    """Ports on loopback that nobody has, over TCP or UDP, and that no other process of this kind is given meanwhile.

    Raises SernError when there are none.
    """
    with ExitStack() as held:
        found: list[int] = []
        for port in random.SystemRandom().sample(PORTS, len(PORTS)):
            if not claim(f"port-{port}"):  # before it is tried: its owner could not listen meanwhile
                continue
            try:
                for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                    held.enter_context(socket.socket(type=kind)).bind((HOST, port))
            except OSError:
                continue
            found.append(port)
            if len(found) == count:
                return found
    raise SernError(f"no {count} free ports on {HOST} between {min(PORTS)} and {max(PORTS)}")
