"""The sessions of one end of a hop: hello and welcome, and one session after another.

The client's end is the initiator and says HELLO; the relay's end answers WELCOME. After that both are alike.

    initiator:  idle --connected--> greeting --WELCOME--> up --disconnected--> idle
                                    greeting --REFUSE--> greeting (later)    up --RESET, CLOSE--> greeting
    acceptor:   idle --HELLO--> up --HELLO (another)--> up    up --disconnected, CLOSE--> idle

Every session has a tag; datagrams of another one are ignored. The acceptor answers them with RESET: the initiator may
not know yet that its session is over.

A datagram is read whole, or its session ends: whatever goes wrong in it, by the peer's fault or by ours, ends the
session before anything of it is acknowledged, on whichever lane it came. What it carried comes again in the next one,
and what had its turn is known. A lane alone would not do: what was said after it would wait for ever for what was lost.
"""

import struct
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Final, TypedDict

from sern_core.link.hop import Hop
from sern_core.link.sending import microseconds
from sern_core.path.clocksync import ClockSync
from sern_core.path.lanes import LANE_EXPRESS, LANE_UDP, LANE_ZMQ, Lane
from sern_core.stream.in_stream import SLICE_US, InStream
from sern_core.vocabulary.errors import RemoteError, WireError
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import LINK, DecisionTrace, TraceEvent
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing

HELLO_INTERVAL_S: Final = 1.0
RESET_INTERVAL_S: Final = 0.5
REFUSED_INTERVAL_S: Final = 5.0
ABORT_INTERVAL_S: Final = 1.0
"""Sessions that end because something went wrong follow each other no faster: else both ends would do nothing else."""
BEGIN_US: Final = 60
KEPT_US: Final = 2
"""What a session that begins at the relay's end is charged with, beside what its owner does then: itself, and each
message that is kept for the peer."""
BEGIN_SHARE: Final = 1.0 / 3.0
BEGIN_AHEAD_S: Final = 0.1
"""The share of the relay's time that beginning the sessions of one peer may take, and how far they may be ahead of it.
A HELLO that comes too early is not answered; the initiator says it again after `HELLO_INTERVAL_S`."""
SHORT_SESSION_S: Final = 5.0
"""A session that is taken from us sooner than this was short."""
DISPLACED_S: Final = (0.5, 10.0)
"""First and longest pause after the second short session in a row, and those that follow."""
DISPLACED: Final = "displaced"
"""The code of the refusal that ends a session because another process connected under its name."""
NEW_SESSION: Final = "the session could not go on, and another begins"
"""The reason of an end on a connection that is up."""
MAX_UNREAD_BYTES: Final = 32 * 2**20
UNREAD_OVERHEAD_BYTES: Final = 256
"""Datagrams of a peer that wait to be read, each with so much beside it: far more than any window lets a peer send that
hears of none."""
NUMBER_AND_STAMP: Final = struct.Struct("!IQ")


class SessionArguments(TypedDict):
    """What a session is made with; those who add to it pass it on."""

    name: ClientName
    boot: int
    peer: ClientName
    initiator: bool
    link: LinkParams
    scheduler: SchedulerParams
    trace: DecisionTrace
    now: float
    lossless: bool


class Session(Hop):
    """Handshake and session of one end. `Link` adds what a session is for."""

    def __init__(
        self,
        *,
        name: ClientName,
        boot: int,
        peer: ClientName,
        initiator: bool,
        link: LinkParams,
        scheduler: SchedulerParams,
        trace: DecisionTrace,
        now: float,
        lossless: bool,
    ) -> None:
        self.initiator = initiator
        self.peer_boot: int | None = None
        self.transport_up = False
        self.reads = True
        """False: the owner is about to end the session; what comes now is for the process after it."""
        self._handshake_out: deque[bytes] = deque()
        self._hello_due_s: float | None = None
        self._hello_stamp_us = -1
        self._reset_due_s = -float("inf")
        self._abort_due_s = -float("inf")
        self._begun_paid_s = -float("inf")  # until then, beginning sessions has used up its share of the time
        self._short_sessions = 0  # in a row
        self._displaced_pauses = 0  # in a row, after refusals that said so
        self._resumed = False
        self._data_prefix = b""  # how a data datagram of the session begins
        self._fresh: deque[tuple[InStream, Message, int]] = deque()
        """Messages of class control that were young enough, with the number of steps that the clock estimate had seen:
        what arrives in the same turn may tell that our clock stood still while they lay here."""
        self.cut_off = False
        """The stream lane ended when the datagram lane was silent already: the path is gone, not the peer's process."""
        self._unread: deque[tuple[int, int, int, bytes, int]] = deque()  # lane, number, stamp, datagram, where to go on
        self._unread_bytes = 0
        self.read_due_s: float | None = None
        """When to go on reading; None: nothing that has arrived waits to be read."""
        self._unreadable: RemoteError | None = None  # found at a time when nobody could be told
        self.on_read: Callable[[], None] | None = None
        """Called after something was read by time, as its owner does itself after `receive`."""
        super().__init__(
            name=name, boot=boot, peer=peer, link=link, scheduler=scheduler, trace=trace, now=now, lossless=lossless
        )

    @abstractmethod
    def _session_began(self, resumed: bool, now: float) -> None: ...

    @abstractmethod
    def _session_ended(self, reason: str, now: float) -> None: ...

    @abstractmethod
    def _hand_on(self, now: float) -> None:
        """Deliver what is in `_fresh`: everything that had arrived has been looked at."""

    @abstractmethod
    def _go_on(self, now: float) -> bool:
        """Do more of what has to be done before the next frame is read. True: all of it is done."""

    @abstractmethod
    def _lane_closed(self) -> None:
        """The datagram lane ended with its session: its transport and keys are of no more use."""

    @abstractmethod
    def _session_refused(self, code: str, text: str, now: float) -> None: ...

    # --- transport ------------------------------------------------------------------------------------------------

    def connected(self, *, now: float) -> None:
        """The stream lane's transport is there. The initiator says hello; the other side waits for it."""
        self.transport_up = True
        if self.initiator:
            if self.established:
                self._hello_due_s = now  # the session went on over the other lane: say who this is
                self.dirty = True
            else:
                self._greet(now, now)

    def disconnected(self, *, now: float, reason: str = "connection lost") -> None:
        """The stream lane's transport is gone, and with it whatever was in flight there.

        A session that has a datagram lane goes on: a TCP connection does not survive a long blackout, the peer does.
        """
        self.transport_up = False
        self._hello_due_s = None
        self._handshake_out.clear()
        udp = self.lanes.get(LANE_UDP)
        if self.established and udp is not None and udp.answered:
            self._now = now
            self.lanes[LANE_ZMQ].up = False
            self.cut_off = udp.stalled
            self._recall(self.lanes[LANE_ZMQ], now)
            self._use_lane(udp, now)
            self._choose_express(now)
            return
        self._end_session(reason, now)

    def open_lane(self, *, now: float, lane_id: int = LANE_UDP) -> None:
        """Another lane has a transport (admitted in the session): ask whether it works, then use it."""
        beside = self.lanes[LANE_ZMQ] if lane_id == LANE_EXPRESS else None
        if (old := self.lanes.get(lane_id)) is not None:
            old.leave()
        lane = self.lanes[lane_id] = Lane(lane_id, self.params, lossless=False, beside=beside)
        lane.up = True
        lane.new_session(now)
        stream_rtt = self.lanes[LANE_ZMQ].flight.rtt
        if stream_rtt.samples:
            lane.flight.rtt.sample(stream_rtt.srtt_s, now=now)
        if beside is None:
            lane.estimator.on_reset(now=now)
        self.dirty = True

    def close_lane(self, *, now: float, lane_id: int = LANE_UDP, reason: str = "both lanes are gone") -> None:
        """A lane's transport is gone or its keys are used up. `reason`: of the session's end, if that was its last."""
        lane = self.lanes.pop(lane_id, None)
        if lane is None:
            return
        self._now = now
        if self.lane is lane:
            self._use_lane(self.lanes[LANE_ZMQ], now)
        self._choose_express(now)
        self._recall(lane, now)
        lane.leave()
        if self.established and not self.transport_up:
            self._end_session(reason, now)

    def _greet(self, due_s: float, now: float) -> None:
        self._end_session(NEW_SESSION, now)
        self.tag = self.tag % 255 + 1
        self._hello_due_s = due_s
        self.dirty = True

    def _displaced_pause_s(self, now: float) -> float:
        """How long to wait before a session that was taken from us is asked for again. Sessions that end soon, one
        after another, mean that somebody else has our name, and of two that take turns neither has any use."""
        self._short_sessions = self._short_sessions + 1 if now - self._up_since_s < SHORT_SESSION_S else 0
        if self._short_sessions < 2:
            return 0.0
        return min(DISPLACED_S[0] * 2.0 ** min(self._short_sessions - 2, 16), DISPLACED_S[1])

    def _yield_s(self, now: float) -> float:
        """How long to wait when the relay has said that another process has our name now. Two that both want it take
        turns, each as long as the other waits: a session of that length is no sign that the other has gone."""
        last_s = DISPLACED_S[0] * 2.0**self._displaced_pauses if self._displaced_pauses else 0.0
        if now - self._up_since_s > 2 * min(last_s, DISPLACED_S[1]) + SHORT_SESSION_S:
            self._displaced_pauses = 0
        self._displaced_pauses = min(self._displaced_pauses + 1, 16)
        return min(DISPLACED_S[0] * 2.0**self._displaced_pauses, DISPLACED_S[1])

    def _hello(self, now: float) -> bytes:
        self._hello_due_s = now + HELLO_INTERVAL_S
        hello = {"name": self.name, "boot": self.boot, "vmin": framing.VERSION_MIN, "vmax": framing.VERSION_MAX}
        return framing.encode_handshake(framing.Kind.HELLO, self.tag, microseconds(now), hello)

    def join(self, *, now: float) -> bytes | None:
        """What the initiator says first on a connection of the express lane; None without a session."""
        if not self.established:
            return None
        join = {"name": self.name, "boot": self.boot, "relay": self.peer_boot}
        return framing.encode_handshake(framing.Kind.JOIN, self.tag, microseconds(now), join)

    def joins(self, join: framing.Envelope, tag: int) -> bool:
        """The relay's end: whether a connection whose name and key were checked belongs to the session there is.

        The name is what admits; boots and tag say that the session is meant, not an earlier one.
        """
        return (
            self.established
            and tag == self.tag
            and framing.take_int(join, "boot") == self.peer_boot
            and framing.take_int(join, "relay") == self.boot
        )

    def accept(
        self, hello: framing.Envelope, tag: int, stamp_us: int, *, now: float, another_connection: bool = False
    ) -> bool:
        """The relay's end: a peer whose name and key were checked says hello; WELCOME is queued.

        False: an old HELLO that the network delivered late, or one that comes too soon. Raises WireError, or
        VersionError when no wire version is common; the caller refuses then.
        """
        try:
            return self._accept(hello, tag, stamp_us, now, another_connection=another_connection)
        except RemoteError:
            raise
        except Exception as error:  # noqa: BLE001  (an error of ours ends the session that it was to begin)
            self.failed(error, now=now)
            return True

    def _accept(
        self, hello: framing.Envelope, tag: int, stamp_us: int, now: float, *, another_connection: bool
    ) -> bool:
        boot = framing.take_int(hello, "boot")
        version = framing.agree_version(framing.take_int(hello, "vmin"), framing.take_int(hello, "vmax"))
        if boot == self.peer_boot and stamp_us < self._hello_stamp_us:
            return False
        again = self.established and tag == self.tag and boot == self.peer_boot  # our WELCOME was lost
        if not again and now < self._begun_paid_s - BEGIN_AHEAD_S:
            return False
        self._hello_stamp_us = stamp_us
        self.transport_up = True
        if not again:
            self._end_session(NEW_SESSION, now)
            self.tag = tag
            self.version = version
        elif another_connection:
            self._recall(self.lanes[LANE_ZMQ], now)  # the session goes on, what the old connection held does not
        at_us = microseconds(now)
        welcome: framing.Envelope = {
            "name": self.name,
            "boot": self.boot,
            "version": version,
            "echo": stamp_us,
            "at": at_us,
            "again": again,
        }
        self._handshake_out.clear()  # of an older greeting, if the peer greets faster than it reads
        self._handshake_out.append(framing.encode_handshake(framing.Kind.WELCOME, tag, at_us, welcome))
        self.dirty = True
        self.lanes[LANE_ZMQ].up = True
        if not again:
            self._begin_charged(boot, now)
        return True

    def _begin_charged(self, peer_boot: int, now: float) -> None:
        """Begin a session and charge the peer's HELLOs with it: a hundred bytes announce thousands of streams anew."""
        reassembly = self.reassembly
        kept = sum(channel.kept for channel in self.channels.values())
        reassembly.work_us = BEGIN_US + KEPT_US * kept
        try:
            self._establish(peer_boot, now)
        finally:
            spent_s = reassembly.work_us * 1e-6
            self._begun_paid_s = max(now, self._begun_paid_s) + spent_s / BEGIN_SHARE

    def close(self, reason: str, *, now: float) -> None:
        """End the session on purpose and tell the peer. The transport stays."""
        if self.established:
            why = {"why": reason[:200]}
            self._handshake_out.append(framing.encode_handshake(framing.Kind.CLOSE, self.tag, microseconds(now), why))
            self.dirty = True
        self._end_session(reason, now)

    def failed(self, error: Exception, *, now: float) -> None:
        """An error of ours on this link: the owner is told, and the session ends; the next one begins in order."""
        self._now = now
        self.fault(error)
        self._abort(f"internal error ({type(error).__name__})", now)

    def _abort(self, reason: str, now: float) -> None:
        """End the session because of what went wrong in it, and see to it that the peer begins another one."""
        if not self.established:
            return
        self._end_session(reason, now)
        if self.initiator:
            due_s = max(now, self._abort_due_s)
            self._abort_due_s = due_s + ABORT_INTERVAL_S
            self._greet(due_s, now)
        else:
            self._send_reset(self.tag, now)

    def _establish(self, peer_boot: int, now: float) -> None:
        resumed = self._resumed = self.peer_boot == peer_boot
        if not resumed:
            for channel in self.channels.values():
                channel.peer_restarted()
            self.clock = ClockSync()
        self.peer_boot = peer_boot
        self.established = True
        self._data_prefix = bytes((framing.MAGIC, self.version, framing.Kind.DATA, self.tag))
        self._hello_due_s = None
        lane = self.lane = self.lanes[LANE_ZMQ]
        lane.up = True
        lane.new_session(now)
        lane.estimator.on_reset(now=now)
        self._rate_known(now)
        self._up_since_s = now
        self._watermarks.clear()
        self._begin_control()
        self.trace.record(now, LINK, TraceEvent.LINK_UP, peer=self.peer)
        try:
            self._session_began(resumed, now)
        except Exception:  # goes on to whoever called; only the state is put right here
            self.peer_boot = None  # the owner may not have begun: to it the next session is the first with that peer
            raise

    def _end_session(self, reason: str, now: float) -> None:
        self._now = now
        self._hand_on(now)
        for lane in self.lanes.values():
            self._recall(lane, now)
        self.lane = self.lanes[LANE_ZMQ]
        for stream in self.incoming.values():
            stream.channel_id = None
            stream.known = True
            stream.pause_seq = 0
            stream.reports.unsay()
        self.incoming.clear()
        self._watermarks.clear()
        self._unread.clear()
        self._unread_bytes = 0
        self._half_read = False
        self.reassembly.behind.pop(self._control_in, None)
        udp = self.lanes.pop(LANE_UDP, None)  # its keys end with the session
        if (express := self.lanes.pop(LANE_EXPRESS, None)) is not None:
            express.leave()
        self.express = None
        if not self.established:
            return
        self.established = False
        self._data_prefix = b""
        if udp is not None:
            self._lane_closed()
        for channel in self.channels.values():
            channel.ready = False
            self._refresh(channel, now)
        self.trace.record(now, LINK, TraceEvent.LINK_DOWN, peer=self.peer, reason=reason)
        self._session_ended(reason, now)

    # --- bytes and time -------------------------------------------------------------------------------------------

    def next_datagram(self, *, now: float, lane: int = LANE_ZMQ) -> bytes | None:
        """The next bytes for the lane, or None if nothing may or need be sent now."""
        try:
            if self._fresh:
                self._hand_on(now)
            if lane == LANE_ZMQ:
                if self._handshake_out:
                    return self._handshake_out.popleft()
                if self._hello_due_s is not None and self.transport_up:
                    if now >= self._hello_due_s:
                        return self._hello(now)
                    self.dirty = False
                    return None
            state = self.lanes.get(lane)
            if not self.established or state is None or not state.up:
                self.dirty = False
                return None
            if state.flight.next_number >= framing.MAX_PACKET_NUMBER:
                self._renew(now)
                return self.next_datagram(now=now, lane=lane)
            return self._next_data(state, now)
        except Exception as error:  # noqa: BLE001  (what was taken for the datagram is given back; the session ends)
            self.failed(error, now=now)
            return None

    def _renew(self, now: float) -> None:
        """Packet numbers are used up: go on in another session."""
        if self.initiator:
            self._greet(now, now)
        else:
            self._end_session("packet numbers used up", now)
            self._send_reset(self.tag, now)

    def _send_reset(self, tag: int, now: float) -> None:
        if now >= self._reset_due_s:
            self._reset_due_s = now + RESET_INTERVAL_S
            self._handshake_out.append(framing.encode_handshake(framing.Kind.RESET, tag, microseconds(now), {}))
            self.dirty = True

    def receive(self, data: framing.Datagram, *, now: float, lane: int = LANE_ZMQ) -> None:
        """One datagram from the lane. Raises WireError or VersionError for bytes no honest peer sends; the session has
        ended then, as it has after an error of ours, of which the owner is told (`fault`)."""
        try:
            if data[:4] == self._data_prefix and framing.HEADER_BYTES <= len(data) <= framing.MAX_DATAGRAM_BYTES:
                state = self.lanes.get(lane)
                if state is not None:
                    number, stamp_us = NUMBER_AND_STAMP.unpack_from(data, 4)
                    if self.read_due_s is None:
                        self.reassembly.work_us = 0
                        self._receive_data(state, number, stamp_us, data, now)
                    else:
                        self._read_later(lane, number, stamp_us, bytes(data))
            else:
                self._receive_other(bytes(data), lane, now)
        except RemoteError:
            self._abort("what it sent could not be read", now)
            raise
        except Exception as error:  # noqa: BLE001  (the one place for errors of ours while a datagram is read)
            self.failed(error, now=now)

    def _receive_other(self, data: bytes, lane: int, now: float) -> None:
        """What is no datagram of the session."""
        if self._unreadable is not None:
            error, self._unreadable = self._unreadable, None
            raise error
        header = framing.decode_header(data)
        if header.kind != framing.Kind.DATA:
            if lane != LANE_ZMQ:
                raise WireError("a handshake has no place on the datagram lane")
            self._now = now
            self._handshake(header, data, now)
            return
        if header.tag == self.tag and self.established:
            raise WireError(f"version {header.version} was not agreed, {self.version} was")
        if not self.initiator and lane == LANE_ZMQ:
            # Of another session; if that one is the peer's latest, it does not know yet that it is over.
            self._send_reset(header.tag, now)

    # What a peer says may cost much more than its bytes: one announcement, a channel for each of fifty subscribers. So
    # reading stops when that has cost `SLICE_US`, and goes on after as long a rest, at the very frame: what follows
    # depends on it. Nothing of a datagram that is half read is acknowledged, and nothing of those behind it, so that a
    # session that ends meanwhile loses nothing; a peer that waits for acknowledgements is slowed down by it.

    def _pause_reading(
        self, lane: Lane, number: int, stamp_us: int, data: framing.Datagram, position: int, now: float
    ) -> None:
        if self.established:
            self._half_read = True
            self._unread_bytes += len(data) + UNREAD_OVERHEAD_BYTES
            self._unread.appendleft((lane.id, number, stamp_us, bytes(data), position))
        self.read_due_s = now + self.reassembly.work_us * 1e-6
        self.dirty = True

    def _read_later(self, lane: int, number: int, stamp_us: int, data: bytes) -> None:
        self._unread_bytes += len(data) + UNREAD_OVERHEAD_BYTES
        if self._unread_bytes > MAX_UNREAD_BYTES:
            raise WireError(f"{self.peer} goes on sending although {len(self._unread)} datagrams wait to be read")
        self._unread.append((lane, number, stamp_us, data, 0))

    def _read_on(self, now: float) -> None:
        self._now = now
        reassembly = self.reassembly
        reassembly.work_us = 0
        self.read_due_s = None
        done = self._go_on(now)
        while done and self._unread and reassembly.work_us <= SLICE_US:
            lane, number, stamp_us, data, position = self._unread.popleft()
            self._unread_bytes -= len(data) + UNREAD_OVERHEAD_BYTES
            if position:
                self._half_read = False
                self.dirty = True
            state = self.lanes.get(lane)
            if state is not None:  # else it is closed, and what came over it comes again
                self._receive_data(state, number, stamp_us, data, now, position)
            done = self.read_due_s is None
        if not done or self._unread:
            self.read_due_s = now + reassembly.work_us * 1e-6
        if self.on_read is not None:
            self.on_read()

    def next_deadline(self, lane: int = LANE_ZMQ) -> float | None:
        """When to call `handle_timeout` and `next_datagram` at the latest, if nothing else happens."""
        deadline_s, read_due_s = self._lane_deadline(lane), self.read_due_s
        return deadline_s if read_due_s is None or (deadline_s is not None and deadline_s < read_due_s) else read_due_s

    def _lane_deadline(self, lane: int) -> float | None:
        state = self.lanes.get(lane)
        if lane != LANE_ZMQ:
            return self._data_deadline(state) if self.established and state is not None else None
        if self._hello_due_s is not None and self.transport_up:
            return min(self._hello_due_s, self._sweep_due_s)
        if self.established and state is not None and state.up:
            return self._data_deadline(state)
        return self._sweep_due_s

    def handle_timeout(self, *, now: float, lane: int = LANE_ZMQ) -> None:
        try:
            if self._fresh:
                self._hand_on(now)
            if self.read_due_s is not None and now >= self.read_due_s:
                self._read_on(now)
            state = self.lanes.get(lane)
            if self.established and state is not None and state.up and not (lane == LANE_ZMQ and self._hello_due_s):
                self._data_timeout(state, now)
            elif lane == LANE_ZMQ and now >= self._sweep_due_s:
                self._now = now
                self._sweep(now)
        except RemoteError as error:
            self._unreadable = error
            self._abort(f"what it sent could not be read: {error}", now)
        except Exception as error:  # noqa: BLE001  (as in `receive`)
            self.failed(error, now=now)
        self.dirty = True

    def _handshake(self, header: framing.Header, data: bytes, now: float) -> None:
        envelope = framing.decode_handshake(data)
        kind = framing.Kind(header.kind)
        if kind is framing.Kind.CLOSE:
            if header.tag == self.tag and self.established:
                why = f"{self.peer} closed the session: {framing.take_str(envelope, 'why')}"
                if self.initiator:
                    self._end_session(why, now)
                    self._greet(now + HELLO_INTERVAL_S, now)
                else:
                    self._end_session(why, now)
            return
        if not self.initiator or kind in (framing.Kind.HELLO, framing.Kind.JOIN):
            raise WireError(f"{kind.name} is not for this side")
        if header.tag != self.tag:
            return
        if kind is framing.Kind.WELCOME and self._hello_due_s is not None:
            self.version = framing.take_int(envelope, "version", low=framing.VERSION_MIN, high=framing.VERSION_MAX)
            self.peer = ClientName(framing.take_str(envelope, "name", max_length=64))
            echo_us = framing.take_int(envelope, "echo", high=2**64 - 1)
            at_us = framing.take_int(envelope, "at", high=2**64 - 1)
            boot = framing.take_int(envelope, "boot")
            if self.established and boot == self.peer_boot and framing.take_bool(envelope, "again"):
                self._hello_due_s = None  # the session went on meanwhile; the stream lane is back
                self.lanes[LANE_ZMQ].up = True
                self.lanes[LANE_ZMQ].stalled = False
                self._choose_lane(now)
            else:
                self._end_session(NEW_SESSION, now)
                self._establish(boot, now)
            self.clock.sample(echo_us * 1e-6, at_us * 1e-6, header.stamp_us * 1e-6, now)
            # Without it the first packets on a long path would be given up before they can be acknowledged.
            self.lanes[LANE_ZMQ].flight.rtt.sample(max(1e-6, now - echo_us * 1e-6), now=now)
        elif kind is framing.Kind.REFUSE:
            code, text = framing.take_str(envelope, "code", max_length=64), framing.take_str(envelope, "why")
            if code == DISPLACED:
                pause_s = self._yield_s(now) if self.established else REFUSED_INTERVAL_S
                self._end_session(text, now)
            else:
                pause_s = REFUSED_INTERVAL_S
            self._greet(now + pause_s, now)
            self._session_refused(code, text, now)
        elif kind is framing.Kind.RESET and self.established:
            self._greet(now + self._displaced_pause_s(now), now)
