"""What local nodes publish: the publishers of one topic, and the connections to them.

A `Source` is one publisher of one topic. It connects once to learn what only the connection tells (definition, md5sum,
whether it latches), and for as long as somebody wants the messages. A publisher that says in its header that it is a
SERN endpoint is never a source: its messages came over a link.
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

from sern_client.endpoints.base import Sink
from sern_client.endpoints.common.saying import Trouble, say_failure
from sern_client.endpoints.ros1.frames import Frames
from sern_client.endpoints.ros1.header import BRIDGE_FIELD, check_lengths, encode_header
from sern_client.endpoints.ros1.master import ANY
from sern_client.endpoints.ros1.xmlrpc import MAX_REQUEST_BYTES, CallError, XmlRpcClient, check_host, reason
from sern_client.tf_latch import TfLatch, is_static_tf
from sern_core.vocabulary.errors import ConfigError, WireError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types

CONNECT_S: Final = 5.0
BACKOFF_S: Final = (0.1, 5.0)
"""First and longest pause before a publisher that cannot be reached is tried again."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class ReceiveCounters:
    """Messages from local publishers, by fate."""

    received: int = 0
    accepted: int = 0
    refused: int = 0
    """Offered to the link, which counts them, and answered with no."""
    dropped: Counter[DropReason] = field(default_factory=Counter)
    mismatches: int = 0
    """Publishers that were refused because they mean another type."""

    def drop(self, why: DropReason) -> None:
        self.dropped[why] += 1


class Owner(Protocol):
    """What a topic asks of the endpoint it belongs to."""

    caller: str
    counters: ReceiveCounters
    max_message_bytes: int
    tcp_nodelay: bool
    accept_bridged: bool

    def next_number(self) -> int:
        """A connection's id for the tools."""
        ...

    def announce(self, topic: "Topic", info: TopicInfo) -> None: ...

    def withdraw(self, topic: "Topic") -> None: ...


class _Link(Frames):
    """The connection to one publisher."""

    def __init__(self, source: "Source", max_message_bytes: int) -> None:
        super().__init__(max_message_bytes)
        self.closed = asyncio.get_running_loop().create_future()
        self.greeted: asyncio.Future[dict[str, str]] = asyncio.get_running_loop().create_future()
        self._source = source
        self._accepted = False

    @property
    def open(self) -> bool:
        """Whether the publisher has accepted the connection, and it lasts. The kernel completes one before that."""
        return self._accepted and not self.closed.done()

    def header(self, fields: dict[str, str]) -> None:
        if not self.greeted.done():
            self.greeted.set_result(fields)
        self._source.greet(self, fields)
        self._accepted = True

    def message(self, body: bytes) -> None:
        self._source.topic.deliver(self._source, body)

    def too_large(self, size_bytes: int) -> None:
        self._source.too_large(size_bytes, self.max_frame_bytes)

    def failed(self, error: WireError) -> None:
        if self.greeted.done():
            self._source.broke(error)
        else:
            self.greeted.set_exception(error)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._over()

    def close(self) -> None:
        super().close()
        self._over()

    def _over(self) -> None:
        if not self.closed.done():
            self.closed.set_result(None)
        if not self.greeted.done():
            self.greeted.set_exception(WireError("the publisher closed the connection without a header"))
        if not self.greeted.cancelled():
            self.greeted.exception()  # nobody may be waiting for it


class Source:
    """One publisher of one topic. It runs while its node is known to live, at `uri`."""

    def __init__(self, topic: "Topic", node_name: str) -> None:
        self.topic = topic
        self.node_name = node_name
        self.uri = ""
        self.fields: dict[str, str] | None = None
        """Its connection header, once known; None while it is not known to live."""
        self.info: TopicInfo | None = None
        """What it publishes, when that is something to announce."""
        self.link: _Link | None = None
        self.number = topic.owner.next_number()
        self.wake = asyncio.Event()
        """Its messages are wanted now."""
        self._task: asyncio.Task[None] | None = None
        self._trouble = Trouble(_log, f"{topic.topic}: publisher {node_name}")
        self._too_large = False

    def up(self, uri: str) -> None:
        """Its node lives, at this URI."""
        if self._task is not None and not self._task.done() and uri == self.uri:
            return
        self.down()
        self.uri = uri
        self._task = asyncio.create_task(self._run(), name=f"ros1 {self.topic.topic} from {self.node_name}")
        self._task.add_done_callback(say_failure)

    def down(self) -> None:
        """Its node is dead, or no longer publishes this."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
        self._hang_up()
        if self.fields is not None:
            self.fields = self.info = None
            self.topic.source_lost(self)

    def _hang_up(self) -> None:
        link, self.link = self.link, None
        if link is not None:
            link.close()

    async def _run(self) -> None:
        pause_s = BACKOFF_S[0]
        while True:
            try:
                if await self._session():
                    pause_s = BACKOFF_S[0]
                if self.fields is not None and not self.topic.connects(self):
                    self.wake.clear()
                    await self.wake.wait()
                    continue
            except (CallError, WireError, OSError) as error:
                self._failed(reason(error))
            except TimeoutError:
                self._failed(f"no connection within {CONNECT_S:g} s")
            except Exception as error:  # noqa: BLE001  an error of ours must not be the end of a publisher
                self._failed(f"internal error: {reason(error)}", error)
            await asyncio.sleep(pause_s)
            pause_s = min(pause_s * 2, BACKOFF_S[1])

    async def _session(self) -> bool:
        """Ask where to connect, connect, and read until the connection has ended. Tells whether the handshake
        succeeded."""
        try:
            async with asyncio.timeout(CONNECT_S):
                host, port = await self._ask()
                loop = asyncio.get_running_loop()
                limit = self.topic.owner.max_message_bytes
                _, link = await loop.create_connection(lambda: _Link(self, limit), host, port)
                self.link = link
                if link.transport is not None:  # else it has ended already, and `greeted` says so
                    link.transport.write(encode_header(self._request()))
                await link.greeted
            await link.closed
            return self.fields is not None
        finally:
            self._hang_up()

    async def _ask(self) -> tuple[str, int]:
        client = XmlRpcClient(self.uri, timeout_s=CONNECT_S, max_answer_bytes=MAX_REQUEST_BYTES)
        try:
            value = await client.call("requestTopic", self.topic.owner.caller, self.topic.topic, [["TCPROS"]])
        finally:
            client.close()
        match value:
            case ["TCPROS", str(host), int(port)]:
                check_host(host)
                return host, port
        raise CallError(f"{self.uri}: requestTopic: the answer is not [TCPROS, host, port]")

    def _request(self) -> dict[str, str]:
        return {
            "callerid": self.topic.owner.caller,
            "topic": self.topic.topic,
            "type": ANY,
            "md5sum": ANY,
            "message_definition": "",
            "tcp_nodelay": "1" if self.topic.owner.tcp_nodelay else "0",
        }

    def broke(self, error: WireError) -> None:
        """It broke the protocol after its header came, or with it."""
        if self.link is not None and self.link.open:
            self._trouble.say(str(error))
        else:
            self._failed(str(error))
        if self.fields is not None:
            self.fields = self.info = None
            self.topic.source_lost(self)

    def _failed(self, problem: str, error: Exception | None = None) -> None:
        """There is no connection, or none that is of use. `error`: what nobody expected."""
        level = logging.WARNING if error is None else logging.ERROR
        self._trouble.say(problem, level, error, lost=True)

    def greet(self, link: _Link, fields: dict[str, str]) -> None:
        """Its header has come: decide whether to stay connected."""
        if link is not self.link and self.link is not None:
            link.close()
            return
        if "error" in fields:
            raise WireError(f"refused: {' '.join(fields['error'].split())[:300]}")
        self.fields = fields
        ours = BRIDGE_FIELD in fields and not self.topic.owner.accept_bridged
        self.info = None if ours else self._describe(fields)
        self._trouble.over()
        self.topic.sources_changed()
        if not self.topic.connects(self):
            link.close()

    def _describe(self, fields: dict[str, str]) -> TopicInfo | None:
        """What to announce; None for a publisher that does not say what it publishes."""
        check_lengths(fields, "type", "md5sum")
        type_name, md5 = fields.get("type", ANY), fields.get("md5sum", ANY)
        if type_name == ANY or md5 == ANY:
            return None
        try:
            type_name = ros_types.canonical(type_name)
        except ConfigError as error:
            raise WireError(error.problem) from None
        definition = self._definition(type_name, md5, fields.get("message_definition", ""))
        latched = fields.get("latching", "0") == "1" or is_static_tf(self.topic.topic, type_name)
        return TopicInfo(TopicName(self.topic.local), type_name, Encoding.ROS1, md5, definition, latched)

    def _definition(self, type_name: str, md5: str, text: str) -> str:
        """The publisher's own definition; where it sends none, the known one of that hash."""
        if not text.strip():
            known = ros_types.describe(type_name, Encoding.ROS1)
            return known.definition if known is not None and known.type_hash == md5 else ""
        try:
            computed = ros_types.hash_of(type_name, text, Encoding.ROS1)
        except ConfigError as error:
            self._trouble.say(error.problem)
            return ""
        if computed != md5:
            self._trouble.say(
                f"md5sum {md5} of {type_name} does not belong to the definition it sends, which has {computed}"
            )
            return ""
        return text

    def refused(self, announced: TopicInfo) -> None:
        """It publishes another type than the topic was announced with."""
        assert self.info is not None
        problem = (
            f"it publishes {self.info.type_name} with md5sum {self.info.type_hash}, others here "
            f"{announced.type_name} with {announced.type_hash}; not received, rebuild one of them"
        )
        if self._trouble.say(problem, logging.ERROR):
            self.topic.owner.counters.mismatches += 1

    def too_large(self, size_bytes: int, limit_bytes: int) -> None:
        self.topic.owner.counters.received += 1
        self.topic.owner.counters.drop(DropReason.TOO_LARGE)
        if not self._too_large:
            self._too_large = True
            self._trouble.say(f"a message of {size_bytes} bytes is dropped, max_message_bytes is {limit_bytes}")


class Topic:
    """One topic of the local nodes. `topic` is its name at the master, `local` the one announced."""

    def __init__(self, topic: str, local: str, owner: Owner) -> None:
        self.topic = topic
        self.local = local
        self.owner = owner
        self.sources: dict[str, Source] = {}
        self.announced: TopicInfo | None = None
        self.sinks: list[Subscription] = []
        self._interest = True
        self._static: TfLatch | None = None
        self._unreadable = False

    # Who publishes it

    def source_lost(self, source: Source) -> None:
        """A publisher that was known to live does so no more."""
        if self._static is not None:
            self._static.drop(source.node_name)
        self.sources_changed()

    def sources_changed(self) -> None:
        """Announce, withdraw or announce anew, by the publishers that are known to live."""
        self._announce()
        self._wake()

    def _announce(self) -> None:
        able = [source for source in self.sources.values() if source.info is not None]
        announced = self.announced
        if announced is not None:
            fitting = [source for source in able if _same_type(source.info, announced)]
            latches = any(source.info.latched for source in fitting if source.info is not None)
            if fitting and (announced.latched or not latches):
                for source in able:
                    if source not in fitting:
                        source.refused(announced)
                return
            self.announced = None
            self._static = None
            self.owner.withdraw(self)
        if not able:
            return
        info = able[0].info
        assert info is not None
        self.announced = info
        if is_static_tf(self.topic, info.type_name):
            self._static = TfLatch(Encoding.ROS1)
        self.owner.announce(self, info)
        for source in able[1:]:
            if not _same_type(source.info, info):
                source.refused(info)

    def connects(self, source: Source) -> bool:
        """Whether messages of this publisher are wanted now."""
        return self.wanted and _same_type(source.info, self.announced)

    def _wake(self) -> None:
        for source in self.sources.values():
            if self.connects(source):
                source.wake.set()

    # Who wants it

    @property
    def wanted(self) -> bool:
        return bool(self.sinks) and self._interest

    def subscribe(self, sink: Sink, changed: Callable[[], None]) -> "Subscription":
        subscription = Subscription(self, sink, changed)
        self.sinks.append(subscription)
        self._judge()
        return subscription

    def unsubscribe(self, subscription: "Subscription") -> None:
        if subscription in self.sinks:
            self.sinks.remove(subscription)
            self._judge()

    def interest(self, wanted: bool) -> None:
        self._interest = wanted
        self._judge()

    def _judge(self) -> None:
        if self.wanted:
            self._wake()
            return
        for source in self.sources.values():
            if source.link is not None and source.fields is not None:
                source.link.close()

    def deliver(self, source: Source, body: bytes) -> None:
        counters = self.owner.counters
        counters.received += 1
        if self._static is not None:
            try:
                body = self._static.add(source.node_name, body)
            except ConfigError as error:
                if not self._unreadable:
                    self._unreadable = True
                    _log.warning("%s: publisher %s: %s", self.topic, source.node_name, error)
        stamp_ns = time.time_ns()
        for subscription in self.sinks:
            if subscription.sink(body, stamp_ns):
                counters.accepted += 1
            else:
                counters.refused += 1

    def close(self) -> None:
        for source in list(self.sources.values()):
            source.down()


class Subscription:
    """What `Endpoint.subscribe` gives."""

    def __init__(self, topic: Topic, sink: Sink, changed: Callable[[], None]) -> None:
        self.sink = sink
        self._topic = topic
        self._changed = changed

    def close(self) -> None:
        self._topic.unsubscribe(self)
        self._changed()


def _same_type(one: TopicInfo | None, other: TopicInfo | None) -> bool:
    return (
        one is not None and other is not None and (one.type_name, one.type_hash) == (other.type_name, other.type_hash)
    )
