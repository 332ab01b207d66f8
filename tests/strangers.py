"""Programs that speak to a relay without being a client of SERN, and what they may say."""

from collections.abc import Callable
from typing import Final

import zmq

from sern_core.wire import framing
from sern_runtime.config.keys import SecretKey, load_public
from sern_runtime.monitor import SocketMonitor
from sern_runtime.zmq_setup import make_client
from sern_runtime.zmq_socket import DealerSocket
from tests.daemons import Lab
from tests.support import until


class Stranger:
    """A program that speaks to the relay without being a SERN client, with any keys or none."""

    def __init__(self, lab: Lab, keys: SecretKey | None, *, identity: bytes = b"") -> None:
        self.received: list[bytes] = []
        self.events: list[zmq.Event] = []
        self._context = zmq.Context[zmq.Socket[bytes]]()
        self._monitor: SocketMonitor | None = None

        def prepare(socket: "zmq.Socket[bytes]") -> None:
            socket.setsockopt(zmq.RECONNECT_IVL, -1)  # what is closed stays closed
            if identity:
                socket.setsockopt(zmq.ROUTING_ID, identity)
            self._monitor = SocketMonitor(socket, lambda event: self.events.append(event.kind))

        server = None if keys is None else load_public(lab.directory / "relay.pub").keys[0].key
        raw = make_client(
            self._context, lab.endpoint, keys, server, max_message_bytes=-1, before_connect=prepare
        )  # fmt: skip
        self.socket = DealerSocket(raw, self.received.append)

    async def send(self, *frames: bytes) -> None:
        await until(lambda: self.socket.send_frames(frames), "the stranger can send")

    async def cut(self) -> None:
        await until(lambda: zmq.Event.DISCONNECTED in self.events, "the relay closes the stranger's connection")

    def close(self) -> None:
        if self._monitor is not None:
            self._monitor.close()
        self.socket.close()
        self._context.destroy(linger=0)

    async def __aenter__(self) -> "Stranger":
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


def hello(name: str, tag: int = 1) -> bytes:
    envelope: framing.Envelope = {"name": name, "boot": 7, "vmin": framing.VERSION_MIN, "vmax": framing.VERSION_MAX}
    return framing.encode_handshake(framing.Kind.HELLO, tag, 0, envelope)


def oversize() -> list[bytes]:
    return [bytes(80 * 1024)]


def bomb() -> list[bytes]:
    header = framing.encode_header(framing.Kind.HELLO, 1, 0, 0)
    return [header + b"\xdf\xff\xff\xff\xff" + b"\xa1a\x80" * 1000]


BAD: Final[dict[str, Callable[[], list[bytes]]]] = {
    "no frame at all": lambda: [b""],
    "noise": lambda: [bytes(range(200))],
    "a later version": lambda: [framing.encode_header(framing.Kind.HELLO, 1, 0, 0, version=99) + b"\x80"],
    "a WELCOME": lambda: [hello("robot2"), framing.encode_handshake(framing.Kind.WELCOME, 1, 0, {})],
    "an acknowledgement of nothing": lambda: [
        hello("robot2"),
        framing.encode_header(framing.Kind.DATA, 1, 1, 0) + framing.encode_ack(0, 4_000_000, 0, 0, 0, 0),
    ],
    "half a frame": lambda: [hello("robot2"), framing.encode_header(framing.Kind.DATA, 1, 1, 0) + b"\x01\0\0"],
    "a control message of nobody": lambda: [hello("robot2"), control({"t": "nonsense"})],
    "a subscription that is no list": lambda: [hello("robot2"), control({"t": "subscribe", "patterns": 7})],
    "a map of four billion": bomb,
}


def control(envelope: framing.Envelope) -> bytes:
    body = framing.encode_control(envelope)
    head = framing.encode_data_first(0, 0, 1, len(body), len(body), 0, 0.0, 0)
    return framing.encode_header(framing.Kind.DATA, 1, 1, 0) + head + body
