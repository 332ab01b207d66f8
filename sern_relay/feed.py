"""The relay's plain feed: what the clients' streams carry, for any ZeroMQ program on the local network."""

import time
from collections.abc import Callable

import zmq

from sern_core.hub import Hub
from sern_core.message import Message, StreamInfo
from sern_core.rules import FeedRole
from sern_core.types import ClientName, TopicName
from sern_runtime.feed import Feed, FeedHeader


class RelayFeed:
    """Publishes what passes the hub to the roles that may see it, and makes their interest the hub's.

    A subscriber of the feed is a subscriber like any other: without one the robot need not send the stream.
    """

    def __init__(
        self,
        ctx: "zmq.Context[zmq.Socket[bytes]]",
        hub: Hub,
        roles: tuple[FeedRole, ...],
        *,
        after: Callable[[], None],
    ) -> None:
        self._hub = hub
        self._after = after
        self.feed = Feed(ctx, roles, on_interest=self._interest, accept=self._may_own)
        hub.tap = self._wants

    def close(self) -> None:
        self.feed.close()

    def publish(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        age_us = max(0, int((now - message.born_s) * 1e6))
        header = FeedHeader(stream.spec.priority, message.seq, message.stamp_ns, age_us)
        self.feed.publish(stream.id.topic, header, message.body)

    def _wants(self, stream: StreamInfo) -> bool:
        return self.feed.wants(stream.id.topic)

    def _may_own(self, role: FeedRole, name: TopicName) -> bool:
        """A name that a client owns is not published by the feed as well."""
        owners = self._hub.routing.owners(name)
        return not owners or owners == (ClientName(role.name),)

    def _interest(self) -> None:
        self._hub.refresh_interest(now=time.monotonic())
        self._after()
