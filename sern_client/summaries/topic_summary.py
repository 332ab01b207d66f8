"""Sends summaries in place of heavy messages, or beside them.

A summary is a stream of its own, announced with the attributes `summary` (its kind) and `summary_of` (the topic). Two
kinds take the topic itself: a voxel-thinned cloud `in_place`, and patches, whose whole grids go out under the topic's
name. Every one has a level, `raw` or `summary`, that may be switched at any time: each message is sent once, as the
level was when it came, and the messages of a stream keep their order. With `level: auto` what the link carries
switches it (`Fit`).

Bodies above INLINE_BYTES are worked on in a thread, one after the other. While one is, the newest that comes waits and
those it replaces are counted as `superseded`; of a reliable stream they are refused to the source instead. A patch is
made only when the one before it has left the queue, so that a slow link gets fewer, larger ones and never a backlog.

A body that cannot be read is dropped (`undecodable`) if it is a cloud, and sent as it is if it is a grid or carries
transforms: those are small, and somebody else may be able to read them. The first of each topic is logged.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final, NamedTuple, Protocol

from sern_core.site.client import ClientCore
from sern_core.site.fit import Fit
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.rate_cap import RateCap
from sern_core.summaries.grids import UPDATE_TYPE
from sern_core.summaries.mask import MaskMaker, MaskParams
from sern_core.summaries.patches import PatchMaker, PatchParams
from sern_core.summaries.scan import ScanMaker, ScanParams
from sern_core.summaries.spec import (
    BEST_EFFORT_KEYFRAME_S,
    STAND_IN,
    SummaryKind,
    SummaryLevel,
    SummaryProfile,
    SummarySpec,
    VoxelParams,
)
from sern_core.summaries.voxel import thin_cloud
from sern_core.topics.rules import AUTO, ResolvedTopic, TopicRule
from sern_core.vocabulary.errors import BodyError, UsageError
from sern_core.vocabulary.message import KAPPA, StreamId, TopicInfo, TopicSpec
from sern_core.vocabulary.types import DropReason, Durability, Encoding, PriorityClass, Reliability, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.loop import Timer
from sern_runtime.metrics import Labels, Metrics
from sern_runtime.optional import OptionalParts

PART: Final = "summaries"
INLINE_BYTES: Final = 64 * 2**10
"""Smaller bodies are worked on where they come in: it takes less than a millisecond."""
MAX_WAITING: Final = 64
"""Raw messages that wait behind one that is being worked on, so that they do not overtake it."""
POLL_S: Final = 0.02
"""How often it is looked whether the message before has left the queue."""
RETRY_S: Final = 0.2
"""How long a message waits that a full reliable queue has refused."""
PROBE_EVERY: Final = 50
"""At level raw one message in so many is summarised all the same, to keep the profile true."""
_SMOOTHING: Final = 0.2
_RATE_WINDOW: Final = 20

_log = logging.getLogger(__name__)

Send = Callable[[bytes, int, float], bool]
"""`send(body, stamp_ns, born_s) -> accepted` into one stream."""


class Job(NamedTuple):
    body: bytes
    stamp_ns: int
    born_s: float
    level: SummaryLevel
    probe: bool = False  # only to measure; nothing is sent


class Result(NamedTuple):
    """What a job came to: bodies by the index of their stream, or what is wrong with the one that came."""

    bodies: tuple[tuple[int, bytes], ...]
    cpu_s: float
    problem: str = ""


Work = Callable[[Job], tuple[tuple[int, bytes], ...]]
"""The work itself: runs in a thread, one job at a time. Raises BodyError."""


class TopicSummary:
    """One summary of one topic. `level` and `profile` are for whoever adapts to the link; `set_level` switches."""

    def __init__(
        self,
        topic: TopicName,
        spec: SummarySpec,
        channels: tuple[OutChannel, ...],
        sends: tuple[Send, ...],
        work: Work,
        *,
        core: ClientCore,
        executor: ThreadPoolExecutor,
        source: OutChannel,
        maker: PatchMaker | None = None,
        parts: OptionalParts | None = None,
    ) -> None:
        """`channels` and `sends` are the streams that `work` names by index; the last one is the summary's own.
        `source` is that of raw messages."""
        self.topic = topic
        """The topic's local name."""
        self.kind = spec.kind
        self.level = self.level_by_rule = spec.level
        self.adapt = spec.adapt
        """Whether the adaptation may choose the level."""
        self.fit: Fit | None = None
        """What chooses the level of the topic, where the link does."""
        self.source = source
        self.profile = SummaryProfile()
        self.undecodable = 0
        self.bytes_in = 0
        self.bytes_out = 0
        self.cpu_s = 0.0
        self.by_link = spec.by_link
        """Whether the level is what the link carries."""
        self.beside = spec.beside
        self.shares_topic = spec.shares_topic
        self._parts = parts or OptionalParts(PART)
        self._channels = channels
        self._sends = sends
        self._work = work
        self._core = core
        self._executor = executor
        self._maker = maker
        self._waiting: deque[Job] = deque()
        self._running: asyncio.Future[Result] | None = None
        self._arrivals_s: deque[float] = deque(maxlen=_RATE_WINDOW)
        self._timer = Timer(self._go_on)
        self._last_stamp_ns = 0
        self._offers = 0
        self._closed = False

    @property
    def failures(self) -> int:
        """Faults of ours, of all topics."""
        return self._parts.failures.get(PART, 0)

    @property
    def stream(self) -> TopicName:
        """The global name under which the summary is published; of patches, that of the updates."""
        return self.channel.stream.id.topic

    @property
    def channel(self) -> OutChannel:
        return self._channels[-1]

    @property
    def streams(self) -> set[StreamId]:
        return {channel.stream.id for channel in self._channels}

    @property
    def wanted(self) -> bool:
        return any(channel.wanted for channel in self._channels)

    @property
    def pending(self) -> int:
        """Messages that wait or are being worked on."""
        return len(self._waiting) + (self._running is not None)

    def set_level(self, level: SummaryLevel) -> None:
        """Change the level from the next message on. What is under way goes out first."""
        self.level = level

    def audience_changed(self) -> None:
        """Somebody has come who may have nothing: of patches the next grid goes whole."""
        if self._maker is not None and not self._channels[0].spec.latched:
            self._maker.forget()

    def lost(self) -> None:
        """A message of ours was dropped on its way: of patches the next grid goes whole."""
        if self._maker is not None:
            self._maker.forget()

    # --- entry ------------------------------------------------------------------------------------------------------

    def offer(self, body: bytes, stamp_ns: int, now: float, level: SummaryLevel | None = None) -> bool:
        """A raw message has come; it is sent as `level` says, or else as the one in force. False: refused."""
        self._arrivals_s.append(now)
        self._offers += 1
        job = Job(body, stamp_ns, now, level or self.level)
        if job.level is SummaryLevel.RAW and self.fit is not None:
            return not self.shares_topic or self._take(job)
        if job.level is SummaryLevel.RAW:
            # To be weighed against the raw messages a summary must have been seen.
            unknown = self.adapt and not self.profile.messages and not self.undecodable
            if (unknown or self._offers % PROBE_EVERY == 0) and self._maker is None:
                self._take(job._replace(level=SummaryLevel.SUMMARY, probe=True))
            return not self.shares_topic or self._take(job)
        if self.channel.wanted is False and not self.channel.spec.latched:
            self._drop(job, DropReason.UNWANTED)
            return True
        return self._take(job)

    def _take(self, job: Job) -> bool:
        if self._running is None and not self._waiting and self._may_start():
            return self._start(job)
        if job.probe:
            return True  # there is work enough to measure
        last = self._waiting[-1] if self._waiting else None
        gated = self._maker is not None
        if last is not None and (gated or job.level is last.level is SummaryLevel.SUMMARY):
            if self.channel.spec.reliable and not gated:
                return False
            self._drop(self._waiting.pop(), DropReason.SUPERSEDED)
        elif len(self._waiting) >= MAX_WAITING:
            if self.channel.spec.reliable:
                return False
            self._drop(self._waiting.popleft(), DropReason.SUPERSEDED)
        self._waiting.append(job)
        if self._running is None and self._timer.deadline_s is None:
            self._timer.arm(clock.now() + POLL_S)
        return True

    def _may_start(self) -> bool:
        """Patches go one at a time, so that what waits for the link can still become one patch."""
        return self._maker is None or not any(channel.queue for channel in self._channels)

    def _drop(self, job: Job, reason: DropReason) -> None:
        """A grid that is given up is counted with the whole grids, a cloud with what would have been made of it."""
        self._core.drop(self._channels[0], len(job.body), reason, now=clock.now())

    # --- work -------------------------------------------------------------------------------------------------------

    def _run(self, job: Job) -> Result:
        begun_s = time.thread_time()
        try:
            bodies = self._work(job)
        except BodyError as error:
            return Result((), time.thread_time() - begun_s, str(error))
        except Exception as error:  # noqa: BLE001  (a fault of ours: counted, and the message is treated as unreadable)
            self._parts.failed(PART, error)
            return Result((), time.thread_time() - begun_s, f"its maker has failed ({type(error).__name__})")
        return Result(bodies, time.thread_time() - begun_s)

    def _start(self, job: Job) -> bool:
        if self._maker is None and job.level is SummaryLevel.RAW:
            if self.fit is not None:
                self.fit.sent(self.source.next_seq)
            return self._sends[0](job.body, job.stamp_ns, job.born_s)
        if len(job.body) <= INLINE_BYTES:
            return self._finish(job, self._run(job))
        try:
            self._running = asyncio.get_running_loop().run_in_executor(self._executor, self._run, job)
        except RuntimeError as error:  # its thread is dead, or there is no room for one
            self._parts.failed(PART, error)
            return self._finish(job, self._run(job))
        self._running.add_done_callback(lambda future: self._done(job, future))
        return True

    def _done(self, job: Job, future: asyncio.Future[Result]) -> None:
        self._running = None
        if self._closed or future.cancelled():
            return
        try:
            if not self._finish(job, future.result()):
                self._hold(job)
        finally:
            self._go_on()

    def _hold(self, job: Job) -> None:
        """The reliable queue is full: try this one again in a while."""
        self._waiting.appendleft(job)
        self._timer.arm(clock.now() + RETRY_S)

    def _go_on(self) -> None:
        """Start what waits, as far as it may start; the timer looks again."""
        while self._waiting and self._running is None and self._timer.deadline_s is None and not self._closed:
            if not self._may_start():
                self._timer.arm(clock.now() + POLL_S)
            elif not self._start(job := self._waiting.popleft()):
                self._hold(job)

    def _finish(self, job: Job, result: Result) -> bool:
        """Send what a job came to. False: refused."""
        if result.problem:
            return self._unreadable(job, result.problem)
        if job.level is SummaryLevel.SUMMARY:
            self._measure(job, result)
        if job.probe:
            return True
        # All messages of one change have one stamp, which no other change has.
        stamp_ns = self._last_stamp_ns = max(job.stamp_ns, self._last_stamp_ns + 1) if self._maker else job.stamp_ns
        accepted = True
        for index, body in result.bodies:
            accepted &= self._sends[index](body, stamp_ns, job.born_s)
        if not accepted and self._maker is not None:
            self._maker.forget()
            if not self._waiting:
                self._hold(job)  # nothing says that another one comes
            return True
        return accepted

    def _unreadable(self, job: Job, problem: str) -> bool:
        self.undecodable += 1
        passed = self._maker is not None
        if self.undecodable == 1:
            fate = "sent as they are" if passed else "dropped"
            _log.warning("%s: no %s can be made of it, such messages are %s: %s", self.topic, self.kind, fate, problem)
        if passed:
            return self._sends[0](job.body, job.stamp_ns, job.born_s)
        if not job.probe:
            self._drop(job, DropReason.UNDECODABLE)
        return True

    def _measure(self, job: Job, result: Result) -> None:
        old, size = self.profile, len(job.body)
        made = sum(len(body) for _, body in result.bodies)
        self.bytes_in += size
        self.bytes_out += made
        self.cpu_s += result.cpu_s
        ratio = made / max(size, 1)
        part = _SMOOTHING if old.messages else 1.0
        span_s = self._arrivals_s[-1] - self._arrivals_s[0] if len(self._arrivals_s) > 1 else 0.0
        self.profile = SummaryProfile(
            messages=old.messages + 1,
            rate_hz=(len(self._arrivals_s) - 1) / span_s if span_s > 0 else 0.0,
            raw_bytes=old.raw_bytes + part * (size - old.raw_bytes),
            bytes_ratio=old.bytes_ratio + part * (ratio - old.bytes_ratio),
            seconds_per_message=old.seconds_per_message + part * (result.cpu_s - old.seconds_per_message),
        )

    def close(self) -> None:
        """Give up what waits. What is being worked on comes to nothing."""
        if self._closed:
            return
        self._closed = True
        self._timer.cancel()
        if self._running is not None:
            self._running.cancel()
        while self._waiting:
            self._drop(self._waiting.popleft(), DropReason.SHUTDOWN)


def work_of(spec: SummarySpec, encoding: Encoding, maker: PatchMaker | None) -> Work:
    """What makes summaries of one topic's messages; `maker` is that of patches."""
    make: Callable[[bytes], bytes]
    match params := spec.params:
        case PatchParams():
            return patch_work(maker or PatchMaker(params, encoding))
        case VoxelParams():

            def make(body: bytes) -> bytes:
                return thin_cloud(body, encoding, params.voxel_m, point=params.point, fields=params.fields)

        case ScanParams():
            scanner = ScanMaker(params)

            def make(body: bytes) -> bytes:
                return scanner.scan(body, encoding)

        case MaskParams():
            masker = MaskMaker(params)

            def make(body: bytes) -> bytes:
                return masker.mask(body, encoding)

    return lambda job: ((0, make(job.body)),)


def patch_work(maker: PatchMaker) -> Work:
    """Stream 0 has the whole grids, stream 1 the updates."""

    def work(job: Job) -> tuple[tuple[int, bytes], ...]:
        change = maker.change(job.body, whole=job.level is SummaryLevel.RAW, now=job.born_s)
        updates = tuple((1, update) for update in change.updates)
        return updates if change.whole is None else ((0, change.whole), *updates)

    return work


def summary_spec(spec: TopicSpec, summary: SummarySpec) -> TopicSpec:
    """How the stream of a summary is treated: as its topic, but for its class, and for the rate, which was capped."""
    priority = summary.priority
    if priority is None:
        obstacle = summary.kind in (SummaryKind.SCAN, SummaryKind.OCCUPANCY_MASK)
        priority = min(PriorityClass.STATE, spec.priority) if obstacle else spec.priority
    weight = spec.weight if priority is spec.priority else KAPPA[priority]
    return replace(spec, priority=priority, weight=weight, max_rate_hz=None)


def patch_specs(spec: TopicSpec, params: PatchParams, rule: TopicRule) -> tuple[TopicSpec, TopicSpec, PatchParams]:
    """How whole grids and updates are treated: reliable unless the rule says otherwise, and latched, so that a late
    joiner gets the last whole grid and all updates since."""
    reliable = rule.reliability is not Reliability.BEST_EFFORT
    whole = replace(
        spec,
        reliability=Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT,
        durability=rule.durability or Durability.TRANSIENT_LOCAL,
        depth=1,
        lifespan_s=None if rule.lifespan_s is AUTO else rule.lifespan_s,
        max_rate_hz=None,
    )
    if not reliable and params.keyframe_s is None:
        params = replace(params, keyframe_s=BEST_EFFORT_KEYFRAME_S)
    return whole, replace(whole, depth=params.keyframe_updates), params


def attributes_of(kind: SummaryKind, topic: str) -> dict[str, str]:
    """What tells a consumer that a stream is a summary, of which kind and of which (global) topic."""
    return {"summary": str(kind), "summary_of": topic}


def fits(info: TopicInfo, resolved: ResolvedTopic) -> tuple[SummarySpec, ...]:
    """The rule's summaries that can be made of this topic's type; the others are logged."""
    found = []
    for spec in resolved.summaries:
        if info.encoding is not Encoding.RAW and info.type_name == spec.kind.source_type:
            found.append(spec)
        else:
            _log.warning("%s is %s, of which no %s is made; it is sent as it is", info.name, info.type_name, spec.kind)
    return tuple(found)


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
            fit.sent(self._channel.next_seq)
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


class Summaries:
    """The summaries of one client, and the thread they are made in. `close` once."""

    def __init__(self, sender: Callable[[OutChannel, TopicInfo], Send], parts: OptionalParts | None = None) -> None:
        """`sender(channel, info)` makes what puts messages of the type `info` into a channel. What fails is counted in
        `parts`, under PART."""
        self._sender = sender
        self._parts = parts or OptionalParts(PART)
        self._topics: list[SummarisedTopic] = []
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="summary")

    @property
    def topics(self) -> list[TopicSummary]:
        """Every summary there is now, for whoever adapts to the link."""
        return [output for topic in self._topics for output in topic.outputs]

    def open(
        self, core: ClientCore, info: TopicInfo, resolved: ResolvedTopic, rule: TopicRule | None, name: TopicName
    ) -> tuple[OutChannel, SummarisedTopic] | None:
        """Offer a topic under its global `name`, and the summaries that its rule asks for. None: it has none.

        UsageError when the topic cannot be offered; a summary that cannot is logged and left out.
        """
        specs = fits(info, resolved)
        if not specs:
            return None
        now = clock.now()
        spec = replace(resolved.spec, max_rate_hz=None)
        updates = spec
        patches = next((item.params for item in specs if isinstance(item.params, PatchParams)), None)
        attributes = None
        if patches is not None and rule is not None:
            spec, updates, patches = patch_specs(resolved.spec, patches, rule)
            attributes = attributes_of(SummaryKind.PATCHES, name)
        elif specs[0].shares_topic and specs[0] is not STAND_IN:  # which the topic seldom is
            attributes = attributes_of(specs[0].kind, name)
        info = replace(info, latched=spec.latched)
        channel = core.publish(replace(info, name=name), spec, attributes=attributes, now=now)
        raw = self._sender(channel, info)
        outputs: list[TopicSummary] = []
        for item in specs:
            own_spec = summary_spec(spec, item) if patches is None else updates
            own_info = self._info(info, item, TopicName(item.topic(name)), own_spec)
            own, send = channel, raw
            if own_info.name != name:
                try:
                    own = core.publish(own_info, own_spec, attributes=attributes_of(item.kind, name), now=now)
                except UsageError as error:
                    _log.error("%s: its %s cannot be offered as %s: %s", info.name, item.kind, own_info.name, error)
                    continue
                send = self._sender(own, own_info)
            maker = None if patches is None else PatchMaker(patches, info.encoding)
            outputs.append(
                TopicSummary(
                    info.name,
                    item,
                    (own,) if maker is None else (channel, own),
                    (send,) if maker is None else (raw, send),
                    work_of(item, info.encoding, maker),
                    core=core,
                    executor=self._executor,
                    source=channel,
                    maker=maker,
                    parts=self._parts,
                )
            )
        cap = RateCap(resolved.spec.max_rate_hz)
        topic = SummarisedTopic(core, channel, raw, outputs, cap)
        self._topics.append(topic)
        return channel, topic

    @staticmethod
    def _info(info: TopicInfo, item: SummarySpec, name: TopicName, spec: TopicSpec) -> TopicInfo:
        """What is said of a summary's stream."""
        if item.kind is SummaryKind.VOXEL:
            return replace(info, name=name)
        type_name = UPDATE_TYPE if item.kind is SummaryKind.PATCHES else item.kind.result_type
        return ros_types.topic_info(name, type_name, info.encoding, latched=spec.latched, reliable=info.reliable)

    def to_json(self, now: float) -> list[dict[str, object]]:
        """What /api/link says of them: what each topic is sent as, and for how long where the link has changed it."""
        return [
            {
                "topic": item.topic,
                "stream": item.stream,
                "kind": str(item.kind),
                "level": str(item.level),
                "by_link": item.by_link,
                "switches": 0 if item.fit is None else item.fit.switches,
                "since_s": None if item.fit is None or item.fit.changed_s is None else now - item.fit.changed_s,
            }
            for item in self.topics
        ]

    def forget(self, topic: Source) -> None:
        """The topic is gone and closed."""
        self._topics = [known for known in self._topics if known is not topic]

    def close(self) -> None:
        """What is being worked on comes to nothing; waits for it to end, which takes milliseconds."""
        self._topics.clear()
        self._executor.shutdown(wait=True, cancel_futures=True)


def register_summaries(metrics: Metrics, summaries: Summaries) -> None:
    """What the summaries of a client cost and save, by topic (local name) and kind."""

    def per_topic(read: Callable[[TopicSummary], float]) -> Callable[[], list[tuple[Labels, float]]]:
        return lambda: [((item.topic, str(item.kind)), read(item)) for item in summaries.topics]

    labels = ("topic", "kind")
    counters: tuple[tuple[str, str, Callable[[TopicSummary], float]], ...] = (
        ("messages", "Messages of which a summary was made.", lambda item: item.profile.messages),
        ("raw_bytes", "Bytes of those messages.", lambda item: item.bytes_in),
        ("bytes", "Bytes of their summaries.", lambda item: item.bytes_out),
        ("cpu_seconds", "Processor time of making them.", lambda item: item.cpu_s),
        ("undecodable", "Messages of which none could be made.", lambda item: item.undecodable),
    )
    for name, text, read in counters:
        metrics.counter(f"sern_summary_{name}_total", text, labels, per_topic(read))
    metrics.counter(
        "sern_summary_switches_total",
        "Times that what the link carries changed the level.",
        labels,
        per_topic(lambda item: 0.0 if item.fit is None else float(item.fit.switches)),
    )
    metrics.gauge(
        "sern_summary_level",
        "1 while summaries are sent, 0 while messages go as they come.",
        labels,
        per_topic(lambda item: float(item.level is SummaryLevel.SUMMARY)),
    )
