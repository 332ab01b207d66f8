"""Topics of other sites that come here while somebody looks at them, and no longer.

The relay tells which topics there are, as objects without values. An endpoint at which people look is offered those
that match `on_demand`; what somebody looks at is subscribed to by name. So a topic that nobody looks at costs the link
its description, once.
"""

import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from math import inf
from typing import Final

from sern_client.endpoints.base import TopicNews, ViewingEndpoint
from sern_client.site import CAPPED, Site
from sern_core.objects.xr_object import XrObject
from sern_core.site.services import parse as parse_service
from sern_core.topics.patterns import PatternSet
from sern_core.topics.spool_names import parse as parse_spooled
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.ledger import OTHER_TOPIC, ReceiveLedger
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Durability, Encoding, Reliability, TopicName
from sern_runtime import clock
from sern_runtime.loop import Timer

MAX_WANTED: Final = 2_048
"""Topics that are asked for by name, those first that were wanted first."""
TOGETHER_S: Final = 0.01
"""Wants so near to each other are told together."""

_log = logging.getLogger(__name__)


class OnDemand:
    """The `ObjectListener` of a client with `on_demand`. `add(names)` asks for these global names in place of those
    before; `ledger` counts what comes."""

    def __init__(
        self,
        patterns: PatternSet,
        site: Site,
        viewers: Sequence[ViewingEndpoint],
        *,
        add: Callable[[Iterable[TopicName]], None],
        ledger: ReceiveLedger,
    ) -> None:
        self._patterns = patterns
        self._site = site
        self._viewers = viewers
        self._add = add
        self._ledger = ledger
        self._capped_hz: dict[TopicName, float | None] = {}  # of them, by global name
        self._offered: dict[str, tuple[TopicName, TopicInfo]] = {}  # by the object: global name, and what it is here
        self._wants: dict[TopicName, set[int]] = {}  # local names, by the viewers that want them
        self._told: list[TopicName] = []
        self._complained = False
        self._timer = Timer(self._tell)
        for index, viewer in enumerate(viewers):
            viewer.use_viewed(_Viewer(self, index))

    def close(self) -> None:
        self._timer.close()

    # What there is

    def changed(self, item: XrObject) -> None:
        """There is an object, or it is described otherwise. One without encoding is no topic: a transform names the
        topic that it came by."""
        name = TopicName(item.attributes.get("topic", ""))
        if (
            not name
            or "encoding" not in item.attributes
            or parse_service(name) is not None
            or parse_spooled(name) is not None
            or not self._patterns.fullmatch(name)
        ):
            return
        info = self._described(name, item)
        before = self._offered.get(item.id)
        if info is None or (before is not None and before[1].name != info.name):
            self.deleted(item.id)
        if info is not None:
            self._offered[item.id] = name, info
            self._capped_hz[name] = _rate(item.attributes.get(CAPPED, ""))
            self._each(lambda viewer: viewer.topic_offered(info))
            if info.name in self._wants:
                self._soon()

    def deleted(self, object_id: str) -> None:
        offered = self._offered.pop(object_id, None)
        if offered is not None:
            self._capped_hz.pop(offered[0], None)
            name = offered[1].name
            self._each(lambda viewer: viewer.topic_withdrawn(name))
            self._soon()

    def _described(self, name: TopicName, item: XrObject) -> TopicInfo | None:
        """A topic as it is called here; None: it does not come here, or says of itself what nobody understands."""
        attributes = item.attributes
        local = self._site.rules.inward(name, namespace=self._site.namespace)
        try:
            info = TopicInfo(
                local,
                item.type_name,
                Encoding(attributes["encoding"]),
                item.definition_hash,
                item.definition,
                latched=attributes.get("durability") == Durability.TRANSIENT_LOCAL.value,
                reliable=attributes.get("reliability") == Reliability.RELIABLE.value,
            )
            receives = self._site.rules.resolve(info, local_name=local).direction.receives
        except (SernError, ValueError) as error:
            _log.warning("%s of %s is not offered to viewers: %s", name, item.owner, error)
            return None
        return info if receives else None

    def _each(self, call: Callable[[ViewingEndpoint], None]) -> None:
        """Tell all viewers, also where one fails, whose failure is raised then."""
        with ExitStack() as stack:
            for viewer in self._viewers:
                stack.callback(call, viewer)

    # What is wanted

    def want(self, viewer: int, name: TopicName, *, wanted: bool) -> None:
        if wanted:
            self._wants.setdefault(name, set()).add(viewer)
        else:
            those = self._wants.get(name, set())
            those.discard(viewer)
            if not those:
                self._wants.pop(name, None)
        self._soon()

    def topics(self) -> list[TopicNews]:
        """How those that come here fare."""
        now = clock.now()
        rules, namespace = self._site.rules, self._site.namespace
        return [
            TopicNews(
                rules.inward(name, namespace=namespace),
                counters.age_of_information_s(now),
                counters.by_reason,
                self._capped_hz.get(name),
            )
            for name, counters in self._ledger.topics.items()
            if name != OTHER_TOPIC
        ]

    def _soon(self) -> None:
        if self._timer.deadline_s is None:
            self._timer.arm(clock.now() + TOGETHER_S)

    def _tell(self) -> None:
        called = {info.name: name for name, info in self._offered.values()}
        wanted = [called[name] for name in self._wants if name in called]
        if len(wanted) > MAX_WANTED and not self._complained:
            self._complained = True
            _log.warning("viewers want %d topics; the first %d of them come", len(wanted), MAX_WANTED)
        del wanted[MAX_WANTED:]
        if wanted != self._told:
            self._told = wanted
            self._add(wanted)


def _rate(text: str) -> float | None:
    """A rate as an origin says it; None: it says none, or what is none."""
    try:
        rate_hz = float(text)
    except ValueError:
        return None
    return rate_hz if 0.0 < rate_hz < inf else None


class _Viewer:
    """`Viewed` of one endpoint."""

    def __init__(self, owner: OnDemand, index: int) -> None:
        self._want = partial(owner.want, index)
        self.topics = owner.topics

    def want(self, name: TopicName, wanted: bool) -> None:
        self._want(name, wanted=wanted)
