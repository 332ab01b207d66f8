"""The transports to the relay that a client is at: the stream, the datagram lane, the connections for class control,
and the relay's name. With another relay they are others."""

import asyncio
import logging
import secrets
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from random import Random
from typing import Final

import zmq

from sern_client.priority_lane import ClientPriorityLane
from sern_client.relay_name import RelayName, name_in
from sern_client.transport import Dialer, RelayTransport
from sern_client.udp import ClientLane
from sern_core.link.link import Link
from sern_core.site.client import ClientCore
from sern_core.wire import framing
from sern_runtime import clock
from sern_runtime.config.base import split_tcp
from sern_runtime.config.client import RelayConnection
from sern_runtime.config.shared import LinkSection
from sern_runtime.datagram_watch import DatagramWatch
from sern_runtime.draining import Progress
from sern_runtime.zmq_setup import CurvePair

PATIENCE_S: Final = 2.0
"""How long a stopping client waits, beside some round trips, for the next sign that what it still owes gets further."""
STALL_PATIENCE_S: Final = 5.0
"""The same while it has more to send and a session: a path that has stalled often comes back."""
PATIENCE_RTTS: Final = 4.0
SETTLE_S: Final = 0.1
LINGER_S: Final = 1.0
"""How long the goodbye, and what is confirmed before it, may take to leave this machine."""

_log = logging.getLogger(__name__)


class Connection:
    """Joins a core to its relay: `open` once, then any calls, then `close`, which is safe at any time. For another
    relay `leave_for` it, and `open` again.

    `on_down` is told why the stream is down, `on_refused` that the relay does not know our key. What is None is not
    open: not yet, or not wanted, or not possible here.
    """

    def __init__(
        self,
        core: ClientCore,
        relay: RelayConnection,
        link: LinkSection,
        *,
        on_down: Callable[[str], None],
        on_refused: Callable[[], None] = lambda: None,
    ) -> None:
        self.transport: RelayTransport | None = None
        self.lane: ClientLane | None = None
        self.priority_lane: ClientPriorityLane | None = None
        self.name: RelayName | None = None
        self.datagrams = DatagramWatch(lambda: [core.link], self._no_datagrams, lambda link: link.end.name)
        self._core = core
        self._relay = relay
        self._link = link
        self._on_down = on_down
        self._on_refused = on_refused
        self._linger_s = 0.0
        self._bad_frames = 0  # from relays that were left
        self._failed = False  # an attempt has, since it was opened

    @property
    def relay(self) -> RelayConnection:
        """The relay to which it leads."""
        return self._relay

    def open(
        self,
        ctx: "zmq.Context[zmq.Socket[bytes]]",
        keys: CurvePair | None,
        server_keys: Sequence[str],
        *,
        ready: Dialer | None = None,
    ) -> None:
        """Connect, for as long as it takes and again and again. `ready`: a connection to the relay that there is
        already. Raises ConfigError when the address is none."""
        relay, link, marks = self._relay, self._link, self._link.dscp.marks()
        self._failed = False
        self.transport = RelayTransport(
            ctx,
            self._core.link,
            relay.endpoint,
            keys,
            server_keys,
            heartbeat_timeout_s=link.heartbeat_timeout_s,
            handshake_interval_s=relay.handshake_interval_s,
            random=Random(secrets.randbits(64)),
            on_reason=self._down,
            on_refused=self._on_refused,
            after=self.wake,
            marks=marks,
            ready=ready,
        )
        named = name_in(relay.endpoint)
        if named is not None:
            self.name = RelayName(relay.endpoint, *named)
            self.name.tick(connected=False)
        address = split_tcp(relay.endpoint)
        if relay.udp and keys is not None and address is not None:
            self.lane = ClientLane(self._core, address[0], kick=self.wake, marks=marks)
        if relay.priority_connections and address is not None:
            self.priority_lane = ClientPriorityLane(
                self._core, self.transport, link.redundancy, datagrams=self.lane is not None, kick=self.wake
            )

    def use(self, keys: CurvePair, server_keys: Sequence[str], *, redial: bool) -> None:
        """Other keys from now on; `redial`: the stream at once, too. What is of the session stays."""
        if self.transport is not None:
            self.transport.use(keys, server_keys)
            if redial:
                self.transport.dialer.redial("the key is changed")

    @property
    def waiting(self) -> bool:
        """Whether a stream is there, and its handshake under way."""
        return self.transport is not None and self.transport.waiting

    @property
    def letting_in(self) -> bool:
        """Whether the relay has begun to let our first connection in, and has not ended that."""
        return self.transport is not None and not self._failed and self.transport.letting_in

    @property
    def up_s(self) -> float | None:
        """When the relay let a connection in last; None: it has not yet."""
        return None if self.transport is None else self.transport.up_s

    def _down(self, reason: str) -> None:
        self._failed = True
        self._on_down(reason)

    @property
    def bad_frames(self) -> int:
        """Frames from relays that were not valid, on whatever lane."""
        parts = (self.transport, self.lane, self.priority_lane)
        return self._bad_frames + sum(part.bad_frames for part in parts if part is not None)

    def wake(self) -> None:
        """The core may have something to send."""
        if self.transport is not None:
            self.transport.pump.kick()
        if self.lane is not None:
            self.lane.kick()
        if self.priority_lane is not None:
            self.priority_lane.kick()

    def session_began(self) -> None:
        """Ask for what a session may have beside its stream."""
        if self.lane is not None:
            self.lane.ask()
        if self.priority_lane is not None:
            self.priority_lane.begin()

    def lane_offered(self, parameters: framing.Envelope) -> None:
        """The relay has keys for a datagram lane. Raises WireError when it has not."""
        if self.lane is not None:
            self.lane.offered(parameters)

    def lane_closed(self) -> None:
        """The core has closed the datagram lane."""
        if self.lane is not None:
            self.lane.closed()

    def tick(self) -> None:
        """Look after all of them. Call about twice a second."""
        if self.lane is not None:
            self.lane.tick()
        self.datagrams.tick()
        if self.priority_lane is not None:
            self.priority_lane.tick()
        if self.name is not None:
            self.name.tick(connected=self._core.link.established)

    async def drain(self, pending: Callable[[], int], *, limit_s: float) -> None:
        """Go on sending what is owed while that gets anywhere, `limit_s` at most. What arrives meanwhile is taken.
        `pending`: messages that are still to be offered to the link.

        The relay must get everything; whether all subscribers confirm it is waited for as long as confirmations come,
        because a subscriber that is away is the relay's to wait for. Nothing is sent any more once another process has
        our name: it may well be the one that is to go on.
        """
        link = self._core.link
        now = clock.now()
        progress = Progress()
        give_up_s = now + limit_s
        while now < give_up_s and not link.handshake.displaced:
            channels = [channel for channel in link.sender.channels.values() if channel.wanted is not False]
            unsent = sum(len(c.queue) + len(c.flying) + (c.newest is not None) for c in channels) + pending()
            unconfirmed = sum(len(channel.retained) for channel in channels)
            if not unconfirmed and (not unsent or not link.established or link.lane.stalled):
                break
            left = (unsent, unconfirmed, sum(nbytes for _messages, nbytes in link.sender.queued().values()))
            patience_s = STALL_PATIENCE_S if unsent and link.established else PATIENCE_S
            if progress.still_s(left, now=now) > patience_s + PATIENCE_RTTS * link.lane.flight.rtt.srtt_s:
                break
            self.wake()
            await asyncio.sleep(0.02)
            now = clock.now()
        unconfirmed = sum(len(channel.retained) for channel in link.sender.channels.values())
        if unconfirmed:
            _log.warning("stopping with %d reliable messages that not everyone has confirmed", unconfirmed)

    async def settle(self) -> None:
        """Wait for a moment in which nothing of what is reliable is under way, some round trips at most: it may be for
        a client that has gone. Nothing is lost without such a moment: something is sent twice then, and dropped where
        it arrives. What is offered meanwhile goes on as ever."""
        link = self._core.link
        give_up_s = clock.now() + SETTLE_S + PATIENCE_RTTS * link.lane.flight.rtt.srtt_s
        while link.established and not link.lane.stalled and clock.now() < give_up_s:
            channels = link.sender.channels.values()
            if not any(channel.reliable and any(out.started for out in channel.retained) for channel in channels):
                return
            await asyncio.sleep(0.005)

    async def leave(self) -> None:
        """Confirm what has arrived, and say goodbye."""
        if self.transport is None:
            return
        self.wake()
        await asyncio.sleep(0.02)  # what has arrived here is confirmed before we say goodbye
        self.goodbye("client stops")

    def goodbye(self, why: str, *, moved: bool = False) -> None:
        """Say goodbye now. `moved`: we go on at another relay, which is told what is not confirmed here yet."""
        if self.transport is None:
            return
        self.transport.pump.run()
        link = self._core.link
        # Nothing waits for it while the client goes on: then it is worth trying on a link that stands still, too.
        if link.established and (moved or not link.lane.stalled):
            self._linger_s = LINGER_S
        link.close(why, now=clock.now(), moved=moved)
        self.transport.pump.run()

    def close(self) -> None:
        """End whatever was opened, the last first, also when a part of it fails. Idempotent."""
        with ExitStack() as stack:
            if self.transport is not None:
                stack.callback(self.transport.close, linger_s=self._linger_s)
            if self.priority_lane is not None:
                stack.callback(self.priority_lane.close)
            if self.lane is not None:
                stack.callback(self.lane.closed)
            if self.name is not None:
                stack.callback(self.name.close)

    def leave_for(self, relay: RelayConnection, reason: str) -> None:
        """End what leads to the relay that there was, with its session unless that was ended, and lead to `relay` when
        it is opened next."""
        self.close()
        self._bad_frames = self.bad_frames
        self.transport = self.lane = self.priority_lane = self.name = None
        self._relay, self._linger_s = relay, 0.0
        now, link = clock.now(), self._core.link
        link.close(reason, now=now)  # nobody is told any more
        link.disconnected(now=now, reason=reason)

    def _no_datagrams(self, link: Link, within_s: float) -> str | None:
        return None if self.lane is None else self.lane.problem(link, within_s)
