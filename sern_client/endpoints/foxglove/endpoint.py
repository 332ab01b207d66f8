"""Foxglove and Lichtblick at a site: people look at topics of other sites, and may publish some of their own.

viewer, through the `door` (who may come in, what a slow one misses) to the SDK's `server`, which tells the `board`
(topics and who looks at them), `publishing` and `services`.
"""

import asyncio
import logging
from collections import Counter
from typing import TYPE_CHECKING

from sern_client.endpoints.base import (
    Difference,
    Held,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    ServiceServer,
    Sink,
    Subscription,
    TopicEvents,
    Viewed,
)
from sern_client.endpoints.common.viewed import NothingOnDemand
from sern_client.endpoints.foxglove.board import Board, TopicPublisher
from sern_client.endpoints.foxglove.definitions import Described
from sern_client.endpoints.foxglove.door import Door, Shared, tls_context
from sern_client.endpoints.foxglove.handshake import Rules
from sern_client.endpoints.foxglove.metrics import register_viewers
from sern_client.endpoints.foxglove.news import News
from sern_client.endpoints.foxglove.options import FoxgloveOptions
from sern_client.endpoints.foxglove.publishing import ENCODINGS, Publishing
from sern_client.endpoints.foxglove.server import Advertised, Channel, Server
from sern_client.endpoints.foxglove.services import Services
from sern_client.endpoints.foxglove.viewer import Viewer
from sern_core.topics.patterns import PatternSet
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime.http import parse_listen

if TYPE_CHECKING:
    from sern_runtime.metrics import Metrics

_log = logging.getLogger(__name__)


class FoxgloveEndpoint:
    """An `Endpoint`, a `ViewingEndpoint` and a `ServiceEndpoint`."""

    def __init__(self, options: FoxgloveOptions) -> None:
        self.options = options
        self.shared = Shared()
        self._viewed: Viewed = NothingOnDemand()
        self._server = Server()
        self._door = Door(self.shared, Rules(options.token, options.origins), max_bytes=options.max_waiting_bytes)
        self._services = Services(self._server)
        self._board: Board | None = None
        self._publishing: Publishing | None = None
        self._news: News | None = None
        self._early: list[TopicInfo] = []

    @property
    def encoding(self) -> Encoding | None:
        return None

    @property
    def exhausted(self) -> bool:
        return False

    @property
    def port(self) -> int:
        """The port that viewers connect to, also when port 0 was asked for. Only while started."""
        return self._door.port

    @property
    def looked_at(self) -> Counter[TopicName]:
        """How many viewers look at each topic."""
        return Counter() if self._board is None else self._board.looked_at

    @property
    def drops(self) -> dict[DropReason, int]:
        """Messages that a slow viewer did not get, and those of viewers that did not go on."""
        total = Counter({DropReason.QUEUE_FULL: self._server.dropped}) + self.shared.dropped
        for part in (self._board, self._publishing):
            if part is not None:
                total.update(part.dropped)
        return {reason: count for reason, count in total.items() if count}

    def register_metrics(self, metrics: "Metrics") -> None:
        register_viewers(metrics, self.shared, lambda: 0 if self._board is None else len(self._board))

    async def start(self, events: TopicEvents) -> None:
        """ConfigError when the port is taken or the certificate cannot be used."""
        options = self.options
        host, port = parse_listen(options.listen)
        tls = None
        if options.tls_certificate is not None and options.tls_key is not None:
            tls = tls_context(options.tls_certificate, options.tls_key)
        patterns = PatternSet([".*"] if options.publish is True else options.publish or ())
        board = self._board = Board(self._viewed, self._open_channel, self._show_all)
        news = self._news = News(lambda: list(self.shared.viewers), self._viewed.topics, board.name_of)
        self._publishing = Publishing(patterns.fullmatch, Encoding(options.encoding), events, news, self.shared.fault)
        self.shared.on_subscribed = self._subscribed
        self.shared.on_changed = news.viewers_changed
        self._server.start(self, publishes=options.publish not in (False, ()), encodings=ENCODINGS)
        self._door.server = self._server.address
        try:
            await self._door.open(host, port, tls)
        except ConfigError:
            await self.stop()
            raise
        scheme = "ws" if tls is None else "wss"
        _log.info("viewers connect to %s://%s:%d%s", scheme, host, self.port, "/?token=..." if options.token else "")
        for info in self._early:
            board.offered(info)
        self._early.clear()

    async def stop(self) -> None:
        if self._news is not None:
            self._news.close()
        self._services.close()
        await self._door.close()
        if self._publishing is not None:
            self._publishing.close()
        if self._board is not None:
            self._board.close()
        # It ends its threads' work: not on the loop, which they may be waiting for.
        await asyncio.get_running_loop().run_in_executor(None, self._server.stop)

    # --- topics of other sites --------------------------------------------------------------------------------------

    def use_viewed(self, viewed: Viewed) -> None:
        self._viewed = viewed

    def topic_offered(self, info: TopicInfo) -> None:
        if self._board is None:
            self._early = [each for each in self._early if each.name != info.name] + [info]
        else:
            self._board.offered(info)

    def topic_withdrawn(self, name: TopicName) -> None:
        self._early = [each for each in self._early if each.name != name]
        if self._board is not None:
            self._board.withdrawn(name)

    def advertise(self, info: TopicInfo) -> TopicPublisher:
        if self._board is None:
            raise UsageError("advertise before start")
        return self._board.advertise(info)

    def _open_channel(self, info: TopicInfo, described: Described) -> Channel:
        return self._server.channel(info.name, str(info.encoding), described, self.shared.ended)

    def _subscribed(self, viewer: Viewer, subscription: int, channel: int) -> None:
        if self._board is not None:
            self._board.missed(channel, lambda stamp_ns, body: viewer.show(subscription, stamp_ns, body, must=True))

    def _show_all(self, channel: int, body: bytes, must: bool) -> None:
        self.shared.show(channel, body, must=must)

    # --- topics of viewers ------------------------------------------------------------------------------------------

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        if self._publishing is None:
            raise UsageError(f"{name}: no viewer publishes such a topic")
        return self._publishing.subscribe(name, sink)

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Makes no difference: what people publish is little, and the link drops what nobody wants."""

    def validate(self, held: Held) -> list[Difference]:
        here = Held()
        if self._board is not None and self._publishing is not None:
            here = Held(self._board.publishers, self._publishing.subscriptions)
        return held.differences(here)

    # --- from the server --------------------------------------------------------------------------------------------

    def looks(self, client: int, channel: int, *, looks: bool) -> None:
        if self._board is not None:
            self._board.looks(client, channel, looks=looks)

    def advertised(self, client: int, channel: Advertised) -> None:
        if self._publishing is not None:
            self._publishing.advertised(client, channel)

    def unadvertised(self, client: int, channel: int) -> None:
        if self._publishing is not None:
            self._publishing.unadvertised(client, channel)

    def published(self, client: int, channel: int, body: bytes) -> None:
        if self._publishing is not None:
            self._publishing.published(client, channel, body)

    # --- services ---------------------------------------------------------------------------------------------------

    def watch_services(self, events: ServiceEvents) -> None:
        """Viewers offer none."""

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        raise ServiceError(f"no viewer offers a service, so there is no {name}")

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        return self._services.serve(info, handler)
