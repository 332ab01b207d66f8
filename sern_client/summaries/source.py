"""What stands between a local topic and its streams: the level at which each message goes, and the rate cap."""

import logging
from typing import Protocol

from sern_client.summaries.topic_summary import Send, TopicSummary
from sern_core.site.client import ClientCore
from sern_core.site.fit import Fit
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.rate_cap import RateCap
from sern_core.summaries.spec import (
    SummaryLevel,
)
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import DropReason
from sern_runtime import clock
from sern_runtime.loop import Timer

_log = logging.getLogger(__name__)


class Source(Protocol):
    """What stands between a local topic and its streams."""

    def sink(self, body: bytes, stamp_ns: int) -> bool: ...

    @property
    def streams(self) -> set[StreamId]:
        """Those that messages made here go to; the same from its beginning to its end."""
        ...

    @property
    def wanted(self) -> bool: ...

    @property
    def pending(self) -> int:
        """Messages that have come and are not offered to the link yet."""
        ...

    def audience_changed(self) -> None: ...

    def lost(self, stream: StreamId) -> None: ...

    @property
    def own(self) -> tuple[OutChannel, ...]:
        """The streams it has beside the topic's, which are withdrawn with that."""
        ...

    def close(self) -> None:
        """Give up what waits; offer no more. The streams stay."""


def streams_of(channel: OutChannel, source: Source | None) -> tuple[OutChannel, ...]:
    """All streams of a local topic: those of its source's own, then the topic's."""
    return (channel,) if source is None else (*source.own, channel)


class SummarisedTopic:
    """A local topic with its summaries; a `Source`."""

    def __init__(
        self, core: ClientCore, channel: OutChannel, raw: Send, outputs: list[TopicSummary], cap: RateCap
    ) -> None:
        self.outputs = outputs
        self.fit = Fit(channel) if any(output.by_link for output in outputs) else None
        for output in outputs:
            output.fit = self.fit
        self._core = core
        self._channel = channel
        self._raw = raw
        self._cap = cap
        self._newest: tuple[bytes, int, float] | None = None  # held back by the cap: body, stamp, when it came
        self._timer: Timer | None = None

    @property
    def sends_raw(self) -> bool:
        """Whether messages go out as they come, beside their summaries or instead."""
        if any(output.shares_topic for output in self.outputs):
            return False
        return all(o.level is SummaryLevel.RAW for o in self.outputs) or any(o.beside for o in self.outputs)

    def _level(self, fit: Fit, now: float) -> SummaryLevel:
        """What the message that comes now is sent as, by what the link carries and who is there to take it."""
        source = self._channel
        shared = any(output.shares_topic for output in self.outputs)
        if not shared and not any(output.channel.wanted for output in self.outputs):
            return SummaryLevel.RAW
        if not shared and source.wanted is False:
            return SummaryLevel.SUMMARY
        before = fit.level
        level = fit.choose(now, self._core.link.lane.estimator.rate_bps)
        if fit.level is not before:
            for output in self.outputs:
                output.set_level(fit.level)
            self._core.level_changed(source, fit.level, now=now)
            self._say(fit.level)
        return level

    def _say(self, level: SummaryLevel) -> None:
        topic, lifespan_s = self.outputs[0].topic, self._channel.spec.lifespan_s or 0.0
        if level is SummaryLevel.SUMMARY:
            kinds = " and ".join(str(output.kind) for output in self.outputs)
            _log.warning("%s: the link is too slow for a message to arrive within %g s; its %s goes instead", topic,
                         lifespan_s, kinds)  # fmt: skip
        else:
            _log.warning(
                "%s: the link carries whole messages within %g s again; they go as they come", topic, lifespan_s
            )

    def sink(self, body: bytes, stamp_ns: int) -> bool:
        """A `Sink`. False: what counts most was refused, the topic itself or its only summary."""
        now = clock.now()
        if self._newest is not None:
            self._drop_newest(DropReason.RATE_CAP)
        if self._cap.allows(now):
            return self._pass(body, stamp_ns, now)
        self._newest = (body, stamp_ns, now)  # the last of a series goes when its time comes
        if self._timer is None:
            self._timer = Timer(self._due)
        self._timer.arm(self._cap.next_s)
        return True

    def _due(self) -> None:
        if self._newest is not None and self._cap.allows(clock.now()):
            newest, self._newest = self._newest, None
            self._pass(*newest)

    def _pass(self, body: bytes, stamp_ns: int, born_s: float) -> bool:
        if self.fit is not None:
            return self._pass_by_link(self.fit, body, stamp_ns, born_s)
        raw = self.sends_raw
        if raw and not self._raw(body, stamp_ns, born_s):
            return False
        accepted = [output.offer(body, stamp_ns, born_s) for output in self.outputs]
        return raw or len(accepted) > 1 or accepted[0]

    def _pass_by_link(self, fit: Fit, body: bytes, stamp_ns: int, born_s: float) -> bool:
        """Send a message as `_pass` does, at the level that the link allows."""
        level = self._level(fit, clock.now())
        if level is SummaryLevel.RAW and not any(output.shares_topic for output in self.outputs):
            fit.sent(self._channel.next_seq, len(body))
            return self._raw(body, stamp_ns, born_s)
        accepted = [output.offer(body, stamp_ns, born_s, level) for output in self.outputs]
        return len(accepted) > 1 or accepted[0]

    def _drop_newest(self, reason: DropReason) -> None:
        newest, self._newest = self._newest, None
        if newest is not None:
            self._core.drop(self._channel, len(newest[0]), reason, now=clock.now())

    @property
    def streams(self) -> set[StreamId]:
        return {stream for output in self.outputs for stream in output.streams}

    @property
    def wanted(self) -> bool:
        return bool(self._channel.wanted) or any(output.wanted for output in self.outputs)

    @property
    def pending(self) -> int:
        return (self._newest is not None) + sum(output.pending for output in self.outputs)

    def audience_changed(self) -> None:
        for output in self.outputs:
            output.audience_changed()

    def lost(self, stream: StreamId) -> None:
        for output in self.outputs:
            if stream in output.streams:
                output.lost()

    @property
    def own(self) -> tuple[OutChannel, ...]:
        return tuple(output.channel for output in self.outputs if output.channel is not self._channel)

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._drop_newest(DropReason.SHUTDOWN)
        for output in self.outputs:
            output.close()
