"""A fabric through routers that need not be believed: what goes between two relays is sealed by keys of these two.

Around the port that carries it. A relay is told of (`peer_up`) once it has shown that it has the key of its
certificate, and not when its token is seen, which a router can make.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_core.wire.framing import MAX_DATAGRAM_BYTES
from sern_runtime import clock
from sern_runtime.fabric.identity import Identity
from sern_runtime.fabric.meeting import SEALING_BYTES, Kind, Meeting, boot_of
from sern_runtime.fabric.port import FabricCounters, FabricDrop, FabricEvents, FabricPort, PeerRelay
from sern_runtime.fabric.zenoh_port import ZenohPort
from sern_runtime.fabric.zenoh_settings import RETRY_FIRST_S, RETRY_MAX_S, FabricOptions

ASK_AFTER_S: Final = 1.0
"""A relay that waits for an offer asks for one after so long: the first needs no asking."""
BOOTS: Final = 4
"""Processes of one name that are met at a time: after a restart there are two for a while."""
MEETINGS: Final = 1024
"""Processes of all names. `fabric.relays` names at most 256."""
_SEALED: Final = bytes((Kind.SEALED,))

_log = logging.getLogger(__name__)


def port_of(options: FabricOptions, events: FabricEvents) -> FabricPort:
    """Raises ConfigError where zenoh is not installed, or a certificate cannot be read."""
    if options.external and options.certificates is not None:
        return SealedPort(options, events, Identity.read(options.certificates))
    return ZenohPort(options, events)


@dataclass(slots=True, eq=False)
class _Met:
    meeting: Meeting
    pause_s: float = RETRY_FIRST_S
    timer: asyncio.TimerHandle | None = None
    expiry: asyncio.TimerHandle | None = None
    told: bool = False
    """`events` knows that it is there."""
    warned: bool = False

    @property
    def name(self) -> ClientName:
        return self.meeting.peer.name


class SealedPort:
    """A `FabricPort` around `ZenohPort`, which tells this one. `wall_s`: seconds since 1970."""

    def __init__(
        self,
        options: FabricOptions,
        events: FabricEvents,
        identity: Identity,
        *,
        wall_s: Callable[[], float] = time.time,
        most_meetings: int = MEETINGS,
    ) -> None:
        self._most_meetings = most_meetings
        self._events = events
        self._identity = identity
        self._own = options.itself
        self._wall_s = wall_s
        self._met: dict[ClientName, list[_Met]] = {}
        self._up: dict[ClientName, _Met] = {}
        """The process that came last, of those of a name that are there."""
        self._carrier = ZenohPort(options, self, most_bytes=MAX_DATAGRAM_BYTES + SEALING_BYTES)

    @property
    def counters(self) -> FabricCounters:
        """The carrier's, what is said to agree on keys among them; `peers_up` are relays that have done so."""
        return self._carrier.counters

    @property
    def meetings(self) -> int:
        """The number of processes of other relays that it has keys with, or tries to agree on some."""
        return sum(map(len, self._met.values()))

    async def start(self) -> None:
        await self._carrier.start()

    async def close(self) -> None:
        await self._carrier.close()

    def send(self, destination: ClientName, priority: PriorityClass, datagram: bytes) -> bool:
        met = self._up.get(destination)
        if met is None:
            return self._drop(FabricDrop.NO_PEER)
        if len(datagram) > MAX_DATAGRAM_BYTES:
            return self._drop(FabricDrop.TOO_LARGE)
        sealed = met.meeting.seal(datagram)
        if sealed is None:
            self._keep_on(met)
            return self._drop(FabricDrop.UNSEALED)
        return self._carrier.send(destination, priority, sealed)

    def _drop(self, reason: FabricDrop) -> bool:
        self.counters.dropped[reason] += 1
        return False

    # --- FabricEvents, of the carrier -------------------------------------------------------------------------------

    def peer_up(self, peer: PeerRelay) -> None:
        """Its token is there; the rest is to be seen."""
        self._count()
        known = self._met.get(peer.name, [])
        if len(known) >= BOOTS:
            pending = next((met for met in known if not met.told), None)
            if pending is not None:
                self._forget(pending)
        if len(known) >= BOOTS or self.meetings >= self._most_meetings:
            self._drop(FabricDrop.NEWS_FULL)
            return
        met = _Met(Meeting(self._identity, self._own, peer))
        self._met.setdefault(peer.name, []).append(met)
        if met.meeting.offers:
            self._tick(met)
        else:
            met.timer = asyncio.get_running_loop().call_later(ASK_AFTER_S, self._tick, met)

    def peer_down(self, name: ClientName, boot: int) -> None:
        for met in self._met.get(name, ()):
            if met.meeting.peer.boot == boot:
                self._forget(met)
                break
        self._count()

    def arrived(self, source: ClientName, datagram: bytes) -> None:
        met = self._whose(source, datagram)
        if met is None:
            return
        taken = met.meeting.take(datagram, now=clock.now(), at_s=self._wall_s())
        if taken.drop is not None:
            self._drop(taken.drop)
            if taken.problem and not met.warned:
                met.warned = True
                _log.warning("relay %s is not let in: %s", source, taken.problem)
        if taken.reply is not None:
            self._carrier.send(source, PriorityClass.CONTROL, taken.reply)
        if met.meeting.up and not met.told:
            self._tell(met)
        self._keep_on(met)
        if taken.datagram is not None:
            self._events.arrived(source, taken.datagram)

    def _whose(self, source: ClientName, datagram: bytes) -> _Met | None:
        """What it is about. None: it was dropped, and counted."""
        known = self._met.get(source, ())
        if datagram[:1] == _SEALED:
            for met in known:
                if met.meeting.knows(datagram):
                    return met
            self._drop(FabricDrop.UNSEALED)
            return None
        boot = boot_of(datagram)
        for met in known:
            if met.meeting.peer.boot == boot:
                return met
        # An offer may be here before the token.
        self._drop(FabricDrop.UNSEALED if boot is None else FabricDrop.NO_PEER)
        return None

    # --- one process of a peer --------------------------------------------------------------------------------------

    def _tick(self, met: _Met) -> None:
        """Tell it what is due, and see again."""
        met.timer = None
        due = met.meeting.due()
        if due is None:
            met.pause_s = RETRY_FIRST_S
            return
        self._carrier.send(met.name, PriorityClass.CONTROL, due)
        met.timer = asyncio.get_running_loop().call_later(met.pause_s, self._tick, met)
        if met.pause_s >= RETRY_MAX_S and not met.meeting.up and not met.warned:
            met.warned = True
            _log.warning("relay %s is there, and nothing goes to it: it does not show its certificate", met.name)
        met.pause_s = min(2 * met.pause_s, RETRY_MAX_S)

    def _keep_on(self, met: _Met) -> None:
        """Have a timer where there is something to be said again."""
        if met.timer is None and not met.meeting.settled:
            met.timer = asyncio.get_running_loop().call_later(met.pause_s, self._tick, met)

    def _tell(self, met: _Met) -> None:
        met.told, met.pause_s, met.warned = True, RETRY_FIRST_S, False
        left_s = max(0.0, met.meeting.expires_s - self._wall_s())
        met.expiry = asyncio.get_running_loop().call_later(left_s, self._expired, met)
        self._up[met.name] = met
        self._count()
        self._events.peer_up(met.meeting.peer)

    def _expired(self, met: _Met) -> None:
        """End a meeting whose certificate has expired, as a TLS connection ends with one."""
        _log.warning("relay %s: its certificate, or that of its authority, has expired", met.name)
        met.meeting.end()
        self._untell(met)
        self._keep_on(met)

    def _untell(self, met: _Met) -> None:
        if met.expiry is not None:
            met.expiry.cancel()
            met.expiry = None
        if not met.told:
            return
        met.told = False
        if self._up.get(met.name) is met:
            del self._up[met.name]
            for other in self._met.get(met.name, ()):
                if other.told:
                    self._up[met.name] = other
        self._count()
        self._events.peer_down(met.name, met.meeting.peer.boot)

    def _forget(self, met: _Met) -> None:
        if met.timer is not None:
            met.timer.cancel()
            met.timer = None
        known = self._met[met.name]
        known.remove(met)
        if not known:
            del self._met[met.name]
        self._untell(met)

    def _count(self) -> None:
        self.counters.peers_up = len(self._up)
