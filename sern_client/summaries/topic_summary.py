"""One summary of one topic: what is worked on, what waits for it, and what goes.

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
from typing import Final, NamedTuple

from sern_core.site.client import ClientCore
from sern_core.site.fit import Fit
from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.patches import PatchMaker
from sern_core.summaries.spec import (
    SummaryLevel,
    SummaryProfile,
    SummarySpec,
)
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import DropReason, TopicName
from sern_runtime import clock
from sern_runtime.loop import Timer
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
                self.fit.sent(self.source.next_seq, len(job.body))
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
