"""systemd's end of the socket on which a daemon says how it is."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.daemons import Lab, Process


class Notified:
    """`told`: the messages so far, as far as they were looked at."""

    def __init__(self, receiver: socket.socket, path: Path) -> None:
        self.told: list[str] = []
        self._receiver = receiver
        self._path = path

    def process(self, lab: Lab, config: Path) -> Process:
        """Start a daemon that is told of the socket."""
        os.environ["NOTIFY_SOCKET"] = str(self._path)
        try:
            return lab.process(config)
        finally:
            del os.environ["NOTIFY_SOCKET"]

    def says(self, word: str) -> bool:
        """Whether a message so far has this in it."""
        try:
            while True:
                self.told.append(self._receiver.recv(4096).decode())
        except BlockingIOError:
            return any(word in text for text in self.told)


@contextmanager
def notified() -> Iterator[Notified]:
    with (
        TemporaryDirectory(prefix="sern-", dir="/tmp") as short,  # a socket's path has at most 107 bytes
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver,
    ):
        path = Path(short) / "notify"
        receiver.bind(str(path))
        receiver.setblocking(False)
        yield Notified(receiver, path)
