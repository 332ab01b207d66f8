"""How the sessions of one end of a hop begin and end: hello and welcome, and one session after another. Pure.

The client's end is the initiator and says HELLO; the relay's end answers WELCOME. After that both are alike.

    initiator:  idle --connected--> greeting --WELCOME--> up --disconnected--> idle
                                    greeting --REFUSE--> greeting (later)    up --RESET, CLOSE--> greeting
    acceptor:   idle --HELLO--> up --HELLO (another)--> up    up --disconnected, CLOSE--> idle

Every session has a tag; datagrams of another one are ignored. The acceptor answers them with RESET: the initiator may
not know yet that its session is over.
"""

from collections import deque
from typing import Final

from sern_core.link.end import End, microseconds
from sern_core.link.events import Events
from sern_core.link.lane_set import LaneSet
from sern_core.link.session import Session
from sern_core.path.lanes import LANE_UDP, LANE_ZMQ
from sern_core.stream.in_stream import Reassembly
from sern_core.vocabulary.errors import WireError
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
DISPLACED_MIN_S: Final = 0.5
DISPLACED_MAX_S: Final = 10.0
"""First and longest pause after the second short session in a row, and those that follow."""
CUT_OFF_S: Final = 0.1
"""A datagram lane that was found silent less than this before its stream ended says nothing: after a standstill of ours
both are found in one turn of the loop, silence first."""
DISPLACED: Final = "displaced"
"""The code of the refusal that ends a session because another process connected under its name."""
NEW_SESSION: Final = "the session could not go on, and another begins"
"""The reason of an end on a connection that is up."""


class Handshake:
    """Says and hears what is no datagram of a session."""

    def __init__(self, end: End, lanes: LaneSet, reassembly: Reassembly, session: Session, events: Events) -> None:
        self._end = end
        self._reassembly = reassembly
        self._lanes = lanes
        self._session = session
        self._events = events
        self.transport_up = False
        self.reads = True
        """False: the owner is about to end the session; what comes now is for the process after it."""
        self.cut_off = False
        """The stream lane ended when the datagram lane had been silent for a while: the path is gone, not the peer's
        process."""
        self.displaced = False
        """The relay has said that another process has our name now, and there was no session since."""
        self.moved = False
        """The peer has gone to another relay, which has what it still owes and awaits."""
        self._out: deque[bytes] = deque()
        self._hello_due_s: float | None = None
        self._hello_stamp_us = -1
        self._hello_last = end.boot  # the relay that the peer was at before, as the HELLO of the session says
        self._reset_due_s = -float("inf")
        self._abort_due_s = -float("inf")
        self._begun_paid_s = -float("inf")  # until then, beginning sessions has used up its share of the time
        self._short_sessions = 0  # in a row
        self._displaced_pauses = 0  # in a row, after refusals that said so

    # --- transport ------------------------------------------------------------------------------------------------

    def connected(self, now: float) -> None:
        """The stream lane's transport is there. The initiator says hello; the other side waits for it."""
        self.transport_up = True
        if self._end.initiator:
            if self._end.established:
                self._hello_due_s = now  # the session went on over the other lane: say who this is
                self._end.dirty = True
            else:
                self._greet(now, now)

    def disconnected(self, reason: str, now: float) -> None:
        """The stream lane's transport is gone, and with it whatever was in flight there.

        A session that has a datagram lane goes on: a TCP connection does not survive a long blackout, the peer does.
        """
        self.transport_up = False
        self._hello_due_s = None
        self._out.clear()
        udp = self._lanes.by_id.get(LANE_UDP)
        if self._end.established and udp is not None and udp.answered:
            self._end.now = now
            self.cut_off = udp.stalled and now - udp.stalled_at_s >= CUT_OFF_S
            self._lanes.lost_stream(udp, now)
            return
        self._session.end(reason, now)

    # --- out ------------------------------------------------------------------------------------------------------

    @property
    def greeting(self) -> bool:
        """Whether HELLO is to be said, now or later, and nothing else meanwhile."""
        return self._hello_due_s is not None and self.transport_up

    @property
    def speaks(self) -> bool:
        """Whether anything is to be said before what is of a session, now or later."""
        return bool(self._out) or self._hello_due_s is not None

    @property
    def hello_due_s(self) -> float | None:
        """When to say HELLO."""
        return self._hello_due_s

    def next_datagram(self, now: float) -> bytes | None:
        """What is to be said before anything of a session."""
        if self._out:
            return self._out.popleft()
        if self.greeting and self._hello_due_s is not None and now >= self._hello_due_s:
            return self._hello(now)
        return None

    def _hello(self, now: float) -> bytes:
        self._hello_due_s = now + HELLO_INTERVAL_S
        end = self._end
        hello: framing.Envelope = {
            "name": end.name,
            "boot": end.boot,
            "vmin": framing.VERSION_MIN,
            "vmax": framing.VERSION_MAX,
        }
        if end.peer_boot is not None:
            hello["last"] = end.peer_boot
        return framing.encode_handshake(framing.Kind.HELLO, end.tag, microseconds(now), hello)

    def _greet(self, due_s: float, now: float) -> None:
        """Ask for a session at `due_s`."""
        self._session.end(NEW_SESSION, now)
        self._end.tag = self._end.tag % 255 + 1
        self._hello_due_s = due_s
        self._end.dirty = True

    def send_reset(self, tag: int, now: float) -> None:
        """Tell the initiator that its session is over."""
        self._out.append(framing.encode_handshake(framing.Kind.RESET, tag, microseconds(now), {}))
        self._end.dirty = True

    def close(self, reason: str, now: float, *, moved: bool = False) -> None:
        """End the session on purpose and tell the peer. The transport stays. `moved`: we go on at another relay."""
        end = self._end
        if end.established:
            why: framing.Envelope = {"why": reason[:200]}
            if moved:
                why["moved"] = True
            self._out.append(framing.encode_handshake(framing.Kind.CLOSE, end.tag, microseconds(now), why))
            end.dirty = True
        self._session.end(reason, now)

    def abort(self, reason: str, now: float) -> None:
        """End the session because of what went wrong in it, and see to it that the peer begins another one."""
        end = self._end
        if not end.established:
            return
        self._session.end(reason, now)
        if end.initiator:
            due_s = max(now, self._abort_due_s)
            self._abort_due_s = due_s + ABORT_INTERVAL_S
            self._greet(due_s, now)
        else:
            self.send_reset(end.tag, now)

    def renew(self, now: float) -> None:
        """Packet numbers are used up: go on in another session."""
        if self._end.initiator:
            self._greet(now, now)
        else:
            self._session.end("packet numbers used up", now)
            self.send_reset(self._end.tag, now)

    # --- priority connections -------------------------------------------------------------------------------------

    def join(self, now: float) -> bytes | None:
        """What the initiator says first on a connection of the priority lane; None without a session."""
        end = self._end
        if not end.established:
            return None
        join = {"name": end.name, "boot": end.boot, "relay": end.peer_boot}
        return framing.encode_handshake(framing.Kind.JOIN, end.tag, microseconds(now), join)

    def joins(self, join: framing.Envelope, tag: int) -> bool:
        """The relay's end: whether a connection whose name and key were checked belongs to the session there is.

        The name is what admits; boots and tag say that the session is meant, not an earlier one.
        """
        end = self._end
        return (
            end.established
            and tag == end.tag
            and framing.take_int(join, "boot") == end.peer_boot
            and framing.take_int(join, "relay") == end.boot
        )

    # --- in -------------------------------------------------------------------------------------------------------

    def accept(self, hello: framing.Envelope, tag: int, stamp_us: int, now: float, *, another_connection: bool) -> bool:
        """The relay's end: a peer whose name and key were checked says hello; WELCOME is queued. See `Link.accept`."""
        end = self._end
        boot = framing.take_int(hello, "boot")
        version = framing.agree_version(framing.take_int(hello, "vmin"), framing.take_int(hello, "vmax"))
        if boot == end.peer_boot and stamp_us < self._hello_stamp_us:
            return False
        # It was at another relay since: what we have said to it, and it to us, may be over for it.
        last = framing.take_int(hello, "last", default=end.boot)
        greeted = end.established and tag == end.tag and boot == end.peer_boot
        again = greeted and last == self._hello_last  # our WELCOME was lost
        if not again and now < self._begun_paid_s - BEGIN_AHEAD_S:
            return False
        self._hello_stamp_us = stamp_us
        self.transport_up = True
        stream = self._lanes.stream
        if not again:
            self._session.end(NEW_SESSION, now)
            if last != end.boot:
                end.peer_boot = None
            self._hello_last = last
            self.moved = False
            end.tag = tag
            end.version = version
        elif another_connection:
            self._lanes.recall(stream, now)  # the session goes on, what the old connection held does not
        at_us = microseconds(now)
        welcome: framing.Envelope = {
            "name": end.name,
            "boot": end.boot,
            "version": version,
            "echo": stamp_us,
            "at": at_us,
            "again": again,
        }
        self._out.clear()  # of an older greeting, if the peer greets faster than it reads
        self._out.append(framing.encode_handshake(framing.Kind.WELCOME, tag, at_us, welcome))
        end.dirty = True
        stream.up = True
        if not again:
            self._begin(boot, now)
        return True

    def _begin(self, boot: int, now: float) -> None:
        """Begin a session and charge the peer's HELLOs with it: a hundred bytes announce thousands of streams anew."""
        reassembly = self._reassembly
        reassembly.work_us = BEGIN_US + KEPT_US * self._session.kept_messages()
        try:
            self._session.establish(boot)
            self._session.begin(now)
        finally:
            self._begun_paid_s = max(now, self._begun_paid_s) + reassembly.work_us * 1e-6 / BEGIN_SHARE

    def receive(self, data: bytes, lane_id: int, now: float) -> None:
        """What is no datagram of the session. Raises WireError or VersionError."""
        end = self._end
        header = framing.decode_header(data)
        if header.kind != framing.Kind.DATA:
            if lane_id != LANE_ZMQ:
                raise WireError("a handshake has no place on the datagram lane")
            end.now = now
            self._said(header, data, now)
            return
        if header.tag == end.tag and end.established:
            raise WireError(f"version {header.version} was not agreed, {end.version} was")
        if not end.initiator and lane_id == LANE_ZMQ and now >= self._reset_due_s:
            # Of another session; if that one is the peer's latest, it does not know yet that it is over.
            self._reset_due_s = now + RESET_INTERVAL_S
            self.send_reset(header.tag, now)

    def _said(self, header: framing.Header, data: bytes, now: float) -> None:
        """A datagram of the handshake."""
        end = self._end
        envelope = framing.decode_handshake(data)
        kind = framing.Kind(header.kind)
        if kind is framing.Kind.CLOSE:
            if header.tag == end.tag and end.established:
                why = f"{end.peer} closed the session: {framing.take_str(envelope, 'why')}"
                self.moved = not end.initiator and framing.take_bool(envelope, "moved", default=False)
                self._session.end(why, now)
                if end.initiator:
                    self._greet(now + HELLO_INTERVAL_S, now)
            return
        if not end.initiator or kind in (framing.Kind.HELLO, framing.Kind.JOIN):
            raise WireError(f"{kind.name} is not for this side")
        if header.tag != end.tag:
            return
        if kind is framing.Kind.WELCOME and self._hello_due_s is not None:
            self._welcomed(header, envelope, now)
        elif kind is framing.Kind.REFUSE:
            code, text = framing.take_str(envelope, "code", max_length=64), framing.take_str(envelope, "why")
            self.displaced = code == DISPLACED
            if self.displaced:
                pause_s = self._yield_s(now) if end.established else REFUSED_INTERVAL_S
                self._session.end(text, now)
            else:
                pause_s = REFUSED_INTERVAL_S
            self._greet(now + pause_s, now)
            self._events.rejected(code, text, now=now)
        elif kind is framing.Kind.RESET and end.established:
            self._greet(now + self._displaced_pause_s(now), now)

    def _welcomed(self, header: framing.Header, envelope: framing.Envelope, now: float) -> None:
        end, stream = self._end, self._lanes.stream
        self.displaced = False
        end.version = framing.take_int(envelope, "version", low=framing.VERSION_MIN, high=framing.VERSION_MAX)
        end.peer = ClientName(framing.take_str(envelope, "name", max_length=64))
        echo_us = framing.take_int(envelope, "echo", high=2**64 - 1)
        at_us = framing.take_int(envelope, "at", high=2**64 - 1)
        boot = framing.take_int(envelope, "boot")
        if end.established and boot == end.peer_boot and framing.take_bool(envelope, "again"):
            self._hello_due_s = None  # the session went on meanwhile; the stream lane is back
            stream.up = True
            stream.stalled = False
            self._lanes.choose(now)
        else:
            self._session.end(NEW_SESSION, now)
            self._session.establish(boot)
            self._hello_due_s = None
            self._session.begin(now)
        self._lanes.clock.sample(echo_us * 1e-6, at_us * 1e-6, header.stamp_us * 1e-6, now)
        # Without it the first packets on a long path would be given up before they can be acknowledged.
        self._lanes.stream.flight.rtt.sample(max(1e-6, now - echo_us * 1e-6), now=now)

    def _displaced_pause_s(self, now: float) -> float:
        """How long to wait before a session that was taken from us is asked for again. Sessions that end soon, one
        after another, mean that somebody else has our name, and of two that take turns neither has any use."""
        short = now - self._end.up_since_s < SHORT_SESSION_S
        self._short_sessions = self._short_sessions + 1 if short else 0
        if self._short_sessions < 2:
            return 0.0
        return min(DISPLACED_MIN_S * 2.0 ** min(self._short_sessions - 2, 16), DISPLACED_MAX_S)

    def _yield_s(self, now: float) -> float:
        """How long to wait when the relay has said that another process has our name now. Two that both want it take
        turns, each as long as the other waits: a session of that length is no sign that the other has gone."""
        last_s = DISPLACED_MIN_S * 2.0**self._displaced_pauses if self._displaced_pauses else 0.0
        if now - self._end.up_since_s > 2 * min(last_s, DISPLACED_MAX_S) + SHORT_SESSION_S:
            self._displaced_pauses = 0
        self._displaced_pauses = min(self._displaced_pauses + 1, 16)
        return min(DISPLACED_MIN_S * 2.0**self._displaced_pauses, DISPLACED_MAX_S)
