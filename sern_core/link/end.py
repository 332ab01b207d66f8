"""What all parts of one end of a hop share: who it is, what the session agreed on, and the call under way. Pure."""

from sern_core.vocabulary.fates import Fates
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing


def microseconds(now: float) -> int:
    """The time stamp of a datagram."""
    return int(now * 1e6)


class End:
    """One end of a hop. `boot` is this process's random 63-bit number."""

    __slots__ = (
        "boot",
        "data_prefix",
        "dirty",
        "established",
        "fates",
        "half_read",
        "initiator",
        "name",
        "now",
        "params",
        "peer",
        "peer_boot",
        "resumed",
        "tag",
        "towards_relay",
        "trace",
        "up_since_s",
        "version",
    )

    def __init__(
        self,
        *,
        name: ClientName,
        boot: int,
        peer: ClientName,
        initiator: bool,
        towards_relay: bool,
        params: LinkParams,
        trace: DecisionTrace,
        now: float,
    ) -> None:
        self.name = name
        self.boot = boot
        self.peer = peer
        self.peer_boot: int | None = None
        """The peer's process, now or when there was a session last; None: the next counts as new."""
        self.initiator = initiator
        """It says HELLO: a client's end, and of two relays one."""
        self.towards_relay = towards_relay
        """The peer is a relay: it speaks for those behind it, and has yet to learn of them when it is started anew."""
        self.params = params
        self.trace = trace
        self.fates: Fates | None = None
        """Told what becomes of each message here; set before the first channel is opened."""
        self.established = False
        """There is a session."""
        self.half_read = False
        """A datagram of the session is read in part; nothing may be acknowledged until all of it is."""
        self.resumed = False
        """The session is with the same process as the one before."""
        self.version = framing.VERSION_MAX
        self.tag = boot % 255
        """The session's number. The first follows from the boot: what an earlier process was sent is none of ours."""
        self.data_prefix = b""
        """How a data datagram of the session begins; empty: there is no session."""
        self.up_since_s = now
        self.now = now
        """The time of the call under way."""
        self.dirty = False
        """Something may be sendable: the owner should poll `next_datagram`. Set by every call that changes anything."""

    def header(self, number: int, now: float) -> bytes:
        """The header of a datagram of the session; number 0: it carries nothing that is to be acknowledged."""
        return framing.encode_header(framing.Kind.DATA, self.tag, number, microseconds(now), version=self.version)
