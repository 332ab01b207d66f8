"""Datagrams that nobody asked for, from beside the relay."""

import os
import socket
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from struct import Struct
from typing import Final

from benchmarks.link.sern import RELAY_PORT
from sern_runtime.seal import UDP_PAYLOAD_BYTES
from sern_tools.lab.host import inside

JUNK_HZ: Final = 20_000
_CLEAR: Final = Struct("!IQ")


def flood(namespace: str, session_id: int, seconds: float, told: Connection) -> None:
    """JUNK_HZ datagrams of full size a second to the relay in `namespace`, as evenly as a busy loop can. Tells when it
    begins, and its rate when it ends."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # the relay must not wait for its attacker
    sock = inside(namespace, lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    junk = [_CLEAR.pack(session_id, number) + os.urandom(UDP_PAYLOAD_BYTES - _CLEAR.size) for number in range(1, 257)]
    count = 0
    with sock:
        sock.connect(("127.0.0.1", RELAY_PORT))
        told.send(True)
        begun_s = time.monotonic()
        while (passed_s := time.monotonic() - begun_s) < seconds:
            if count < passed_s * JUNK_HZ:
                with suppress(OSError):
                    sock.send(junk[count & 0xFF])
                count += 1
        told.send(count / passed_s)
