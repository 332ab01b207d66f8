"""Datagrams that nobody asked for, from beside the relay."""

import os
import socket
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Self

from benchmarks import flood
from benchmarks.child import Worker
from benchmarks.link.sern import RELAY_PORT
from sern_tools.lab.host import inside
from sern_tools.lab.lab import Node


class Junk:
    """A process that waits for `begin` and then sends; ended on exit."""

    def __init__(self, node: Node, seconds: float) -> None:
        self._ours, self._far = Pipe()
        self._worker = Worker("the source of junk", _flood, node.namespace, seconds, self._far)

    def __enter__(self) -> Self:
        try:
            self._worker.start()
            self._far.close()  # the worker's copy alone keeps it open
            self._worker.hear(self._ours)  # it is ready
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.end(patient=False)
        self._ours.close()

    def begin(self, session_id: int) -> None:
        with suppress(ConnectionError):  # it has ended; `rate_hz` says so
            self._ours.send(session_id)

    def rate_hz(self) -> float:
        """What it came to; waits for its end. SernError when it failed."""
        return float(self._worker.hear(self._ours))


def _flood(namespace: str, seconds: float, told: Connection) -> None:
    """Junk to the relay in `namespace`, when it is told the session."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # the relay must not wait for its attacker
    with inside(namespace, lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sock:
        sock.connect(("127.0.0.1", RELAY_PORT))
        told.send(True)
        session_id = told.recv()
        told.send(flood.send(sock, flood.junk(session_id), seconds))
