"""DSCP: the mark on each IP packet by which switches, access points and routers know what is urgent (RFC 2474).

The datagram lane marks each datagram by the most urgent class in it; connections have one mark each. The defaults put
the three classes into three queues of a Wi-Fi access point, which goes by the upper three bits: EF into voice or video,
CS0 into best effort, CS1 into background. With AF41 class state would share the video queue with commands there, and on
the internet it is a mark that providers remove or police; CS0 passes everywhere.

Marks change with the class, by `setsockopt` before the datagram. Measured (two-core virtual machine, Python 3.11, 1200
bytes over loopback, CPU time of sender and kernel): a send takes 3.4 µs (IPv6: 3.9); with IP_TOS as ancillary data of
`sendmsg` 3.8 (4.4); after a `setsockopt` each time 3.9 (4.6). The mark seldom changes with every datagram, and where it
stays, `setsockopt` costs nothing.
"""

from dataclasses import dataclass
from typing import Final

from sern_core.vocabulary.types import PriorityClass

DSCP_NAMES: Final = {
    "cs0": 0,
    "le": 1,
    **{f"cs{number}": 8 * number for number in range(1, 8)},
    **{f"af{queue}{drop}": 8 * queue + 2 * drop for queue in range(1, 5) for drop in range(1, 4)},
    "va": 44,
    "ef": 46,
}
"""IANA's names of code points: RFC 2474, 2597, 3246, 5865, 8622."""


@dataclass(frozen=True, slots=True)
class Marks:
    """The DSCP of each class, 0 to 63."""

    control: int = DSCP_NAMES["ef"]
    state: int = DSCP_NAMES["cs0"]
    bulk: int = DSCP_NAMES["cs1"]

    @property
    def tos(self) -> tuple[int, int, int]:
        """The IP byte (IP_TOS, IPV6_TCLASS) by class; its lower two bits are ECN's, and 0."""
        return (self.control << 2, self.state << 2, self.bulk << 2)

    @property
    def priority_lane_tos(self) -> int:
        """The IP byte of a connection that carries class control alone."""
        return self.tos[PriorityClass.CONTROL]

    @property
    def stream_tos(self) -> int:
        """The IP byte of a connection that carries all classes, and of datagrams without a message."""
        return self.tos[PriorityClass.STATE]
