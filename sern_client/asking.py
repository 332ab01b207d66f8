"""Requests between clients on topics of their own: what is asked of who takes a topic, such as to release an e-stop.

A request is a std_msgs/String on a reliable topic of class control below the topic that it is about. It needs no node
at either end, and the relay's access rules hold for it as for any topic: who may publish the one may ask about it.
"""

import asyncio
import logging
from collections.abc import Callable
from typing import Final

from sern_client.endpoints.common.saying import SayOnce
from sern_client.site import Site
from sern_core.site.client import ClientCore
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_core.vocabulary.message import Message, StreamInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, PriorityClass, Reliability, TopicName
from sern_runtime import clock, ros_types

TEXT_TYPE: Final = "std_msgs/msg/String"
LIFESPAN_S: Final = 5.0
"""An older request is not obeyed: whoever asked has been told that it failed."""
ASK_S: Final = 8.0
"""Longest wait for the delivery of a request."""
POLL_S: Final = 0.02
MAX_TEXT_BYTES: Final = 1024
SPEC: Final = TopicSpec(
    priority=PriorityClass.CONTROL,
    weight=10.0,
    reliability=Reliability.RELIABLE,
    depth=10,
    lifespan_s=LIFESPAN_S,
    retention_s=LIFESPAN_S,
    max_queue_bytes=64 * 1024,
    many_writers=True,
)

Hear = Callable[[ClientName, str], None]
"""`hear(who, text)`: somebody asks."""

_log = logging.getLogger(__name__)


class Asking:
    """Takes requests (`listen`), and makes them (`ask`). `refused` says in the relay's words why a topic of ours is not
    taken, or nothing."""

    def __init__(self, site: Site, core: ClientCore, refused: Callable[[TopicName], str | None]) -> None:
        self._site = site
        self._core = core
        self._refused = refused
        self._said = SayOnce(_log)
        self._listeners: dict[TopicName, Hear] = {}
        self._locks: dict[TopicName, asyncio.Lock] = {}

    @property
    def topics(self) -> tuple[TopicName, ...]:
        """Global names on which requests are taken."""
        return tuple(self._listeners)

    def listen(self, topic: TopicName, hear: Hear) -> None:
        """Have the requests on a topic (global name) heard."""
        self._listeners[topic] = hear

    def takes(self, topic: str) -> bool:
        """Whether requests on a topic (global name) are heard here."""
        return topic in self._listeners

    def opened(self, stream: StreamInfo) -> None:
        """Raises ConfigError for a stream that holds no requests."""
        if ros_types.canonical(stream.info.type_name) != TEXT_TYPE or stream.info.encoding is Encoding.RAW:
            problem = f"{stream.id.topic} of {stream.id.origin} is {stream.info.type_name}, not {TEXT_TYPE}"
            self._said(f"{problem}: its requests are not heard", stream.id.topic, stream.id.origin)
            raise ConfigError(problem)

    def message(self, stream: StreamInfo, message: Message) -> None:
        """A request has come. One that cannot be read is a fault of whoever sent it: said, and nothing else."""
        hear, who = self._listeners[stream.id.topic], stream.id.origin
        if len(message.body) > MAX_TEXT_BYTES:
            self._said(f"{stream.id.topic}: a request of {who} is too long and not heard", stream.id.topic, who)
            return
        try:
            text = str(ros_types.deserialise(message.body, TEXT_TYPE, stream.info.encoding).data)
        except Exception as error:  # noqa: BLE001  (whatever a peer's bytes do to the decoder)
            words = f"{stream.id.topic}: a request of {who} cannot be read: {ros_types.one_line(error)}"
            self._said(words, stream.id.topic, who)
            return
        try:
            hear(who, text)
        except UsageError as error:
            self._said(f"{stream.id.topic}: a request of {who} changes nothing: {error}", stream.id.topic, who)

    async def ask(self, topic: TopicName, text: str) -> None:
        """Make a request on a topic (global name); returns once it is delivered. Raises SernError, in one line, where
        it was not."""
        if not self._core.link.established:
            raise SernError("there is no link to the relay; nothing was asked")
        lock = self._locks.setdefault(topic, asyncio.Lock())
        try:
            async with lock:
                await self._ask(topic, text)
        finally:
            if not lock.locked():
                self._locks.pop(topic, None)

    async def _ask(self, topic: TopicName, text: str) -> None:
        core = self._core
        info = ros_types.topic_info(topic, TEXT_TYPE, Encoding.CDR)
        channel = core.publish(info, SPEC, now=clock.now())
        try:
            said = ros_types.new(TEXT_TYPE, Encoding.CDR, data=text)
            body = ros_types.serialise(said, TEXT_TYPE, Encoding.CDR)
            core.send(channel, body, 0, now=clock.now())
            self._site.kick()
            await self._delivered(topic, channel)
        finally:
            core.unpublish(channel, now=clock.now())
            self._site.kick()

    async def _delivered(self, topic: TopicName, channel: OutChannel) -> None:
        give_up_s = clock.now() + ASK_S
        while True:
            refused = self._refused(topic)
            if refused is not None:
                raise SernError(f"the relay refuses it: {refused}")
            if channel.wanted is False:
                break
            if channel.counters.delivered and not channel.retained:
                return
            if clock.now() >= give_up_s:
                raise SernError(f"{topic} was not answered in {ASK_S:g} s; is the other side there? See `sern clients`")
            await asyncio.sleep(POLL_S)
        raise SernError(f"nobody takes {topic}: is its site there, and does its file say so? See `sern clients`")
