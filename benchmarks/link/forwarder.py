"""The bare forwarder: the least that carrying a datagram over two hops costs here, the floor of a relay's CPU.

One process receives a datagram, opens it with the keys of the first hop, seals it with those of the second and sends
it: no acknowledgements, no queue, no routing. Interpreter, event loop and AEAD are those of the relay's datagram lane.

    python -m benchmarks.link.forwarder DIRECTORY ADDRESS      # of the site; DIRECTORY holds the keys of both hops
"""

import asyncio
import json
import signal
import socket
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import uvloop

from benchmarks.link.load import POLL_S, Kind, Load, Log, Orders, Spec
from benchmarks.link.peers import NOTHING, PORT, drive, listen, send_datagram
from benchmarks.link.sern import RELAY_PORT
from sern_runtime.seal import UDP_PAYLOAD_BYTES, Opener, Sealer, SessionParameters, Side, offered_ciphers

FORWARDER: Final = "forwarder"
_KEYS: Final = "hops.json"


@dataclass(frozen=True)
class Hops:
    """The session of each hop, as the relay draws one for each client."""

    first: SessionParameters
    second: SessionParameters

    @classmethod
    def draw(cls) -> Self:
        """New parameters, with the cipher that the relay and a client of this machine choose."""
        cipher = offered_ciphers()[0]
        return cls(SessionParameters.draw(1, cipher, RELAY_PORT), SessionParameters.draw(2, cipher, PORT))

    def write(self, directory: Path) -> None:
        text = json.dumps([self.first.to_envelope(), self.second.to_envelope()])
        path = directory / _KEYS
        path.touch(mode=0o600)
        path.write_text(text)

    @classmethod
    def read(cls, directory: Path) -> Self:
        first, second = json.loads((directory / _KEYS).read_text())
        return cls(SessionParameters.from_envelope(first), SessionParameters.from_envelope(second))


class Forwarder:
    """Forwards from `inlet`, bound, to `outlet`, connected; both do not block. Call `step` when `inlet` has a
    datagram."""

    def __init__(self, hops: Hops, inlet: socket.socket, outlet: socket.socket) -> None:
        self._inlet = inlet
        self._outlet = outlet
        self._opener = Opener(hops.first, Side.CLIENT)
        self._sealer = Sealer(hops.second, Side.RELAY)
        self._buffer = bytearray(UDP_PAYLOAD_BYTES + 1)  # one more tells a datagram that is too long
        self._view = memoryview(self._buffer)
        self.forwarded = 0

    @property
    def refused(self) -> dict[str, int]:
        return dict(self._opener.refused)

    def step(self) -> None:
        """One datagram: at the rates of a link each comes by itself, and the loop calls again while there are more."""
        nbytes = self._inlet.recv_into(self._buffer)
        data = self._opener.open(self._view[:nbytes])
        if data is not None:
            send_datagram(self._outlet, self._sealer.seal(data))
            self.forwarded += 1


async def _forward(directory: Path, address: str) -> None:
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    loop.add_signal_handler(signal.SIGTERM, ended.set)
    with ExitStack() as stack:
        inlet, outlet = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK))
            for _ in range(2)
        )
        inlet.bind(("", RELAY_PORT))
        outlet.connect((address, PORT))
        forwarder = Forwarder(Hops.read(directory), inlet, outlet)
        loop.add_reader(inlet.fileno(), forwarder.step)
        await ended.wait()
        loop.remove_reader(inlet.fileno())
    summary = {"forwarded": forwarder.forwarded, "refused": forwarder.refused}
    (directory / "relay.summary.json").write_text(json.dumps(summary))


def sender(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    """The robot: one datagram a message."""
    sealer = Sealer(Hops.read(spec.path).first, Side.CLIENT)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect((spec.address, RELAY_PORT))

        def send(_kind: Kind, body: bytes) -> None:
            send_datagram(sock, sealer.seal(body))

        drive(spec, load, orders, log, send)
    return NOTHING


def receiver(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    """The site."""
    opener = Opener(Hops.read(spec.path).second, Side.RELAY)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("", PORT))
        sock.settimeout(POLL_S)

        def wait() -> None:
            try:
                data = opener.open(sock.recv(UDP_PAYLOAD_BYTES + 1))
            except TimeoutError:
                return
            if data is not None:
                log.arrived(data)

        listen(orders, log, wait)
    return NOTHING


if __name__ == "__main__":
    uvloop.run(_forward(Path(sys.argv[1]), sys.argv[2]))
