"""Datagrams that nobody asked for, as many as a busy loop can send evenly."""

import os
import socket
import time
from contextlib import suppress
from struct import Struct
from typing import Final

from sern_runtime.seal import UDP_PAYLOAD_BYTES

JUNK_HZ: Final = 20_000
_CLEAR: Final = Struct("!IQ")


def junk(session_id: int) -> list[bytes]:
    """256 datagrams of the full size, random but for the session's id and their numbers."""
    return [
        _CLEAR.pack(session_id, 2**32 + number) + os.urandom(UDP_PAYLOAD_BYTES - _CLEAR.size) for number in range(256)
    ]


def send(target: socket.socket, datagrams: list[bytes], seconds: float) -> float:
    """JUNK_HZ of the 256 `datagrams` a second to a connected socket; the rate that it came to."""
    count = 0
    begun_s = time.monotonic()
    while (passed_s := time.monotonic() - begun_s) < seconds:
        if count < passed_s * JUNK_HZ:
            with suppress(OSError):
                target.send(datagrams[count & 0xFF])
            count += 1
    return count / passed_s
