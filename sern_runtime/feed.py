"""The feed: plain XPUB/XSUB sockets for programs without SERN code, in any language that has ZeroMQ.

A message is three frames:

    +----------------------------+----------------------+----------------+
    | topic name (UTF-8) and NUL | header, 24 bytes     | body, raw      |
    +----------------------------+----------------------+----------------+

     0       1       2               4                               8
    +-------+-------+---------------+-------------------------------+
    |version| class |   0 (zero)    |       sequence (low 32)       |
    +-------+-------+---------------+-------------------------------+
    |                  stamp, ns of Unix time, signed               |
    +---------------------------------------------------------------+
    |                  age when sent, µs, unsigned                  |
    +---------------------------------------------------------------+    big endian

The NUL ends the name: a subscription to `/r/odom` also matches `/r/odom_filtered`, one to `/r/odom\\0` does not. A
publisher may leave the header frame empty: class bulk, sequence 0, stamped on arrival.

There is one pair of sockets for each role, filtered before sending: on a shared XPUB a grant per topic could not be
kept apart. A role is what its address gives; publishing is off unless the role has an ingest endpoint. There are no
keys and nothing is encrypted: the feed is for this machine, or for a network where everybody is trusted.
"""

import asyncio
import logging
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import zmq

from sern_core.relay.access import RateGuard
from sern_core.topics.rules import FeedRole
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import CLASSES, PriorityClass, TopicName
from sern_runtime.clock import now
from sern_runtime.feed_inflow import SUBSCRIBER_BYTES, TOLD_BYTES, FeedInflow
from sern_runtime.feed_subscriptions import Subscriptions
from sern_runtime.zmq_setup import BACKLOG, apply_common_options, bind_all
from sern_runtime.zmq_socket import ZERO_COPY_BYTES, DrainedSocket

VERSION: Final = 1
HEADER: Final = struct.Struct("!BBHIqQ")
MAX_TOPIC_BYTES: Final = 512
MAX_FRAMES: Final = 8
MAX_MESSAGE_BYTES: Final = 16 * 2**20
"""A publisher's frame above this closes its connection. The local network carries maps and images whole."""
MAX_SUBSCRIPTION_BYTES: Final = MAX_TOPIC_BYTES + 64
"""A subscriber's frame above this closes its connection: a longer prefix is that of no topic frame, and libzmq keeps
some hundred bytes for each of its bytes, on our thread. 64: the name of a command takes 10, the rest is to spare."""
HIGH_WATER: Final = 1000
"""Messages that may wait for a slow subscriber; libzmq drops what comes after them, for that subscriber alone."""
INTEREST_S: Final = 0.05
"""Between two calls of `on_interest`: one message of subscriptions is cheap, and what follows from it is not."""
RELEASE_S: Final = 1.0
"""The longest wait for libzmq to let go of addresses."""
_MAX_VERDICTS: Final = 4096
_NOBLOCK: Final = int(zmq.NOBLOCK)
_NOBLOCK_MORE: Final = int(zmq.NOBLOCK | zmq.SNDMORE)
_log = logging.getLogger(__name__)


class FeedHeader(NamedTuple):
    """The second frame. `seq` modulo 2³²; `stamp_ns` Unix time; `age_us` is the message's age when it was sent."""

    priority: PriorityClass
    seq: int
    stamp_ns: int
    age_us: int = 0

    def pack(self) -> bytes:
        return HEADER.pack(VERSION, self.priority, 0, self.seq & 0xFFFFFFFF, self.stamp_ns, self.age_us)

    @classmethod
    def parse(cls, raw: bytes) -> "FeedHeader | None":
        """None for anything but a header of this version."""
        if len(raw) != HEADER.size:
            return None
        version, priority, reserved, seq, stamp_ns, age_us = HEADER.unpack(raw)
        if version != VERSION or reserved or priority >= len(CLASSES):
            return None
        return cls(PriorityClass(priority), seq, stamp_ns, age_us)


def topic_frame(name: str) -> bytes:
    """The first frame for a topic name."""
    return name.encode() + b"\0"


def parse_topic(frame: bytes) -> TopicName | None:
    """The name in a first frame, None when it is none: NUL at its end alone, a slash first, printable UTF-8."""
    if not 3 <= len(frame) <= MAX_TOPIC_BYTES or frame[0] != 0x2F or frame.find(b"\0") != len(frame) - 1:
        return None
    try:
        name = frame[:-1].decode()
    except UnicodeDecodeError:
        return None
    return TopicName(name) if name.isprintable() else None


@dataclass(slots=True)
class FeedCounters:
    """What went through a role, from start on."""

    sent: int = 0  # messages handed to the role's XPUB while somebody wanted them
    received: int = 0  # messages that came in through the role and were accepted
    received_bytes: int = 0
    forbidden: int = 0  # the role may not publish that topic, or not in that class
    malformed: int = 0
    limited: int = 0  # more than the role's limits let in
    endless: int = 0  # connections that were cut: bytes arrived on them, and no message did
    capped: int = 0  # connections that were cut: the role had as many as it may
    crowded: int = 0  # connections that were cut: they subscribed to more than there is room for


Accept = Callable[[FeedRole, TopicName], bool]
"""`accept(role, name)`: may this role own or write the name now? Asked once a topic; `Feed.refresh` forgets answers."""

OnPublish = Callable[[FeedRole, TopicName, FeedHeader, bytes], None]
"""`on_publish(role, name, header, body)`: a message came in. The feed's own subscribers have got it already."""


class Feed:
    """The feed of a relay: one XPUB, and where configured one XSUB, for each role.

    `on_publish` None: what comes in goes to the feed's own subscribers only. `on_interest` is called soon after the
    set of wanted prefixes has changed, once for all that changes within `INTEREST_S`. The roles' addresses are the only
    guard. Raises ConfigError when an endpoint cannot be had. `close()` once.

    A subscriber's frames are bounded by what can name a topic, and its connection by `SUBSCRIBER_BYTES` of them. What
    subscribers keep is bounded for each of them and for all of a role (`feed_subscriptions`).
    """

    def __init__(
        self,
        ctx: "zmq.Context[zmq.Socket[bytes]]",
        roles: Iterable[FeedRole],
        *,
        on_publish: OnPublish | None = None,
        on_interest: Callable[[], None] | None = None,
        accept: Accept | None = None,
        max_message_bytes: int = MAX_MESSAGE_BYTES,
        wall_ns: Callable[[], int] = time.time_ns,
        clock: Callable[[], float] = now,
    ) -> None:
        self.clock = clock
        self.on_publish = on_publish
        self.on_interest = on_interest
        self.accept = accept
        self.wall_ns = wall_ns
        self._ctx = ctx
        self.max_message_bytes = max_message_bytes
        self._outlets: dict[str, _Outlet] = {}
        self._inlets: dict[str, _Inlet] = {}
        self._roles: dict[str, FeedRole] = {}
        self._counters: dict[str, FeedCounters] = {}
        self.missing = False
        """Whether an endpoint of some role could not be had (`open_missing`)."""
        self._loop = asyncio.get_running_loop()
        self._telling: asyncio.TimerHandle | None = None
        self._told_s = -INTEREST_S
        try:
            self.update(roles)
        except BaseException:
            self.close()
            raise

    def update(self, roles: Iterable[FeedRole]) -> None:
        """Make these the roles. Sockets whose address stays are kept with their subscriptions, and filter by the new
        patterns from now on; others are closed, which cuts their connections. Raises ConfigError for the first endpoint
        that cannot be had: all others are in force then, and `open_missing` tries it again."""
        wanted = self._roles = {role.name: role for role in roles}
        leaving: list[_Outlet | _Inlet] = []
        for name, outlet in list(self._outlets.items()):
            new = wanted.get(name)
            if new is None or new.publish_endpoint != outlet.role.publish_endpoint:
                leaving.append(self._outlets.pop(name))
            else:
                outlet.role = new
        for name, inlet in list(self._inlets.items()):
            new = wanted.get(name)
            if new is None or new.ingest_endpoint != inlet.role.ingest_endpoint:
                leaving.append(self._inlets.pop(name))
            else:
                inlet.adopt(new)
        _release(leaving)
        for outlet in self._outlets.values():
            outlet.forget()
        self.refresh()
        problem = self.open_missing()
        if problem is not None:
            raise problem

    def open_missing(self) -> ConfigError | None:
        """Open what the roles say and there is not yet; returns why the first endpoint cannot be had that cannot."""
        problem: ConfigError | None = None
        for name, role in self._roles.items():
            try:
                if name not in self._outlets:
                    self._outlets[name] = _Outlet(self, role, self._unbound(zmq.XPUB))
                if name not in self._inlets and role.ingest_endpoint is not None:
                    self._inlets[name] = _Inlet(self, role, self._unbound(zmq.XSUB), role.ingest_endpoint)
            except ConfigError as error:
                problem = problem or error
        self.missing = problem is not None
        return problem

    def counters_of(self, role_name: str) -> FeedCounters:
        """They last as long as the feed, whatever becomes of the role's sockets."""
        return self._counters.setdefault(role_name, FeedCounters())

    def close(self) -> None:
        if self._telling is not None:
            self._telling.cancel()
            self._telling = None
        for inlet in self._inlets.values():
            inlet.close()
        for outlet in self._outlets.values():
            outlet.close()

    def publish(self, name: TopicName, header: FeedHeader, body: bytes) -> int:
        """Send a message to the subscribers of every role that may see it; returns how many roles wanted it."""
        frame = topic_frame(name)
        packed = b""
        count = 0
        for outlet in self._outlets.values():
            if outlet.wants(frame, name):
                packed = packed or header.pack()
                outlet.send_message(frame, packed, body)
                count += 1
        return count

    def wants(self, name: TopicName) -> bool:
        """Is there a subscriber for this topic in a role that may see it?"""
        frame = topic_frame(name)
        return any(outlet.wants(frame, name) for outlet in self._outlets.values())

    def prefixes(self) -> dict[str, tuple[bytes, ...]]:
        """The subscriptions by role, as they came in: prefixes of the topic frame, the empty one meaning all."""
        return {name: outlet.subscriptions.prefixes for name, outlet in self._outlets.items()}

    def counters(self) -> dict[str, FeedCounters]:
        """Counters by role name."""
        for outlet in self._outlets.values():
            outlet.count()
        for inlet in self._inlets.values():
            inlet.count()
        return {name: self.counters_of(name) for name in self._roles}

    def endpoints(self) -> dict[str, tuple[str, str | None]]:
        """Where subscribers and publishers connect, as bound, by role name."""
        return {
            name: (outlet.endpoint, self._inlets[name].endpoint if name in self._inlets else None)
            for name, outlet in self._outlets.items()
        }

    @property
    def outlets(self) -> "Iterable[_Outlet]":
        return self._outlets.values()

    def refresh(self) -> None:
        """Ask `accept` again for every topic: ownership of names has changed."""
        for inlet in self._inlets.values():
            inlet.verdicts.clear()

    def _unbound(self, kind: int) -> "zmq.Socket[bytes]":
        socket = self._ctx.socket(kind)
        try:
            if kind == zmq.XPUB:
                # One at a time: libzmq takes in all that waits before it lets go of our thread, and meanwhile nobody
                # sees how much a connection brings.
                limit_bytes, rcvhwm = MAX_SUBSCRIPTION_BYTES, 1
                socket.setsockopt(zmq.XPUB_VERBOSER, 1)  # each subscription and unsubscription is told
                socket.setsockopt(zmq.RCVBUF, SUBSCRIBER_BYTES)  # what has arrived is read also after a cut
            else:
                limit_bytes, rcvhwm = self.max_message_bytes, HIGH_WATER
            apply_common_options(socket, max_message_bytes=limit_bytes, sndhwm=HIGH_WATER, rcvhwm=rcvhwm)
            socket.setsockopt(zmq.HEARTBEAT_IVL, 0)  # not every implementation answers ZMTP pings; TCP looks instead
            socket.setsockopt(zmq.TCP_KEEPALIVE, 1)
            socket.setsockopt(zmq.BACKLOG, BACKLOG)
        except BaseException:
            socket.close(linger=0)
            raise
        return socket

    def interest_changed(self) -> None:
        """A subscription came or went."""
        self.refresh()
        if self.on_interest is not None and self._telling is None:
            rest_s = max(0.0, self._told_s + INTEREST_S - self._loop.time())
            self._telling = self._loop.call_later(rest_s, self._tell)

    def _tell(self) -> None:
        self._telling = None
        self._told_s = self._loop.time()
        if self.on_interest is not None:
            self.on_interest()


class _Outlet(DrainedSocket):
    """The XPUB of a role: takes subscriptions, sends what the role may see. Raises ConfigError when its endpoint cannot
    be had."""

    def __init__(self, feed: Feed, role: FeedRole, socket: "zmq.Socket[bytes]") -> None:
        super().__init__(socket)
        self.role = role
        self.messages = 0
        self.counters = feed.counters_of(role.name)
        self._counted = (0, 0)
        self._feed = feed
        self.inflow = FeedInflow(role.name, self, socket, self._endless, on_gone=self._gone)
        self.subscriptions = Subscriptions(role.name, self.inflow.connections)
        self._wanted: dict[bytes, bool] = {}
        self.endpoint = _listening(self, role.publish_endpoint)

    def _endless(self) -> None:
        self.counters.endless += 1

    def count(self) -> None:
        """Book which connections were cut since the last time."""
        capped, crowded = self._counted
        self._counted = self.inflow.capped, self.subscriptions.crowded
        self.counters.capped += self.inflow.capped - capped
        self.counters.crowded += self.subscriptions.crowded - crowded

    def close(self) -> None:
        self.count()
        self.inflow.close()
        super().close()

    def wants(self, frame: bytes, name: TopicName) -> bool:
        wanted = self._wanted.get(frame)
        if wanted is None:
            wanted = self.subscriptions.match(frame) and self.role.may_see(name)
            if len(self._wanted) >= _MAX_VERDICTS:
                self._wanted.clear()
            self._wanted[frame] = wanted
        return wanted

    def send_message(self, frame: bytes, header: bytes, body: bytes) -> None:
        """XPUB never blocks: what a slow subscriber cannot take is dropped for it alone."""
        send = self.raw_send
        send(frame, _NOBLOCK_MORE)
        send(header, _NOBLOCK_MORE)
        send(body, _NOBLOCK, len(body) < ZERO_COPY_BYTES)
        self.counters.sent += 1
        self.kick()

    def _received(self) -> int:
        return self.messages

    def _take(self, count: int) -> bool:
        """Frame by frame: libzmq takes every frame that begins as a subscription for one, whatever frames it is
        among."""
        recv = self.socket.recv
        for _ in range(count):
            frame = recv(_NOBLOCK, copy=False)
            self.messages += 1
            message = frame.bytes
            if message[:1] == b"\1":
                self._subscribed(message[1:], _origin(frame))
            elif message[:1] == b"\0":
                self._unsubscribed(message[1:], _origin(frame))
        return True

    def _subscribed(self, prefix: bytes, fd: int | None) -> None:
        if self.subscriptions.subscribed(prefix, fd):
            self._changed()

    def _unsubscribed(self, prefix: bytes, fd: int | None) -> None:
        if self.subscriptions.unsubscribed(prefix, fd):
            self._changed()

    def _gone(self, fd: int) -> None:
        if self.subscriptions.gone(fd):
            self._changed()

    def _changed(self) -> None:
        self._wanted.clear()
        self._feed.interest_changed()

    def forget(self) -> None:
        """Judge every topic anew: the role has changed."""
        self._wanted.clear()


class _Inlet(DrainedSocket):
    """The XSUB of a role: takes messages in, hands them to the role outlets and to the relay.

    Framing: `more` is read from the last frame of three alone, as it costs a third of the whole (a Frame object for
    each). Short messages therefore run together, until a frame at a third place has more behind it: then the last
    three frames up to the boundary are the message. So a well-formed message is never lost to a malformed one before
    it, and what malformed ones make together is checked like any other: their senders could have sent just that.
    """

    def __init__(self, feed: Feed, role: FeedRole, socket: "zmq.Socket[bytes]", endpoint: str) -> None:
        super().__init__(socket)
        self.role = role
        self.verdicts: dict[bytes, _Verdict] = {}
        self.counters = feed.counters_of(role.name)
        self._counted = 0
        self._feed = feed
        self._guard = _guard_of(role, feed.clock())
        self.messages = 0
        self.inflow = FeedInflow(role.name, self, socket, self._endless, max_message_bytes=feed.max_message_bytes)
        socket.send(b"\1")  # everything: what the role may publish is decided here, by pattern and not by prefix
        self.endpoint = _listening(self, endpoint)

    def _endless(self) -> None:
        self.counters.endless += 1

    def count(self) -> None:
        """Book which connections were cut since the last time."""
        before, self._counted = self._counted, self.inflow.capped
        self.counters.capped += self._counted - before

    def close(self) -> None:
        self.count()
        self.inflow.close()
        super().close()

    def adopt(self, role: FeedRole) -> None:
        """Go by this role from now on; other limits than before begin with full buckets."""
        before, self.role = self.role, role
        if (before.max_rate_hz, before.max_bytes_per_s) != (role.max_rate_hz, role.max_bytes_per_s):
            self._guard = _guard_of(role, self._feed.clock())

    def _received(self) -> int:
        return self.counters.received

    def _take(self, count: int) -> bool:
        recv = self.socket.recv
        verdicts = self.verdicts
        counters = self.counters
        on_publish = self._feed.on_publish
        guard = self._guard
        received = received_bytes = begun = 0
        topic = b""
        inflow = self.inflow
        used: set[_Outlet] = set()
        try:
            for begun in range(count):  # noqa: B007  (told below, where the last one ended early, too)
                topic = b""
                topic = recv(_NOBLOCK)
                header = recv(_NOBLOCK)
                body = recv(_NOBLOCK, copy=False)
                if inflow.watching or len(body) >= TOLD_BYTES:
                    inflow.came(int(body.get(zmq.SRCFD)))
                if body.more:
                    aligned = self._realign(topic, header, body)
                    if self.skipping:
                        return True
                    if aligned is None:
                        continue
                    topic, header, body = aligned
                verdict = verdicts.get(topic) or self._judge(topic)
                if len(header) != HEADER.size or header[:4] not in verdict.openings:
                    header = self._second_look(verdict, header)
                    if not header:
                        continue
                if guard is not None and not guard.admit(len(body), now=self._feed.clock()):
                    counters.limited += 1
                    continue
                received += 1
                received_bytes += len(body)
                for outlet in verdict.outlets:
                    send = outlet.raw_send
                    send(topic, _NOBLOCK_MORE)
                    send(header, _NOBLOCK_MORE)
                    send(body, _NOBLOCK, False)
                    outlet.counters.sent += 1
                    used.add(outlet)
                if on_publish is not None and verdict.name is not None:
                    parsed = FeedHeader.parse(header)
                    if parsed is not None:
                        on_publish(self.role, verdict.name, parsed, body.bytes)
        except zmq.Again:
            if topic:
                counters.malformed += 1  # the frames ended before the third, and nothing came after them
            raise
        finally:
            self.messages += begun
            counters.received += received
            counters.received_bytes += received_bytes
            for outlet in used:
                outlet.kick()
        return True

    def _realign(self, topic: bytes, header: bytes, body: zmq.Frame) -> tuple[bytes, bytes, zmq.Frame] | None:
        """Read up to the boundary; the last three frames are the message, if it was not too long for one."""
        tail: deque[bytes | zmq.Frame] = deque((topic, header, body), maxlen=3)
        frame = body
        extra = 0
        while frame.more:
            if extra == MAX_FRAMES:
                self.counters.malformed += 1
                self.skip_rest(frame)
                return None
            frame = self.socket.recv(_NOBLOCK, copy=False)
            tail.append(frame)
            extra += 1
        self.counters.malformed += 1
        first, second, _ = tail
        return _bytes_of(first), _bytes_of(second), frame

    def _judge(self, topic: bytes) -> "_Verdict":
        """What holds for this topic frame; remembered until interest, roles or ownership change."""
        name = parse_topic(topic)
        if name is None:
            return _MALFORMED
        feed = self._feed
        openings: frozenset[bytes] = frozenset()
        outlets: tuple[_Outlet, ...] = ()
        if feed.accept is None or feed.accept(self.role, name):
            openings = frozenset(_opening(priority) for priority in CLASSES if self.role.may_publish(name, priority))
        if openings:
            outlets = tuple(outlet for outlet in feed.outlets if outlet.wants(topic, name))
        verdict = _Verdict(name, openings, outlets)
        if len(self.verdicts) >= _MAX_VERDICTS:
            self.verdicts.clear()
        self.verdicts[topic] = verdict
        return verdict

    def _second_look(self, verdict: "_Verdict", header: bytes) -> bytes:
        """A header to go on with for a message that is not plainly fine, empty when it is refused (and counted)."""
        if verdict.name is None or (header and FeedHeader.parse(header) is None):
            self.counters.malformed += 1
            return b""
        parsed = FeedHeader.parse(header) if header else FeedHeader(PriorityClass.BULK, 0, self._feed.wall_ns())
        if parsed is None or _opening(parsed.priority) not in verdict.openings:
            self.counters.forbidden += 1
            return b""
        return parsed.pack()


def _listening(socket: "_Outlet | _Inlet", endpoint: str) -> str:
    """Bind, and return the endpoint as bound. The monitor is there by then: a connection that it missed would be taken
    for one that has ended. Raises ConfigError, with the socket closed."""
    try:
        return bind_all(socket.socket, [endpoint])[0]
    except BaseException:
        socket.close()
        raise


def _release(sockets: "Sequence[_Outlet | _Inlet]") -> None:
    """Close sockets whose addresses others may take next. libzmq lets go of an address on its own thread: until then it
    is in use, and the file of an ipc address would be taken away from whoever has it by then."""
    for each in sockets:
        each.socket.unbind(each.endpoint)
    until_s = now() + RELEASE_S
    for each in sockets:
        if not each.endpoint.startswith("inproc://") and not each.inflow.connections.await_unbound(until_s):
            _log.warning("%s of feed role %s is not given up yet", each.endpoint, each.role.name)
        each.close()


def _guard_of(role: FeedRole, now: float) -> RateGuard | None:
    """What keeps a role to its limits; None: it has none, and pays nothing for them."""
    if role.max_rate_hz is None and role.max_bytes_per_s is None:
        return None
    return RateGuard(max_bytes_per_s=role.max_bytes_per_s, max_rate_hz=role.max_rate_hz, now=now)


class _Verdict(NamedTuple):
    """What holds for one topic frame that came in through one role."""

    name: TopicName | None  # None: malformed
    openings: frozenset[bytes]  # how a header may begin: the classes it may be published in; none: forbidden
    outlets: tuple[_Outlet, ...]  # whose subscribers want it and may see it


_MALFORMED: Final = _Verdict(None, frozenset(), ())


def _opening(priority: PriorityClass) -> bytes:
    """The first four bytes of every header of a class."""
    return bytes((VERSION, priority, 0, 0))


def _origin(frame: zmq.Frame) -> int | None:
    """The descriptor of the connection that a frame came over, None where there is none."""
    try:
        return int(frame.get(zmq.SRCFD))
    except zmq.ZMQError:
        return None


def _bytes_of(frame: "bytes | zmq.Frame") -> bytes:
    return frame if isinstance(frame, bytes) else frame.bytes
