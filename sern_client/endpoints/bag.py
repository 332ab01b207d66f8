"""Plays a recording as if it were a robot: ROS 1 `.bag`, rosbag2 directory, `.db3` or `.mcap`.

Bodies go out as they lie in the file; nothing is decoded. All reading happens on one worker thread, a batch ahead of
the event loop. The rosbags readers are used below `AnyReader`, because that refuses a whole file over one type whose
constants it spells differently (`0x0F`, `1e-3`), although nothing here needs the type parsed.

Playback time: message at bag time t of pass k is due at `base + (k * period + t - t_first) / rate`, always from the
same base, so there is no drift. A refused message with `on_refused="wait"` moves the base by the time it waited.
"""

import asyncio
import logging
import re
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, NamedTuple, TypeVar

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    MessageDefinitionFormat,
    QosDurability,
    QosReliability,
)
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from sern_client.endpoints.bag_faults import why
from sern_client.endpoints.base import Difference, Held, Publisher, Sink, TopicEvents
from sern_client.endpoints.clock import Clock, SystemClock
from sern_client.endpoints.common.held import HeldSubscription
from sern_client.endpoints.leftovers import ACTIVE
from sern_core.topics.patterns import PatternError, PatternSet
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.entry import end_tasks
from sern_runtime.ros_types import one_line

BATCH_MESSAGES: Final = 512
BATCH_BYTES: Final = 4 * 2**20
"""How much the worker reads ahead at a time; two batches are in memory."""
RUN_S: Final = 0.002
"""Longest run of the player without giving the event loop a turn."""
BACKOFF_S: Final = (0.001, 0.05)
"""First and longest pause before a refused message is offered again."""

_R = TypeVar("_R")
_LOG = logging.getLogger(__name__)
_NAMESPACE: Final = re.compile(r"/?[A-Za-z]\w*(/[A-Za-z]\w*)*/?", re.ASCII)


@dataclass(frozen=True, slots=True)
class BagOptions:
    """What to play and how.

    `rate` scales time; 0 plays as fast as messages are accepted. `namespaces` replays the bag once per name, under
    `/name`. `topics` are patterns of the bag's own topic names, None means all; what `deny` matches is left out. Play
    starts when every topic of `wait_for` (names as announced) is wanted at the far side, then `start_delay_s` later.
    """

    path: Path
    rate: float = 1.0
    loop: bool = False
    namespaces: tuple[str, ...] = ()
    topics: tuple[str, ...] | None = None
    deny: tuple[str, ...] = ()
    start_delay_s: float = 0.0
    wait_for: tuple[str, ...] = ()
    on_refused: Literal["wait", "drop"] = "wait"
    stamps: Literal["now", "bag"] = "now"


@dataclass(slots=True)
class BagCounters:
    """Messages by fate, per subscriber; `refused` counts offers that were answered with no."""

    accepted: int = 0
    refused: int = 0
    dropped: int = 0  # refused with on_refused="drop"
    unwanted: int = 0  # nobody had subscribed
    passes: int = 0  # complete passes over the file
    errors: int = 0


class _Batch(NamedTuple):
    messages: list[tuple[int, int, bytes]]  # connection id, bag time in ns, body
    end: bool
    problem: str | None


@dataclass(slots=True, eq=False)
class _Topic:
    info: TopicInfo
    subscriptions: list["_Subscription"] = field(default_factory=list)
    retained: dict[int, tuple[bytes, int]] = field(default_factory=dict)  # latched: last message per connection


_Subscription = HeldSubscription[_Topic]


class BagEndpoint:
    """An `Endpoint` that gives what a bag holds, and takes nothing."""

    def __init__(self, options: BagOptions, *, clock: Clock | None = None) -> None:
        if options.rate < 0 or options.start_delay_s < 0:
            raise ConfigError("rate and start_delay_s must not be negative", file=str(options.path))
        for name in options.namespaces:
            if not _NAMESPACE.fullmatch(name):
                raise ConfigError(f"{name!r} is not a ROS namespace; write it like robot1", file=str(options.path))
        try:
            self._patterns = PatternSet((".*",) if options.topics is None else options.topics)
            self._denied = PatternSet(options.deny)
        except PatternError as error:
            raise ConfigError(f"topic pattern {error.text!r} {error}", file=str(options.path)) from None
        self.options = options
        self.counters = BagCounters()
        self.problem: str | None = None
        """Why playback ended early, in one line; None while all is well."""
        self._clock = clock or SystemClock()
        self._topics: dict[TopicName, _Topic] = {}
        self._fanout: dict[int, list[_Topic]] = {}
        self._reader: Reader1 | Reader2 | None = None
        self._selected: list[Connection] = []
        self._messages: Iterator[tuple[Connection, int, bytes]] | None = None
        self._worker: ThreadPoolExecutor | None = None
        self._task: asyncio.Task[None] | None = None
        self._audience = asyncio.Event()
        self._wanted: set[str] = set()  # at the far side
        self._finished = False
        self._base_s = 0.0
        self._yielded_s = 0.0

    # Life cycle

    async def start(self, events: TopicEvents) -> None:
        """Opens the file and announces its topics. ConfigError, one line, when it cannot be read."""
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="sern-bag")
        try:
            await self._on_worker(self._open)
            missing = [name for name in self.options.wait_for if TopicName(name) not in self._topics]
            if missing:
                raise self._error(f"wait_for names {missing[0]}, which this bag does not give")
        except BaseException:
            await self.stop()
            raise
        for topic in self._topics.values():
            events.topic_added(topic.info)
        self._task = asyncio.create_task(self._play(), name=f"bag {self.options.path.name}")
        self._task.add_done_callback(self._play_done)

    async def stop(self) -> None:
        await end_tasks([] if self._task is None else [self._task])
        for topic in self._topics.values():
            for subscription in list(topic.subscriptions):
                subscription.close()
        worker, self._worker = self._worker, None
        if worker is not None:
            await asyncio.get_running_loop().run_in_executor(worker, self._close)
            worker.shutdown()

    def subscribe(self, name: TopicName, sink: Sink) -> _Subscription:
        topic = self._topics.get(name)
        if topic is None:
            raise UsageError(f"{name}: this bag announced no such topic")
        subscription = _Subscription(sink, topic, topic.subscriptions, deque(topic.retained.values()))
        topic.subscriptions.append(subscription)
        if subscription.held:
            asyncio.get_running_loop().call_soon(self._drain_backlog, subscription)
        return subscription

    def advertise(self, info: TopicInfo) -> Publisher:
        raise ConfigError(f"{info.name}: a bag being played takes no messages", file=str(self.options.path))

    def validate(self, held: Held) -> list[Difference]:
        given = Counter(name for name, topic in self._topics.items() for _ in topic.subscriptions)
        return held.differences(Held(subscriptions=given))

    def interest(self, name: TopicName, wanted: bool) -> None:
        (self._wanted.add if wanted else self._wanted.discard)(name)
        self._audience.set()

    @property
    def encoding(self) -> None:
        """Takes nothing, so it asks for no conversion."""
        return None

    @property
    def exhausted(self) -> bool:
        """The last message was offered (or playback ended with `problem`) and no latched one still waits."""
        return self._finished and not any(s.held for t in self._topics.values() for s in t.subscriptions)

    # Reading: everything here runs on the worker thread

    def _open(self) -> None:
        path = self.options.path
        if not path.exists():
            raise self._error("no such file; give a .bag, a .mcap, a .db3 or a rosbag2 directory")
        if path.suffix == ACTIVE:
            raise self._error(
                f"the recording was not finished; `sern recover {path}` does that, if nobody records there"
            )
        if path.is_file() and path.suffix not in {".bag", ".mcap", ".db3"}:
            raise self._error(f"unknown kind of file {path.suffix!r}; give a .bag, a .mcap, a .db3 or a directory")
        try:
            reader: Reader1 | Reader2 = Reader1(path) if path.suffix == ".bag" else Reader2(path)
            reader.open()
        except PermissionError:
            raise self._error("permission denied; make the file readable for this user") from None
        except Exception as error:  # a damaged file makes the readers raise almost anything
            raise self._error(f"cannot be read: {why(path, error)}; {self._cure()}") from error
        self._reader = reader
        self._select(reader.connections)

    def _select(self, connections: list[Connection]) -> None:
        infos: dict[str, TopicInfo] = {}
        for connection in connections:
            name = "/" + connection.topic.lstrip("/")
            if self._denied.fullmatch(name) or not self._patterns.fullmatch(name):
                continue
            info = self._describe(name, connection)
            known = infos.get(name, info)
            if known.type_name != info.type_name:
                raise self._error(
                    f"{name} has two types, {known.type_name} and {info.type_name}; leave it out with `topics`"
                )
            if info.latched and not known.latched:
                known = info
            infos[name] = known
            self._selected.append(connection)
        if not infos:
            what = "matches the `topics` patterns" if connections else "is in this bag"
            raise self._error(f"no topic {what}; nothing to play")
        prefixes = [f"/{name.strip('/')}" for name in self.options.namespaces] or [""]
        for prefix in prefixes:
            for name, info in infos.items():
                full = TopicName(prefix + name)
                text = TopicInfo(
                    full, info.type_name, info.encoding, info.type_hash, info.definition, info.latched, info.reliable
                )
                self._topics[full] = _Topic(text)
        for connection in self._selected:
            name = "/" + connection.topic.lstrip("/")
            self._fanout[connection.id] = [self._topics[TopicName(prefix + name)] for prefix in prefixes]

    def _describe(self, name: str, connection: Connection) -> TopicInfo:
        """What the connection says of itself; the hash is worked out where the file leaves it out."""
        latched, reliable = _qos(connection)
        ros1 = isinstance(connection.ext, ConnectionExtRosbag1)
        if not isinstance(connection.ext, ConnectionExtRosbag1) and connection.ext.serialization_format != "cdr":
            raise self._error(
                f"{name} is {connection.ext.serialization_format or 'of unknown encoding'}, not cdr; "
                "leave it out with `topics`"
            )
        encoding = Encoding.ROS1 if ros1 else Encoding.CDR
        definition, type_hash = connection.msgdef.data, connection.digest
        try:
            type_name = ros_types.canonical(connection.msgtype)
            if connection.msgdef.format is MessageDefinitionFormat.NONE:
                known = ros_types.describe(type_name, encoding)
                if known is not None:
                    definition, type_hash = known.definition, type_hash or known.type_hash
            else:
                computed = ros_types.hash_of(type_name, definition, encoding)
                if type_hash and type_hash != computed:
                    _LOG.warning(
                        "%s: %s: hash %s does not belong to its definition (%s)",
                        self.options.path, name, type_hash, computed,
                    )  # fmt: skip
                type_hash = type_hash or computed
        except ConfigError as error:
            raise self._error(f"{name}: {error.problem}; leave it out with `topics`") from error
        return TopicInfo(
            TopicName(name), type_name, encoding, type_hash, definition, latched or name == "/tf_static", reliable
        )

    def _read(self, first: bool) -> _Batch:
        assert self._reader is not None
        batch: list[tuple[int, int, bytes]] = []
        size = 0
        try:
            if first or self._messages is None:
                self._messages = self._reader.messages(connections=self._selected)
            for connection, time_ns, body in self._messages:
                batch.append((connection.id, time_ns, bytes(body)))
                size += len(body)
                if len(batch) >= BATCH_MESSAGES or size >= BATCH_BYTES:
                    return _Batch(batch, end=False, problem=None)
        except Exception as error:  # noqa: BLE001  a damaged file makes the readers raise almost anything
            return _Batch(batch, end=True, problem=why(self.options.path, error))
        return _Batch(batch, end=True, problem=None)

    def _close(self) -> None:
        self._messages = None
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()

    # Playing

    async def _play(self) -> None:
        await self._wait_for_audience()
        if self.options.start_delay_s > 0:
            await self._clock.sleep(self.options.start_delay_s)
        assert self._reader is not None
        first_ns, last_ns = self._reader.start_time, self._reader.end_time
        period_ns = max(last_ns - first_ns, 1)
        self._base_s = self._yielded_s = self._clock.monotonic_s()
        while True:
            gave = await self._pass(first_ns - self.counters.passes * period_ns)
            if self.problem is not None:
                break
            self.counters.passes += 1
            if not self.options.loop or not gave:
                break
        self._finished = True

    async def _pass(self, origin_ns: int) -> bool:
        """Play the file once; `origin_ns` is the bag time that is due at the base. False when it had no message."""
        gave = False
        next_batch = self._on_worker(lambda: self._read(first=True))
        while True:
            batch = await next_batch
            if not batch.end:
                next_batch = self._on_worker(lambda: self._read(first=False))
            for connection_id, time_ns, body in batch.messages:
                await self._until_due(time_ns - origin_ns)
                for topic in self._fanout[connection_id]:
                    await self._give(topic, connection_id, body, time_ns)
            gave = gave or bool(batch.messages)
            if batch.problem is not None:
                self._fail(f"damaged after {self.counters.accepted} messages ({batch.problem}); {self._cure()}")
            if batch.end:
                return gave

    async def _give(self, topic: _Topic, connection_id: int, body: bytes, time_ns: int) -> None:
        if topic.info.latched:
            topic.retained[connection_id] = (body, time_ns)
        if not topic.subscriptions:
            self.counters.unwanted += 1
        for subscription in list(topic.subscriptions):
            if self._offer(subscription, body, time_ns):
                continue
            if self.options.on_refused == "drop":
                self.counters.dropped += 1
            else:
                await self._insist(subscription, body, time_ns)

    async def _insist(self, subscription: _Subscription, body: bytes, time_ns: int) -> None:
        """Offer the same message until it is taken; the playback clock stands still meanwhile."""
        since_s = self._clock.monotonic_s()
        pause_s, longest_s = BACKOFF_S
        while not subscription.closed:
            await self._clock.sleep(pause_s)
            pause_s = min(2 * pause_s, longest_s)
            if subscription.closed or self._offer(subscription, body, time_ns):
                break
        self._base_s += self._clock.monotonic_s() - since_s

    def _offer(self, subscription: _Subscription, body: bytes, time_ns: int) -> bool:
        backlog = subscription.held
        while backlog:  # what is latched goes first
            if not self._hand_over(subscription, *backlog[0]):
                return False
            backlog.popleft()
        return self._hand_over(subscription, body, time_ns)

    def _hand_over(self, subscription: _Subscription, body: bytes, time_ns: int) -> bool:
        stamp_ns = time_ns if self.options.stamps == "bag" else self._clock.wall_ns()
        accepted = subscription.sink(body, stamp_ns)
        if accepted:
            self.counters.accepted += 1
        else:
            self.counters.refused += 1
        return accepted

    def _drain_backlog(self, subscription: _Subscription) -> None:
        backlog = subscription.held
        while backlog and self._hand_over(subscription, *backlog[0]):
            backlog.popleft()
        if backlog and not subscription.closed:
            asyncio.get_running_loop().call_later(BACKOFF_S[1], self._drain_backlog, subscription)

    async def _until_due(self, offset_ns: int) -> None:
        now_s = self._clock.monotonic_s()
        delay_s = 0.0
        if self.options.rate > 0:
            delay_s = self._base_s + offset_ns * 1e-9 / self.options.rate - now_s
        if delay_s > 0 or now_s - self._yielded_s > RUN_S:
            await self._clock.sleep(max(delay_s, 0.0))
            self._yielded_s = self._clock.monotonic_s()

    async def _wait_for_audience(self) -> None:
        while not self._wanted.issuperset(self.options.wait_for):
            self._audience.clear()
            await self._audience.wait()

    def _on_worker(self, job: Callable[[], _R]) -> asyncio.Future[_R]:
        return asyncio.get_running_loop().run_in_executor(self._worker, job)

    def _fail(self, problem: str) -> None:
        self.counters.errors += 1
        self.problem = str(self._error(problem))
        _LOG.error("%s", self.problem)

    def _play_done(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            # Not the file's fault but a sink's or our own: keep the traceback.
            _LOG.error("playback of %s ended", self.options.path, exc_info=error)
            self.counters.errors += 1
            self.problem = str(self._error(f"playback ended: {one_line(error)}"))
            self._finished = True

    def _error(self, problem: str) -> ConfigError:
        return ConfigError(problem, file=str(self.options.path))

    def _cure(self) -> str:
        path = self.options.path
        if path.suffix == ".bag":
            return f"try `rosbag reindex {path}` on a copy"
        if path.suffix == ".mcap":
            return f"try `mcap recover {path} -o recovered.mcap`"
        return f"try `ros2 bag reindex {path if path.is_dir() else path.parent}` on a copy"


def _qos(connection: Connection) -> tuple[bool, bool | None]:
    """(latched, reliable) as the recorded publisher offered them; ROS 1 says nothing of reliability."""
    if isinstance(connection.ext, ConnectionExtRosbag1):
        return connection.ext.latching == 1, None
    profiles = connection.ext.offered_qos_profiles
    latched = any(profile.durability is QosDurability.TRANSIENT_LOCAL for profile in profiles)
    offered = {profile.reliability for profile in profiles}
    if QosReliability.BEST_EFFORT in offered:
        return latched, False
    return latched, True if QosReliability.RELIABLE in offered else None
