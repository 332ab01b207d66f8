"""What brings datagrams to a relay's hub and takes its own away: the stream lane, datagram lanes, and the port to other
relays."""

import asyncio
from collections.abc import Mapping
from typing import TYPE_CHECKING

from sern_core.link.link import Link
from sern_core.vocabulary.types import ClientName
from sern_relay.server import RelayServer
from sern_relay.udp import RelayLanes
from sern_runtime.fabric.port import FabricCounters

if TYPE_CHECKING:
    from sern_relay.fabric import RelayFabric


class Transports:
    """All of them as one. The owner makes each, sets it here, and closes it; None: not there yet, or not wanted.
    Whoever takes something in calls `after`."""

    def __init__(self) -> None:
        self.server: RelayServer | None = None
        self.lanes: RelayLanes | None = None
        self.fabric: RelayFabric | None = None
        self._flush_due: asyncio.Handle | None = None

    def after(self) -> None:
        """Something came in: before the loop comes round again, whoever has something to send sends it."""
        if self._flush_due is None:
            self._flush_due = asyncio.get_running_loop().call_soon(self.flush)

    def flush(self) -> None:
        """Let each send what it has to send."""
        self._flush_due = None
        # All are kicked before any sends: the lanes of a link share one sign that there is something to send.
        if self.lanes is not None:  # first: where there is one it has the messages
            self.lanes.flush()
        if self.server is not None:
            self.server.flush()
        if self.fabric is not None:
            self.fabric.flush()

    def cancel(self) -> None:
        """Send no more of what is due."""
        if self._flush_due is not None:
            self._flush_due.cancel()

    def address(self, client: ClientName) -> str:
        """Where a client comes from now; empty: it has no connection."""
        by_tcp = self.server.address(client) if self.server is not None else ""
        return by_tcp or (self.lanes.address(client) if self.lanes is not None else "")

    def session_key(self, client: ClientName) -> str | None:
        """The key with which the client's session is held; None: that is not known."""
        return self.server.session_key(client) if self.server is not None else None

    def datagram_problem(self, link: Link, within_s: float) -> str | None:
        """What is known about why no datagram passes on a link, as `DatagramWatch` wants it."""
        return self.lanes.problem(link, within_s) if self.lanes is not None else None

    def reached(self) -> Mapping[ClientName, bool]:
        """Whether each other relay is reached."""
        return {} if self.fabric is None else self.fabric.reached()

    @property
    def fabric_counters(self) -> FabricCounters | None:
        """The counters of the port to other relays; None: it is not there yet."""
        return None if self.fabric is None else self.fabric.port.counters
