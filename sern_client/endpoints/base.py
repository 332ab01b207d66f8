"""The endpoint protocol: where messages come from and go to (ROS 1, ROS 2, a bag, a simulated robot).

An endpoint deals in *local* topic names and raw serialised bodies; namespaces, priorities and the link are not
its business. All calls happen on the event-loop thread; an endpoint with threads of its own hands over with
`call_soon_threadsafe`.
"""

from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, runtime_checkable

from sern_core.site.object_mirror import ObjectListener
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, ObjectKind, TopicName

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sern_runtime.metrics import Metrics
    from sern_twin.world.discrepancy import SeenDiscrepancy
    from sern_twin.world.grid import Grid
    from sern_twin.world.mesh import Mesh
    from sern_twin.world.patches import Cells
    from sern_twin.world.terrain import Terrain

GUARD_SUFFIX: Final = "_guard"
"""What the node of a client's guard (sern_client/guard.py) has behind the name of the client's own node. It publishes
the client's stop commands: its topics are no topics of this site."""

Sink = Callable[[bytes, int], bool]
"""`sink(body, stamp_ns) -> accepted`. False: refused (a reliable queue is full); the endpoint may hold the message
and offer it again (a bag can wait), or count it as lost (a live sensor cannot). `stamp_ns` is wall time."""


class TopicEvents(Protocol):
    """Told by the endpoint as topics come and go; calls are idempotent per topic name."""

    def topic_added(self, info: TopicInfo) -> None: ...

    def topic_removed(self, name: TopicName) -> None: ...


class BothTold:
    """`TopicEvents` of two who want to know; the second is told first when a topic goes."""

    def __init__(self, first: TopicEvents, second: TopicEvents) -> None:
        self._first = first
        self._second = second

    def topic_added(self, info: TopicInfo) -> None:
        self._first.topic_added(info)
        self._second.topic_added(info)

    def topic_removed(self, name: TopicName) -> None:
        self._second.topic_removed(name)
        self._first.topic_removed(name)


class Subscription(Protocol):
    def close(self) -> None: ...


class Publisher(Protocol):
    """Publishes on a local topic that came from the far side."""

    def publish(self, body: bytes, stamp_ns: int) -> None:
        """Publish a message; a counted drop once nobody can be reached any more (this or the endpoint is closed)."""
        ...

    def close(self) -> None: ...


@runtime_checkable
class AgingPublisher(Protocol):
    """A `Publisher` that may keep a message back for a moment."""

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        """Publish as `publish` does, and never later than in `left_s`, when the message is too old."""


@runtime_checkable
class AgedPublisher(Protocol):
    """A `Publisher` to which the age of a message matters."""

    def tell_age(self, age_s: float) -> None:
        """How old the message is that is published next: since its origin took it, without comparing clocks."""


def teller_of_age(publisher: Publisher) -> Callable[[float], None] | None:
    """`tell_age` of a publisher to which it matters; None: it does not."""
    return publisher.tell_age if isinstance(publisher, AgedPublisher) else None


PublishWithin = Callable[[bytes, int, float], None]


def publisher_within(publisher: Publisher) -> PublishWithin:
    """`publish_within` of any publisher: one that keeps nothing back need not know."""
    if isinstance(publisher, AgingPublisher):
        return publisher.publish_within
    return lambda body, stamp_ns, _left_s: publisher.publish(body, stamp_ns)


@dataclass(frozen=True, slots=True)
class Held:
    """What the user of an endpoint holds open there: how many of each, by local topic name."""

    publishers: Counter[TopicName] = field(default_factory=Counter)
    subscriptions: Counter[TopicName] = field(default_factory=Counter)

    def differences(self, here: "Held") -> list["Difference"]:
        """Where the endpoint's own tables, `here`, say otherwise."""
        return [
            Difference(name, f"{what}s held by the bridge: {held[name]}, known to the endpoint: {known[name]}", what)
            for what, held, known in (
                ("publisher", self.publishers, here.publishers),
                ("subscription", self.subscriptions, here.subscriptions),
            )
            for name in sorted(held.keys() | known.keys())
            if held[name] != known[name]
        ]


@dataclass(frozen=True, slots=True)
class Difference:
    """A local topic whose state is not what it is to be, and how, in a few words. `name` empty: all of them. `kind`
    publisher or subscription: of what the endpoint knows another number than is held open."""

    name: TopicName
    what: str
    kind: str = ""

    def __str__(self) -> str:
        return f"{self.name}: {self.what}" if self.name else self.what


class Endpoint(Protocol):
    """Life cycle: `start` once, any calls, `stop` once. `stop` flushes files and leaves nothing running.

    `subscribe` raises UsageError for a topic never announced through `TopicEvents`. `advertise` raises ConfigError
    with one line when the type cannot be published here. An endpoint never announces what it itself advertises.
    """

    async def start(self, events: TopicEvents) -> None: ...

    async def stop(self) -> None: ...

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription: ...

    def advertise(self, info: TopicInfo) -> Publisher: ...

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Whether anybody at the far side wants a topic announced from here; told on every change.

        A recording can wait for its audience; an endpoint that need not know does nothing.
        """

    def validate(self, held: Held) -> list[Difference]:
        """Compare what is `held` open here with the endpoint's own tables, and with what its middleware says as far as
        that is known. Something under way (a registration) may show as a difference for a moment. Cheap enough for once
        a minute; changes nothing.
        """
        ...

    @property
    def encoding(self) -> Encoding | None:
        """The one encoding that `advertise` takes; None: any. What comes in another is converted for it."""
        ...

    @property
    def exhausted(self) -> bool:
        """True when a finite source (a bag without loop) has offered all it has and all of it was accepted."""
        ...


@runtime_checkable
class CountingEndpoint(Protocol):
    """An endpoint that may drop messages on this site's side, before the link has them or after."""

    @property
    def drops(self) -> Mapping[DropReason, int]:
        """Messages it has dropped so far, by reason."""
        ...


@runtime_checkable
class MeasuredEndpoint(Protocol):
    """An endpoint with metrics of its own."""

    def register_metrics(self, metrics: "Metrics") -> None: ...


@runtime_checkable
class ServedEndpoint(Protocol):
    """An endpoint of which the client's HTTP server tells something."""

    @property
    def json_routes(self) -> Mapping[str, Callable[[], object]]:
        """What to serve, by path."""
        ...


class SiteObjects(Protocol):
    """The cross-reality objects of this client, and those of others that it subscribes to."""

    def put(
        self,
        object_id: str,
        kind: ObjectKind,
        type_name: str,
        *,
        value: bytes = b"",
        attributes: dict[str, str] | None = None,
        ros_stamp_ns: int | None = None,
    ) -> None:
        """Create or replace one of our own. UsageError, RefusedError: it is too large, or there are too many."""

    def delete(self, object_id: str) -> bool: ...

    def listen(self, listener: ObjectListener) -> None:
        """Have it told of changes of others' objects from now on."""


@runtime_checkable
class ObjectEndpoint(Protocol):
    """An endpoint with objects of its own."""

    def use_objects(self, objects: SiteObjects) -> None:
        """Take the site's objects. It is called once, before `start`."""


@runtime_checkable
class OfferingEndpoint(Protocol):
    """An endpoint that has no ROS behind it: what its client makes itself goes out to all sites as a topic of it."""

    @property
    def prefix(self) -> str:
        """The name under which its topics are."""
        ...

    def offer(self, info: TopicInfo) -> Publisher:
        """Announce a topic of its client. ConfigError: it has that name already."""
        ...


class SceneShown(Protocol):
    """A scene for whoever draws it."""

    @property
    def grid(self) -> "Grid": ...

    @property
    def ground(self) -> "Mesh | None":
        """The ground and what stands on it; None: it is not known."""
        ...

    @property
    def terrain(self) -> "Terrain | None":
        """The heights of the ground; None: they are not known."""
        ...

    @property
    def changes(self) -> int:
        """How often any block has changed: while it is the same, so are the cells."""
        ...

    def cells(self) -> "Cells":
        """All layers together, (rows, columns)."""
        ...

    def ages_s(self) -> "NDArray[np.float64]":
        """Seconds since each block was changed, (blocks,); NaN: it is as the map of the site has it."""
        ...

    def discrepancies(self) -> "tuple[SeenDiscrepancy, ...]":
        """Where scanners see something else than the twin has."""
        ...


@runtime_checkable
class ShowingEndpoint(Protocol):
    """An endpoint that may show people what its client knows. Both once, before `start`."""

    def show_link(self, words: Callable[[], str]) -> None:
        """What says in words how the link is now."""

    def show_scene(self, scene: SceneShown) -> None: ...


class TopicNews(NamedTuple):
    """How a topic of another site fares here, by its local name. `age_s`: how old its newest message is now, since its
    origin took it and without comparing clocks; None: none has come. `dropped`: its messages that did not come, by
    reason, since the client started. `capped_hz`: its origin thins it to this rate; None: it does not."""

    name: TopicName
    age_s: float | None
    dropped: Mapping[DropReason, int]
    capped_hz: float | None = None


class Viewed(Protocol):
    """What other sites have, for people who look at some of it. All of it on the event loop."""

    def want(self, name: TopicName, wanted: bool) -> None:
        """Somebody looks at a topic that was offered, by its local name, or nobody does any more. What is wanted is
        subscribed to over the link, and comes through `advertise` as every other topic."""

    def topics(self) -> Sequence[TopicNews]:
        """News of the topics that come here now."""
        ...


@runtime_checkable
class ViewingEndpoint(Protocol):
    """An endpoint at which people look at some of what there is, and nothing else need come."""

    def use_viewed(self, viewed: Viewed) -> None:
        """The client gives this once, before `start`."""

    def topic_offered(self, info: TopicInfo) -> None:
        """Another site has this topic, local name in `info`; again when it is described otherwise."""

    def topic_withdrawn(self, name: TopicName) -> None:
        """It is gone; nobody need say that it is not wanted any more."""


@runtime_checkable
class ViewingMembers(Protocol):
    """An endpoint of several, at some of which people look."""

    @property
    def viewers(self) -> Sequence[ViewingEndpoint]: ...


def viewers_of(endpoint: Endpoint) -> Sequence[ViewingEndpoint]:
    """Everything in an endpoint at which people look."""
    if isinstance(endpoint, ViewingMembers):
        return endpoint.viewers
    return [endpoint] if isinstance(endpoint, ViewingEndpoint) else []


KeptUpTo = Callable[[int, Mapping[int, DropReason]], None]
"""`told(upto, lost)`, on the event loop: of the messages that an endpoint has taken, all up to number `upto` are where
they are to be kept, but for those in `lost`, by number, which were dropped."""


@runtime_checkable
class KeepingEndpoint(Protocol):
    """An endpoint that keeps messages some time after `publish`: a recording, whose file is written in pieces."""

    @property
    def taken(self) -> int:
        """Messages that its publishers were given so far."""
        ...

    def watch_kept(self, told: KeptUpTo) -> None:
        """Whom to tell as well; before `start`."""
        ...

    def flush(self) -> None:
        """Keep what was taken so far now."""
        ...

    def keep_soon(self) -> None:
        """Somebody waits for what was taken so far: keep it, unless that would cost too much to be done often."""
        ...


@runtime_checkable
class KeepingMembers(Protocol):
    """An endpoint of several, of which some keep messages."""

    @property
    def keepers(self) -> Sequence[KeepingEndpoint]: ...


def keepers_of(endpoint: Endpoint) -> Sequence[KeepingEndpoint]:
    """Everything in an endpoint that keeps messages."""
    if isinstance(endpoint, KeepingMembers):
        return endpoint.keepers
    return [endpoint] if isinstance(endpoint, KeepingEndpoint) else []


@dataclass(frozen=True, slots=True)
class ServiceInfo:
    """A service of one side. `type_name` is `pkg/srv/Type`, `definition` its .srv text (request, `---`, response) or
    empty where nobody knows it, `type_hash` the md5sum (ROS 1) or RIHS01 hash (ROS 2), empty where unknown."""

    name: TopicName
    type_name: str
    encoding: Encoding
    type_hash: str
    definition: str = ""


ServiceHandler = Callable[[bytes], Awaitable[bytes]]
"""`await handler(request_body) -> response_body`; raises ServiceError, whose text the caller is shown."""


class ServiceEvents(Protocol):
    """Told by the endpoint as services of this side come and go; calls are idempotent per service name."""

    def service_added(self, info: ServiceInfo) -> None: ...

    def service_removed(self, name: TopicName) -> None: ...

    def wants_service(self, name: TopicName) -> bool:
        """Whether this site has a rule for it: what is wrong with other services is of no interest to anybody."""


class ServiceServer(Protocol):
    def close(self) -> None:
        """Withdraw the service; calls under way fail."""


@runtime_checkable
class ServiceEndpoint(Protocol):
    """An endpoint that also knows services. `watch_services` is called once, before or after `start`.

    `call` raises ServiceError when there is no such service, it answers with an error, or `timeout_s` passes. `serve`
    raises ConfigError with one line when the type cannot be served here; its own services are never announced.
    """

    @property
    def encoding(self) -> Encoding | None:
        """The encoding of bodies here, as in `Endpoint.encoding`."""

    def watch_services(self, events: ServiceEvents) -> None: ...

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes: ...

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer: ...


@runtime_checkable
class KnowsServiceTypes(Protocol):
    """An endpoint that may know definitions that do not come with a service (`type_paths`)."""

    def service_definition(self, type_name: str, encoding: Encoding) -> str | None:
        """Its .srv text and the types it uses, as they are in `encoding`; None where unknown. ConfigError for files
        that cannot be read."""
