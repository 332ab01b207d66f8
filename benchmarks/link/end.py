"""The process at one end of the link: `python -m benchmarks.link.end SPEC` (JSON, `load.Spec`).

It says `ready` on standard output when messages pass, and leaves ROLE.npy (its log) and ROLE.json (what else it saw).
"""

from typing import Final

from benchmarks.link import forwarder, peers, sern
from benchmarks.link.load import End, play

ENDS: Final[dict[str, tuple[End, End]]] = {
    "floor": (peers.udp_sender, peers.udp_receiver),
    forwarder.FORWARDER: (forwarder.sender, forwarder.receiver),
    "zmq": (peers.zmq_sender, peers.zmq_receiver),
    "zenoh": (peers.zenoh_sender, peers.zenoh_receiver),
    "zenoh-multilink": (peers.zenoh_sender, peers.zenoh_receiver),
    "zenoh-multilink-bbr": (peers.zenoh_sender, peers.zenoh_receiver),
    "tcpros": (peers.ros_sender, peers.ros_receiver),
    "sern-udp": (sern.sender, sern.receiver),
    "sern-zmq": (sern.sender, sern.receiver),
    "sern-one": (sern.sender, sern.receiver),
}
"""Sender and receiver of each system."""


if __name__ == "__main__":
    play(ENDS)
