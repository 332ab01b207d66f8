"""Whether datagrams get through a lab, asked before it is handed out: what is wired is not yet what carries."""

import select
import socket
import struct
import time
from collections.abc import Sequence
from typing import Final, NamedTuple

from sern_tools.lab.host import LabError

PASSING_S: Final = 20.0
"""How long a new lab may take to carry its first datagrams; milliseconds on a machine that is not busy."""
AGAIN_S: Final = 0.1
"""A datagram that did not arrive is followed by another after so long."""
_NUMBER: Final = struct.Struct("!II")


class Way(NamedTuple):
    """Passes datagrams from one bound socket to another; `name` is for people: `a to b`."""

    name: str
    source: socket.socket
    target: socket.socket


def await_passing(ways: Sequence[Way], *, within_s: float = PASSING_S) -> None:
    """Send over each way until the newest datagram has arrived, so that none is left under way.

    Raises LabError in one line with the ways that carry nothing, after `within_s`, or with what a socket refused.
    """
    open_ways = dict(enumerate(ways))
    newest = dict.fromkeys(open_ways, 0)
    give_up_s = time.monotonic() + within_s
    while open_ways:
        for number, way in open_ways.items():
            newest[number] += 1
            try:
                way.source.sendto(_NUMBER.pack(number, newest[number]), way.target.getsockname())
            except OSError as error:
                raise LabError(f"the lab is not ready: {way.name}: {error.strerror or error}") from error
        again_s = time.monotonic() + AGAIN_S
        while open_ways:  # and once at least, however late: what has come by now has come
            targets = {way.target for way in open_ways.values()}
            ready = select.select(targets, [], [], max(0.0, again_s - time.monotonic()))[0]
            if not ready:
                break
            for target in ready:
                data = target.recv(64)
                number, count = _NUMBER.unpack(data) if len(data) == _NUMBER.size else (-1, 0)
                if newest.get(number) == count:
                    open_ways.pop(number, None)
        if open_ways and time.monotonic() > give_up_s:
            names = ", ".join(way.name for way in open_ways.values())
            raise LabError(
                f"the lab is not ready: no datagram got through within {within_s:g} s ({names}); is the machine "
                "overloaded? Wait until it is not and start the lab again"
            )
