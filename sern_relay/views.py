"""What a relay tells over HTTP: the routes under /api, and the counters that are also its summary."""

import json
from collections.abc import Callable, Iterator
from typing import Final

from sern_core.relay.hub import Hub
from sern_core.vocabulary.types import ClientName
from sern_relay.admission import Admission
from sern_relay.clients_view import ClientsSource, clients_view
from sern_relay.comings import Comings
from sern_relay.fleet import announced, elsewhere
from sern_relay.objects_view import objects_view
from sern_relay.refusals import Refusals
from sern_relay.told import RelayTold
from sern_relay.trace_source import of_hub
from sern_runtime import clock
from sern_runtime.adaptation import Adaptation
from sern_runtime.events import EventLog
from sern_runtime.http_routes import JsonParts, JsonQuery, JsonSource, array, table
from sern_runtime.topics_view import TopicView, link_rows, link_summary, received_rows, received_summary
from sern_runtime.trace_view import trace_view

TOO_LARGE: Final = "the answer is too large"


class RelayViews:
    """The routes of one relay. `address(client)` is where a client comes from now."""

    def __init__(
        self,
        name: str,
        hub: Hub,
        comings: Comings,
        refusals: Refusals,
        events: EventLog,
        admission: Admission,
        address: Callable[[ClientName], str],
    ) -> None:
        self._hub = hub
        self._events = events
        self._clients = ClientsSource(name, hub, comings, refusals, admission, address)

    def told(self, adaptation: Adaptation | None) -> RelayTold:
        """What the page is made of."""
        return RelayTold(self._hub, self._clients, adaptation)

    def routes(self, adaptation: Adaptation | None) -> dict[str, JsonSource | JsonQuery]:
        return {
            "/api/clients": lambda: clients_view(self._clients),
            "/api/events": self._events.view(),
            "/api/link": self._links,
            "/api/objects": objects_view(self._hub),
            "/api/topics": lambda: JsonParts(self._topics(), TOO_LARGE),
            "/api/trace": trace_view(of_hub(self._hub), clock.now),
            **({} if adaptation is None else {"/api/mmcf": adaptation.view()}),
        }

    def topics(self) -> dict[str, object]:
        """Counters by client link and topic, and of what arrived; and what is announced, whether taken or not."""
        return {
            "announced": announced(self._hub),
            "links": {name: link_summary(link, direction="send") for name, link in self._hub.links.items()},
            "received": received_summary(self._hub.received, now=clock.now()),
        }

    def _links(self) -> JsonParts:
        """A row for each link."""
        links = (self._hub.links.get(client) for client in tuple(self._hub.links))
        return JsonParts(
            array({**link.snapshot(), "now_s": clock.now()} for link in links if link is not None), TOO_LARGE
        )

    def _topics(self) -> Iterator[str]:
        """The same as `topics`, a row at a time: of each link and topic the counters add up. Where there are other
        relays, also the topics that stay there."""
        hub = self._hub
        yield '{"announced": '
        yield from table(announced(hub).items())
        if hub.peers.names:
            rows: dict[str, TopicView] = {}
            yield from ("" for _ in elsewhere(hub, rows))
            yield ', "elsewhere": '
            yield from table(rows.items())
        yield ', "links": {'
        comma = ""
        for client in tuple(hub.links):
            link = hub.links.get(client)
            if link is not None:
                yield f"{comma}{json.dumps(client)}: "
                yield from table(link_rows(link, direction="send"))
                comma = ", "
        yield '}, "received": '
        yield from table(received_rows(hub.received, now=clock.now()))
        yield "}"
