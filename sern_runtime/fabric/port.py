"""What relays have of each other: datagrams between two of them, and who is there.

The interface between the core's peer relays and whatever carries their datagrams. It names no library: one
implementation is `zenoh_port`, and another may carry the same in virtual time. All of it is called on the thread of the
event loop, and nothing in it waits.

A port promises two things: what `arrived` names as the source is who sent it (by the source's certificate, where there
are any, and not by what the datagram says); and every `peer_up` is followed by one `peer_down` of the same boot, at the
latest in `close`. It does not promise that a datagram arrives, or arrives in order: that is the business of the two
`Link`s.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple, Protocol

from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_core.wire.framing import Versions


class PeerRelay(NamedTuple):
    """Another relay, as it says itself."""

    name: ClientName
    boot: int
    """The number of its process: after a restart it is another one."""
    wire_versions: Versions
    """The least and the greatest that it speaks."""
    rules: str
    """The hash of its access rules, in hexadecimal digits; empty: it does not say."""


class FabricEvents(Protocol):
    """What a port tells its owner, in turns of the loop of their own: never inside a call of the port, but `close`."""

    def peer_up(self, peer: PeerRelay) -> None:
        """A relay is there. After a restart the new process may be told before the old one is gone (`peer_down`)."""

    def peer_down(self, name: ClientName, boot: int) -> None:
        """That process is gone, or out of reach."""

    def arrived(self, source: ClientName, datagram: bytes) -> None:
        """A datagram of the relay of that name, whatever it says inside. It may come before `peer_up`."""


class FabricPort(Protocol):
    """One relay's door to the others. `start` once, `close` once; in between the rest, as often as one likes."""

    @property
    def counters(self) -> "FabricCounters":
        """What went through so far."""

    async def start(self) -> None:
        """Raises ConfigError of one line for what is wrong with the configuration or the machine. Peers that are not
        there yet are no error: they are tried again for ever."""

    def send(self, destination: ClientName, priority: PriorityClass, datagram: bytes) -> bool:
        """Hand a datagram over. Never waits for room. False: dropped, and counted. True is no delivery receipt: it may
        still be dropped where a queue is full, and nobody is told."""

    async def close(self) -> None:
        """Leave: the others see it at once. Idempotent, and allowed after a `start` that failed."""


class FabricDrop(StrEnum):
    """Why the port itself did not carry something. Closed: metrics have a row for each."""

    CLOSED = "closed"  # it was to be sent before `start` or after `close`
    NO_PEER = "no_peer"  # no relay of that name is there
    TOO_LARGE = "too_large"  # more than `max_datagram_bytes`
    REFUSED = "refused"  # the carrier raised
    INBOX_FULL = "inbox_full"  # it arrived faster than the loop takes it
    NEWS_FULL = "news_full"  # more relays than are remembered
    BAD_KEY = "bad_key"  # a key or token that no relay of ours writes
    OWN_NAME = "own_name"  # of a relay that has our name
    UNSEALED = "unsealed"  # through external routers: not sealed, or by keys that are not those of its source
    BAD_SEAL = "bad_seal"  # altered on its way, or here a second time, or much too late
    BAD_CARD = "bad_card"  # what is to show who a relay is does not, or came too often


@dataclass(slots=True)
class FabricCounters:
    """What went through a port since its start; read at any time, written by the port alone."""

    sent: int = 0
    sent_bytes: int = 0
    received: int = 0
    received_bytes: int = 0
    dropped: Counter[FabricDrop] = field(default_factory=Counter)
    send_block_max_s: float = 0.0
    """The longest that one `send` has held the loop."""
    send_block_s: float = 0.0
    """All of them together."""
    peers_up: int = 0
    """Relays that are there now."""

    def snapshot(self) -> Mapping[str, float]:
        """All counters as numbers; drops as `dropped_REASON`, each reason once."""
        return {
            "sent": self.sent,
            "sent_bytes": self.sent_bytes,
            "received": self.received,
            "received_bytes": self.received_bytes,
            "send_block_max_s": self.send_block_max_s,
            "send_block_s": self.send_block_s,
            "peers_up": self.peers_up,
            **{f"dropped_{reason.value}": self.dropped[reason] for reason in FabricDrop},
        }
