"""Keeps what a robot's topics are given, whether it is sent or not, under the seq that it has in the live stream.

What was not sent as it came (thinned by a rule, turned into a summary, refused by a full queue) gets a seq of its own
that the live stream leaves out. So a site sees by the numbers alone what it lacks.
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from sern_client.endpoints.base import Sink
from sern_client.frames import Rewrite
from sern_core.site.client import ClientCore
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.patterns import Pattern
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import TopicName
from sern_runtime import clock
from sern_runtime.spool.files import Kept, KeptStream

_log = logging.getLogger(__name__)

Put = Callable[[Kept], bool]


class _Refused(NamedTuple):
    """A message that the live stream did not take: its publisher may offer it again."""

    body: bytes
    stamp_ns: int


class Tap:
    """Stands before whatever is made of one topic's messages. `sent` is told what its live stream takes."""

    __slots__ = ("_channel", "_core", "_offered", "_put", "_refused", "_rewrite", "_seq", "_stream", "_taken")

    def __init__(self, core: ClientCore, channel: OutChannel, rewrite: Rewrite | None, put: Put) -> None:
        info = channel.stream.info
        self._core = core
        self._channel = channel
        self._rewrite = rewrite
        self._put = put
        self._stream = KeptStream(channel.stream.id, replace(info, reliable=channel.reliable))
        self._offered: bytes | None = None  # what is being offered now
        self._seq = 0  # under which number it was taken; 0: it was not
        self._taken = b""  # as it was taken, frame ids rewritten
        self._refused: _Refused | None = None

    def sink(self, inner: Sink) -> Sink:
        """What takes the topic's messages in place of `inner`."""

        def offer(body: bytes, stamp_ns: int) -> bool:
            refused, self._refused = self._refused, None
            if refused is not None and (refused.stamp_ns != stamp_ns or refused.body != body):
                self._keep(refused.body, refused.stamp_ns)  # it was not offered again
            self._offered, self._seq = body, 0
            try:
                accepted = inner(body, stamp_ns)
            finally:
                self._offered = None
            if self._seq:
                self._put(Kept(self._stream, self._seq, stamp_ns, self._taken))
            elif accepted:
                self._keep(body, stamp_ns)
            else:
                self._refused = _Refused(body, stamp_ns)
            self._taken = b""
            return accepted

        return offer

    def sent(self, seq: int, body: bytes, taken: bytes) -> None:
        """The live stream took `taken`, under this number; it was made of `body` by rewriting frame ids alone."""
        if body is self._offered:
            self._seq, self._taken = seq, taken

    def _keep(self, body: bytes, stamp_ns: int) -> None:
        """Keep what the live stream did not take as it is."""
        seq = self._channel.next_seq
        self._core.link.outgoing.skip(self._channel, seq + 1, now=clock.now())
        self._put(Kept(self._stream, seq, stamp_ns, body if self._rewrite is None else self._rewrite(body)))

    def close(self) -> None:
        """Nothing more comes."""
        refused, self._refused = self._refused, None
        if refused is not None:
            self._keep(refused.body, refused.stamp_ns)


class Taps:
    """The taps of a robot's topics. `topics`: local names of which everything is kept."""

    def __init__(self, core: ClientCore, topics: tuple[Pattern, ...], put: Put) -> None:
        self._core = core
        self._topics = topics
        self._put = put
        self._open: dict[StreamId, Tap] = {}

    def wants(self, name: TopicName) -> bool:
        """Whether a local topic is kept."""
        return any(pattern.fullmatch(name) for pattern in self._topics)

    def taken(self, stream: StreamId) -> bool:
        """Whether the topic of a live stream is kept."""
        return stream in self._open

    def open(self, channel: OutChannel, rewrite: Rewrite | None, sink: Sink) -> Sink:
        """What takes the messages of a topic that is kept; its channel's are given to `sink`."""
        tap = self._open[channel.stream.id] = Tap(self._core, channel, rewrite, self._put)
        return tap.sink(sink)

    def sent(self, stream: StreamId, seq: int, body: bytes, taken: bytes) -> None:
        """A live stream took a message."""
        tap = self._open.get(stream)
        if tap is not None:
            tap.sent(seq, body, taken)

    def close(self, stream: StreamId) -> None:
        """The topic has ended."""
        tap = self._open.pop(stream, None)
        if tap is not None:
            tap.close()
