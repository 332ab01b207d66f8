"""A topic on its way to the link, and one from it."""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sern_client.endpoints.base import Sink
from sern_client.endpoints.common.first_messages import Readers
from sern_client.endpoints.rclpy import qos
from sern_client.endpoints.rclpy.domain import Domain, refused
from sern_client.endpoints.rclpy.echoes import Echoes, digest
from sern_client.endpoints.rclpy.graph import Graph
from sern_client.endpoints.rclpy.interfaces import Interfaces
from sern_client.endpoints.rclpy.qos import Offer
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, TopicName
from sern_runtime import ros_types

if TYPE_CHECKING:
    from rclpy.subscription import Subscription

OVERLAP_S: Final = 1.0
"""How long a subscription that another one replaces stays open beside it."""
MAX_SEEN: Final = 1000
"""Messages that are known as delivered, where they may come again."""


@dataclass(slots=True, eq=False)
class _Opened:
    asked: Offer
    at_middleware: "Subscription"


class Reader:
    """A subscription of the bridge (`Taking`). What it has at the middleware is made anew when publishers appear that
    it would not match; each message is delivered once."""

    def __init__(
        self, domain: Domain, interfaces: Interfaces, echoes: Echoes, offers: Callable[[], list[Offer]],
        info: TopicInfo, sink: Sink, closed: "Callable[[Reader], None]",
    ) -> None:  # fmt: skip
        self.name = info.name
        self.wanted = True
        self._info = info
        self._domain = domain
        self._interfaces = interfaces
        self._echoes = echoes
        self._offers = offers
        self._sink = sink
        self._on_close = closed
        self._closed = False
        self._opened: _Opened | None = None
        self._before: _Opened | None = None
        self._overlap: asyncio.TimerHandle | None = None
        self._seen: set[tuple[int, int]] = set()
        self._seen_order: deque[tuple[int, int]] = deque()

    def refresh(self) -> None:
        """Have a subscription that matches all publishers there are now, or none while nobody wants the topic.
        ConfigError where rclpy gives none: the one that there is stays."""
        if self._closed or not self._domain.alive:
            return
        if not self.wanted and not self._info.latched:
            self._end()
            return
        offers = self._offers()
        if self._opened is not None and all(qos.matches(offer, self._opened.asked) for offer in offers):
            return
        asked = qos.reader_for(offers)
        if self._info.depth is not None and self._info.depth > (asked.depth or 0):
            asked = replace(asked, depth=self._info.depth)
        opened = self._open(asked)
        self._end_before()
        self._before, self._opened = self._opened, opened
        if self._before is not None:
            self._overlap = asyncio.get_running_loop().call_later(OVERLAP_S, self._end_before)

    @property
    def lacking(self) -> bool:
        return self._opened is None and (self.wanted or self._info.latched)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._end()
            self._on_close(self)

    def _open(self, asked: Offer) -> _Opened:
        handover = self._domain.handover
        made: list[_Opened] = []

        def came(body: bytes, about: dict[str, Any]) -> None:  # in the thread that executes callbacks
            source_ns = about.get("source_timestamp") or 0
            arrived_ns = time.time_ns()
            handover.put(lambda: self._came(made, body, source_ns, arrived_ns), len(body))

        message_type = self._interfaces.message(self.name, self._info.type_name)
        with refused("rclpy gives no subscription"):
            subscription = self._domain.node.create_subscription(
                message_type, self.name, came, qos.profile(asked), raw=True
            )
        made.append(_Opened(asked, subscription))
        return made[0]

    def _came(self, made: list[_Opened], body: bytes, source_ns: int, arrived_ns: int) -> None:
        if not made or made[0] not in (self._opened, self._before):
            return  # of one before the last two, or from before nobody wanted it
        if self._echoes.ours(self.name, body, source_ns):
            return
        may_repeat = bool(source_ns) and (self._before is not None or self._info.latched)
        if may_repeat and not self._is_new((source_ns, digest(body))):
            return
        self._sink(body, source_ns or arrived_ns)

    def _is_new(self, key: tuple[int, int]) -> bool:
        if key in self._seen:
            return False
        self._seen.add(key)
        self._seen_order.append(key)
        if len(self._seen_order) > max(MAX_SEEN, self._info.depth or 0):
            self._seen.discard(self._seen_order.popleft())
        return True

    def _end(self) -> None:
        self._end_before()
        opened, self._opened = self._opened, None
        self._destroy(opened)

    def _end_before(self) -> None:
        if self._overlap is not None:
            self._overlap.cancel()
            self._overlap = None
        before, self._before = self._before, None
        self._destroy(before)

    def _destroy(self, opened: _Opened | None) -> None:
        if opened is not None and self._domain.alive:  # else it has gone with its domain
            self._domain.node.destroy_subscription(opened.at_middleware)


class Writer:
    """A publisher of ours. ConfigError where rclpy has no such type, or another version of it."""

    def __init__(
        self, domain: Domain, interfaces: Interfaces, echoes: Echoes, graph: Graph, info: TopicInfo,
        dropped: Callable[[DropReason], None], closed: Callable[[TopicName], None],
    ) -> None:  # fmt: skip
        self.name = info.name
        self.offered = qos.writer_for(info)
        self._domain = domain
        self._echoes = echoes
        self._graph = graph
        self._dropped = dropped
        self._on_close = closed
        self._type_name = ros_types.canonical(info.type_name)
        self._keep = (self.offered.depth or 1) if info.latched else 1
        message_type = interfaces.message(info.name, self._type_name)
        with refused(f"{info.name}: rclpy gives no publisher"):
            self._publisher = domain.node.create_publisher(message_type, info.name, qos.profile(self.offered))

    def publish(self, body: bytes, stamp_ns: int) -> None:
        del stamp_ns  # rclpy stamps what it publishes itself
        if not self._domain.alive:
            self._dropped(DropReason.DISCONNECTED)
            return
        self._echoes.publish(self.name, body, self._publisher.publish, keep=self._keep)

    def readers(self) -> Readers:
        """Those that would miss what is written before they are connected; of a latched topic, most miss nothing."""
        if not self._domain.alive:
            return Readers(0, 0)
        there = self._graph.subscribers(self.name, self._type_name)
        asked = [each for each in there if qos.matches(self.offered, each)]
        if all(self.offered.latched and each.latched for each in asked):
            return Readers(0, 0)
        return Readers(len(asked), self._publisher.get_subscription_count())

    def close(self) -> None:
        if self._domain.alive:
            self._domain.node.destroy_publisher(self._publisher)
        self._on_close(self.name)
