"""One end of a hop over a fabric port: a bare `Link` and the port beneath it, no relay.

The robot's end announces a stream of each class and offers messages; the site's end takes them all.
"""

import asyncio
import time
from pathlib import Path
from typing import Any, Final

from benchmarks.link.load import Kind, Load, Log, Orders, Spec, offer, ready, take_all
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, PriorityClass, TopicName
from sern_runtime import clock
from sern_runtime.config.fabric import CA_FILE, CertificateFiles, certificate_file, key_file
from sern_runtime.fabric.hop import ANY_SIZE, LOSSLESS, FabricHop
from sern_runtime.fabric.port import PeerRelay
from sern_runtime.fabric.zenoh_port import ZenohPort
from sern_runtime.fabric.zenoh_settings import FabricOptions
from tests.two_links import BareEnd

PORT: Final = 7447
ROBOT: Final = ClientName("robot")
SITE: Final = ClientName("site")
VARIANTS: Final = {
    "fabric": (LOSSLESS, ANY_SIZE),
    "fabric, 1171 B": (False, False),
    "fabric, lossless": (True, True),
}
"""What the link takes its lane for, by system."""


def options(spec: Spec, name: ClientName, other: ClientName) -> FabricOptions:
    """The site listens, the robot connects, as it would from behind a NAT."""
    folder = spec.path
    return FabricOptions(
        name=name,
        boot=1,
        listen=() if spec.sends else (f"tls/{spec.own_address}:{PORT}",),
        peers=(f"tls/{spec.address}:{PORT}",) if spec.sends else (),
        relays=(other,),
        certificates=CertificateFiles(folder / CA_FILE, folder / certificate_file(name), folder / key_file(name)),
    )


class HopEnd:
    """Owns link, port and pump of one end; is told by the port (`FabricEvents`)."""

    def __init__(self, spec: Spec, log: Log) -> None:
        self.own, self.other = (ROBOT, SITE) if spec.sends else (SITE, ROBOT)
        lossless, any_size = VARIANTS[spec.system]
        end = self.end = BareEnd(
            self.own, self.other, initiator=spec.sends, now=clock.now(), lossless=lossless, any_size=any_size
        )
        end.take = log.arrived
        self.link = end.link
        self.port = ZenohPort(options(spec, self.own, self.other), self)
        self.hop = FabricHop(self.port, self.other, end.port)

    def open(self, priority: PriorityClass) -> OutChannel:
        """A best-effort stream of a class, as a relay would pass it on."""
        topic = TopicName(f"/robot/{priority.name.lower()}")
        stream = StreamInfo(
            StreamId(ROBOT, 1, topic), TopicInfo(topic, "std_msgs/UInt8MultiArray", Encoding.CDR), TopicSpec(priority)
        )
        return self.link.outgoing.open(stream, first=1, now=clock.now())

    def submit(self, channel: OutChannel, body: bytes) -> None:
        now = clock.now()
        message = Message(channel.stream.id, channel.next_seq, body, time.time_ns(), now)
        self.link.sender.submit(channel, message, now=now)
        self.hop.kick()

    def seen(self) -> dict[str, Any]:
        """What the report wants to know beside the messages."""
        return {
            "port": dict(self.port.counters.snapshot()),
            "datagrams": self.hop.datagrams,
            "rtt_s": self.link.rtt_s,
            "rate_bps": self.link.lane.estimator.rate_bps,
            "acked": self.link.lane.acked_packets,
            "lost": self.link.lane.lost_packets,
            "fragment_bytes": self.link.lane.fragment_bytes,
            "faults": [*map(repr, self.end.faults), *self.end.downs],
        }

    # --- FabricEvents -------------------------------------------------------------------------------------------------

    def peer_up(self, peer: PeerRelay) -> None:
        del peer
        self.link.connected(now=clock.now())
        self.hop.kick()

    def peer_down(self, name: ClientName, boot: int) -> None:
        del name, boot
        self.link.disconnected(now=clock.now())

    def arrived(self, source: ClientName, datagram: bytes) -> None:
        del source
        self.hop.arrived(datagram)


def sender(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    return asyncio.run(_send(spec, load, orders, log))


async def _send(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    end = HopEnd(spec, log)
    await end.port.start()
    channels = {Kind(priority): end.open(priority) for priority in PriorityClass}
    ready()
    for pause_s in offer(load, spec.duration_s, orders, log, lambda kind, body: end.submit(channels[kind], body)):
        await asyncio.sleep(pause_s)
    return await _stop(end)


def receiver(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    del load
    return asyncio.run(_receive(spec, orders, log))


async def _receive(spec: Spec, orders: Orders, log: Log) -> dict[str, Any]:
    end = HopEnd(spec, log)
    await end.port.start()
    await take_all(orders, log)
    return await _stop(end)


async def _stop(end: HopEnd) -> dict[str, Any]:
    seen = end.seen()
    end.hop.close()
    await end.port.close()
    return seen


def certificates(directory: Path) -> None:
    """Make those of both ends, in the folder of a run."""
    from sern_tools.keygen_fabric import make_fabric

    make_fabric([ROBOT, SITE], out=directory)
