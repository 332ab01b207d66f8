"""What a client tells to be watched (`sern_runtime.watching.told`): the rows of its routes, one at a time."""

from collections.abc import Iterator

from sern_client.bridge import Bridge
from sern_client.views import ClientViews
from sern_runtime import clock
from sern_runtime.adaptation import Adaptation
from sern_runtime.topics_view import both_rows
from sern_runtime.watching.history import Look
from sern_runtime.watching.state import TopicPart
from sern_runtime.watching.told import Adapting, Json


class ClientTold:
    """Tells of one client."""

    def __init__(self, bridge: Bridge, views: ClientViews, adaptation: Adaptation | None) -> None:
        self._core = bridge.core
        self._views = views
        self._adaptation = adaptation

    def head(self) -> Json:
        return self._views.head()

    def clients(self) -> Iterator[Json]:
        return self._views.rows()

    def links(self) -> Iterator[Json]:
        yield self._views.link()

    def topics(self) -> Iterator[TopicPart]:
        for name, row in both_rows(self._core.link, self._core.received, now=clock.now()):
            yield TopicPart("client", "", name, row)

    def objects(self) -> Iterator[str]:
        registry = self._core.objects.registry
        abouts = [registry.about(object_id) for object_id in registry.named()]
        yield from (str(about[0]) for about in abouts if about is not None)
        yield from (str(item.kind) for item in list(self._core.mirror.objects.values()))

    def adapting(self) -> Adapting | None:
        return None if self._adaptation is None else Adapting(self._adaptation.about(), self._adaptation.rows(1))

    def looks(self, now: float) -> Iterator[Look]:
        yield Look.of(self._core.link, now)
