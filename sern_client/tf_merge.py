"""Merges transforms on their way out: /tf by pair of frames at a capped rate, /tf_static into one complete message.

A merged /tf waits here, not in the queue, until the message before it has left: what waits for the link stays the
newest of every pair, and nothing in it can be superseded together with the pairs that only it has.
"""

import logging
from typing import Final

from sern_client.summaries.topic_summary import POLL_S, Send
from sern_core.site.client import ClientCore
from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.transforms import StaticTransforms, TransformMerger
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import clock
from sern_runtime.loop import Timer

DEFAULT_RATE_HZ: Final = 20.0
"""Merged messages a second where the rule has no `max_rate_hz`; tf2 interpolates between them."""

_log = logging.getLogger(__name__)


class _Transforms:
    """What both kinds share; a `Source` with no streams beside the topic's own."""

    def __init__(self, core: ClientCore, channel: OutChannel, send: Send, topic: TopicName) -> None:
        self.undecodable = 0
        self._core = core
        self._channel = channel
        self._send = send
        self._topic = topic

    def _unreadable(self, body: bytes, stamp_ns: int, problem: str, now: float) -> bool:
        """Somebody else may be able to read it: it goes as it is."""
        self.undecodable += 1
        if self.undecodable == 1:
            _log.warning("%s: not merged, such messages are sent as they are: %s", self._topic, problem)
        return self._send(body, stamp_ns, now)

    @property
    def streams(self) -> set[StreamId]:
        return {self._channel.stream.id}

    @property
    def wanted(self) -> bool:
        return bool(self._channel.wanted)

    @property
    def pending(self) -> int:
        return 0

    @property
    def own(self) -> tuple[OutChannel, ...]:
        return ()

    def audience_changed(self) -> None:
        """Nothing to do: what is latched is complete, and the rest is soon sent anew."""

    def lost(self, stream: StreamId) -> None:
        """Nothing to do: the next transform of the same pair replaces it."""

    def close(self) -> None:
        """Nothing waits."""


class MergedTransforms(_Transforms):
    """One /tf."""

    def __init__(
        self,
        core: ClientCore,
        channel: OutChannel,
        send: Send,
        topic: TopicName,
        encoding: Encoding,
        *,
        max_rate_hz: float | None = None,
    ) -> None:
        super().__init__(core, channel, send, topic)
        self.merger = TransformMerger(encoding)
        self._period_s = 1.0 / (max_rate_hz or DEFAULT_RATE_HZ)
        self._due_s = 0.0
        self._oldest_s = 0.0
        self._stamp_ns = 0
        self._timer = Timer(self._flush)

    @property
    def pending(self) -> int:
        return int(len(self.merger) > 0)

    def sink(self, body: bytes, stamp_ns: int) -> bool:
        """A `Sink`."""
        now = clock.now()
        if self._channel.wanted is False and not self._channel.spec.latched:
            self._core.drop(self._channel, len(body), DropReason.UNWANTED, now=now)
            return True
        try:
            self.merger.add(body, now=now)
        except BodyError as error:
            return self._unreadable(body, stamp_ns, str(error), now)
        self._stamp_ns = max(self._stamp_ns, stamp_ns)
        if self._timer.deadline_s is None and len(self.merger):
            self._timer.arm(max(now, self._due_s))
        return True

    def _flush(self) -> None:
        now = clock.now()
        if self._channel.queue:
            self._timer.arm(now + POLL_S)
            return
        body = self.merger.take(now=now, lifespan_s=self._channel.spec.lifespan_s)
        if body is not None:
            self._due_s = now + self._period_s
            self._send(body, self._stamp_ns, now)

    def close(self) -> None:
        """What waits is not sent any more."""
        self._timer.cancel()


class LatchedTransforms(_Transforms):
    """One /tf_static."""

    def __init__(self, core: ClientCore, channel: OutChannel, send: Send, topic: TopicName, encoding: Encoding) -> None:
        super().__init__(core, channel, send, topic)
        self.transforms = StaticTransforms(encoding)
        self._refused = False

    def sink(self, body: bytes, stamp_ns: int) -> bool:
        """A `Sink`. A message that says nothing new is counted as superseded."""
        now = clock.now()
        try:
            merged = self.transforms.add(body)
        except BodyError as error:
            return self._unreadable(body, stamp_ns, str(error), now)
        if merged is None:
            if not self._refused:
                self._core.drop(self._channel, len(body), DropReason.SUPERSEDED, now=now)
                return True
            merged = self.transforms.body()
        accepted = self._send(merged, stamp_ns, now)
        self._refused = not accepted
        return accepted
