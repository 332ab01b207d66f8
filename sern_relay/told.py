"""What a relay tells to be watched (`sern_runtime.watching.told`): the rows of its routes, one at a time."""

import time
from collections.abc import Iterator

from sern_core.relay.hub import Hub
from sern_relay.clients_view import ClientsSource, client_row
from sern_runtime import clock
from sern_runtime.adaptation import Adaptation
from sern_runtime.events import wall_text
from sern_runtime.topics_view import announced_summary, link_rows, received_rows
from sern_runtime.watching.history import Look
from sern_runtime.watching.state import TopicPart
from sern_runtime.watching.told import Adapting, Json


class RelayTold:
    """Tells of one relay. `clients` is what the rows of /api/clients are made of."""

    def __init__(self, hub: Hub, clients: ClientsSource, adaptation: Adaptation | None) -> None:
        self._hub = hub
        self._clients = clients
        self._adaptation = adaptation

    def head(self) -> Json:
        return {
            "name": self._clients.relay,
            "role": "relay",
            "time": wall_text(time.time()),
            "refused_total": self._clients.refusals.total,
        }

    def clients(self) -> Iterator[Json]:
        return (client_row(self._clients, client) for client in self._clients.names())

    def links(self) -> Iterator[Json]:
        links = (self._hub.links.get(client) for client in tuple(self._hub.links))
        return (link.snapshot() for link in links if link is not None)

    def topics(self) -> Iterator[TopicPart]:
        hub = self._hub
        for client in tuple(hub.links):
            link = hub.links.get(client)
            if link is not None:
                for name, row in link_rows(link, direction="send"):
                    yield TopicPart("links", client, name, row)
        for name, row in received_rows(hub.received, now=clock.now()):
            yield TopicPart("received", "", name, row)
        for name, row in announced_summary(hub.streams.announced()).items():
            yield TopicPart("announced", "", name, row)

    def objects(self) -> Iterator[str]:
        registry = self._hub.objects
        abouts = (registry.about(object_id) for object_id in registry.named())
        return (str(about[0]) for about in abouts if about is not None)

    def adapting(self) -> Adapting | None:
        return None if self._adaptation is None else Adapting(self._adaptation.about(), self._adaptation.rows(1))

    def looks(self, now: float) -> Iterator[Look]:
        for client in tuple(self._hub.links):
            link = self._hub.links.get(client)
            if link is not None:
                yield Look.of(link, now)
