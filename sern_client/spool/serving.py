"""Tells sites what is kept here, and sends them what they ask for, below all that is live (`sern_core.site.spool`)."""

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from sern_core.site.client import ClientCore
from sern_core.site.runs import Run
from sern_core.site.spool import FETCHED, MAX_REQUESTS, Request, decode_request, encode_report
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.spool_names import SpoolStream, fetched_name, kept_name
from sern_core.vocabulary.errors import ConfigError, UsageError, WireError
from sern_core.vocabulary.ledger import MAX_TOPICS
from sern_core.vocabulary.message import DURABLE_RETENTION_S, Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import Durability, Encoding, PriorityClass, Reliability, TopicName
from sern_runtime import clock
from sern_runtime.loop import Timer
from sern_runtime.spool.files import Kept, KeptStream
from sern_runtime.spool.keeper import SpoolKeeper
from sern_runtime.spool.store import Answer

REPORT_TYPE: Final = "sern/Kept"
REPORT_S: Final = 5.0
"""How often it is said at most what is kept of a topic."""
WINDOW_BYTES: Final = (256 * 2**10, 8 * 2**20)
"""Least and most that is sent to a site and not confirmed by it, of one topic."""
AHEAD_S: Final = 0.2
"""That is what the link carries in a round trip and so long, within these bounds."""
PUMP_S: Final = 0.02
MAX_ASKERS: Final = 256
"""Topics of sites that may be fetched, in all."""

_log = logging.getLogger(__name__)

_REPORT_SPEC: Final = TopicSpec(
    PriorityClass.BULK,
    reliability=Reliability.RELIABLE,
    durability=Durability.TRANSIENT_LOCAL,
    lifespan_s=None,
    background=True,
)
_FETCHED_SPEC: Final = TopicSpec(
    PriorityClass.BULK,
    reliability=Reliability.RELIABLE,
    depth=10_000,
    lifespan_s=None,
    retention_s=DURABLE_RETENTION_S,
    max_queue_bytes=64 * 2**20,
    background=True,
)


class _Offered:
    """A topic of which something is kept, and what was said of it."""

    __slots__ = ("channel", "said", "said_s")

    def __init__(self, channel: OutChannel) -> None:
        self.channel = channel
        self.said = b""
        self.said_s = 0.0


class _Asker:
    """A site that fetches a topic: what it asked for, and what is read and not sent yet."""

    __slots__ = ("channel", "parts", "reading", "ready", "requests", "rest", "stream")

    def __init__(self, stream: StreamId, parts: SpoolStream) -> None:
        self.stream = stream
        self.parts = parts
        self.channel: OutChannel | None = None
        self.requests: deque[Request] = deque()
        self.rest: tuple[Run, ...] = ()  # of the first request: what was not read yet
        self.ready: deque[Kept] = deque()  # of the first request
        self.reading = False


class SpoolServing:
    """`kick` is called when there is something to send."""

    def __init__(self, core: ClientCore, keeper: SpoolKeeper, kick: Callable[[], None]) -> None:
        self.sent = 0
        self.sent_bytes = 0
        """Messages and bytes that were sent to sites again."""
        self.refused = 0
        """Requests that were none, or too many."""
        self._core = core
        self._keeper = keeper
        self._kick = kick
        self._offered: dict[TopicName, _Offered] = {}
        self._askers: dict[StreamId, _Asker] = {}
        self._timer = Timer(self._pump)
        self._said_bad = False
        self._closed = False

    @property
    def askers(self) -> int:
        """Topics of sites that are being fetched."""
        return sum(bool(asker.requests) for asker in self._askers.values())

    # --- what is kept -----------------------------------------------------------------------------------------------

    def look(self) -> None:
        """Tell what is kept. Call about twice a second."""
        now = clock.now()
        for topic, spans in self._keeper.topics.items():
            offered = self._offered.get(topic) or self._offer(topic, now)
            if offered is None:
                continue
            report = encode_report(spans)
            fresh = offered.said_s and now - offered.said_s < REPORT_S
            if report == offered.said or fresh or offered.channel.retained:
                continue
            if self._core.send(offered.channel, report, 0, now=now):
                offered.said, offered.said_s = report, now
                self._kick()

    def _offer(self, topic: TopicName, now: float) -> _Offered | None:
        if len(self._offered) >= MAX_TOPICS:
            return None
        info = TopicInfo(kept_name(topic), REPORT_TYPE, Encoding.RAW, latched=True)
        try:
            channel = self._core.publish(info, _REPORT_SPEC, now=now)
        except UsageError as error:
            _log.error("what is kept of %s cannot be offered: %s", topic, error)
            return None
        made = self._offered[topic] = _Offered(channel)
        return made

    # --- what is asked ----------------------------------------------------------------------------------------------

    def stream_opened(self, stream: StreamInfo, parts: SpoolStream) -> None:
        """A site may ask. ConfigError where it is nothing for us."""
        if parts.topic not in self._keeper.topics or parts.site != stream.id.origin:
            raise ConfigError(f"{stream.id.topic} from {stream.id.origin} asks for nothing that is kept here")
        for identity, asker in list(self._askers.items()):
            if asker.parts == parts:  # the same site as a new process
                self._dismiss(identity)
        if len(self._askers) >= MAX_ASKERS:
            why = f"{stream.id.origin} cannot fetch {parts.topic}: {MAX_ASKERS} topics are fetched by sites already"
            self._refuse(why)
            raise ConfigError(why)
        self._askers[stream.id] = _Asker(stream.id, parts)

    def stream_closed(self, stream: StreamInfo) -> None:
        self._dismiss(stream.id)

    def _dismiss(self, identity: StreamId) -> None:
        asker = self._askers.pop(identity, None)
        if asker is not None and asker.channel is not None:
            self._core.unpublish(asker.channel, now=clock.now())
            self._kick()

    def message(self, stream: StreamInfo, message: Message) -> bool:
        """A request came. False: it is none of ours."""
        asker = self._askers.get(stream.id)
        if asker is None:
            return False
        try:
            request = decode_request(message.body)
        except WireError as error:
            self._refuse(f"a request of {stream.id.origin} is none: {error}")
            return True
        first = asker.requests[0] if asker.requests else None
        asker.requests = deque(other for other in asker.requests if other.number >= request.oldest)
        if first is not None and (not asker.requests or asker.requests[0] is not first):
            asker.rest = ()
            asker.ready.clear()
        if len(asker.requests) >= MAX_REQUESTS:
            self._refuse(f"{stream.id.origin} asks for more at once than is answered")
            return True
        asker.requests.append(request)
        if len(asker.requests) == 1:
            asker.rest = request.runs
        self._pump()
        return True

    def _refuse(self, why: str) -> None:
        self.refused += 1
        if not self._said_bad:
            self._said_bad = True
            _log.warning("%s", why)

    # --- what is sent -----------------------------------------------------------------------------------------------

    def _pump(self) -> None:
        """Send and read on, for each site in turn; again soon while there is something to do."""
        if self._closed:
            return
        window_bytes = self._window_bytes()
        for asker in list(self._askers.values()):
            self._serve(asker, window_bytes)
        if any(asker.requests for asker in self._askers.values()):
            self._timer.arm(clock.now() + PUMP_S)

    def _window_bytes(self) -> int:
        link = self._core.link.observe(now=clock.now())
        least, most = WINDOW_BYTES
        path_bytes = (link.rate_bps or 0.0) / 8 * (2 * link.srtt_s + AHEAD_S)
        return int(max(min(path_bytes, most / max(1, self.askers)), least))

    def _serve(self, asker: _Asker, window_bytes: int) -> None:
        while asker.requests and not asker.reading:
            while asker.ready:
                channel = self._channel(asker, asker.ready[0].stream)
                if channel is None or channel.retained_bytes >= window_bytes:
                    return
                kept = asker.ready.popleft()
                self._send(channel, FETCHED.pack(kept.stream.id.boot, kept.seq) + kept.body, kept.stamp_ns)
                self.sent += 1
                self.sent_bytes += len(kept.body)
            request = asker.requests[0]
            if asker.rest:
                self._read(asker, request, window_bytes)
                continue
            stream = self._keeper.streams.get(asker.parts.topic)
            channel = asker.channel or (None if stream is None else self._channel(asker, stream))
            if channel is None or not self._send(channel, FETCHED.pack(0, request.number), 0):
                return
            asker.requests.popleft()
            asker.rest = asker.requests[0].runs if asker.requests else ()

    def _read(self, asker: _Asker, request: Request, window_bytes: int) -> None:
        def answered(answer: Answer) -> None:
            asker.reading = False
            if not self._closed and asker.requests and asker.requests[0] is request:
                asker.ready.extend(answer.messages)
                asker.rest = answer.rest
            self._pump()

        asker.reading = True
        stamps_ns = request.from_ns, request.to_ns
        if not self._keeper.read(asker.parts.topic, request.boot, asker.rest, stamps_ns, window_bytes // 2, answered):
            asker.reading, asker.rest = False, ()

    def _send(self, channel: OutChannel, body: bytes, stamp_ns: int) -> bool:
        accepted = self._core.send(channel, body, stamp_ns, now=clock.now(), forced=True)
        self._kick()
        return accepted

    def _channel(self, asker: _Asker, stream: KeptStream) -> OutChannel | None:
        """The stream of what a site fetches, of the type that was kept; None: what goes before is another type, or it
        cannot be offered."""
        channel, info = asker.channel, replace(stream.info, name=fetched_name(asker.parts.topic, asker.parts.site))
        info = replace(info, latched=False, reliable=True)
        if channel is not None:
            if channel.stream.info == info:
                return channel
            if channel.retained:
                return None
            self._core.unpublish(channel, now=clock.now())
            asker.channel = None
        try:
            asker.channel = self._core.publish(info, _FETCHED_SPEC, now=clock.now())
        except UsageError as error:
            self._refuse(f"{info.name} cannot be offered: {error}")
            asker.requests.clear()
        return asker.channel

    def close(self) -> None:
        """Nothing more is sent. Idempotent."""
        self._closed = True
        self._timer.cancel()
