"""Several endpoints as one: topics from any of them, publications to all that accept them."""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import inf
from typing import Final

from sern_client.endpoints.base import (
    CountingEndpoint,
    Difference,
    Endpoint,
    Held,
    KeepingEndpoint,
    Publisher,
    PublishWithin,
    ServiceEndpoint,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    ServiceServer,
    Sink,
    Subscription,
    TopicEvents,
    ViewingEndpoint,
    publisher_within,
)
from sern_client.endpoints.conversion import Converter, serve
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, TopicName

AGAIN_S: Final = 1.0
"""A member that cannot take a topic because of another one may be able to so long after that has ended."""

_LOG = logging.getLogger(__name__)


def close_all(closes: Sequence[Callable[[], None]]) -> None:
    """Call each of them, the last first, also when one fails; its failure is raised then."""
    with ExitStack() as stack:
        for close in closes:
            stack.callback(close)


@dataclass(slots=True, eq=False)
class _Joined:
    """One subscription of the daemon: a subscription at every member that gives the topic."""

    name: TopicName
    sink: Sink
    owner: "CompositeEndpoint"
    parts: dict[int, Subscription] = field(default_factory=dict)

    def close(self) -> None:
        self.owner.forget(self)
        parts, self.parts = self.parts, {}
        close_all([part.close for part in parts.values()])


class _Members:
    """The `TopicEvents` handed to one member."""

    def __init__(self, owner: "CompositeEndpoint", index: int) -> None:
        self._owner = owner
        self._index = index

    def topic_added(self, info: TopicInfo) -> None:
        self._owner.member_added(self._index, info)

    def topic_removed(self, name: TopicName) -> None:
        self._owner.member_removed(self._index, name)


class _Publishers:
    """One publisher of the daemon: a publisher at every member that takes the topic, by the member's index."""

    def __init__(self, owner: "CompositeEndpoint", info: TopicInfo) -> None:
        self.info = info
        self.name = info.name
        self.parts: dict[int, Publisher] = {}
        self.closed = False
        self._owner = owner
        self._within: list[PublishWithin] = []

    def add(self, index: int, publisher: Publisher) -> None:
        self.parts[index] = publisher
        self._within.append(publisher_within(publisher))

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self.publish_within(body, stamp_ns, inf)

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        """Also to the others where one of them fails, whose failure is raised then."""
        failure: Exception | None = None
        for publish in self._within:
            try:
                publish(body, stamp_ns, left_s)
            except Exception as error:  # noqa: BLE001  raised below
                failure = failure or error
        if failure is not None:
            raise failure

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            try:
                close_all([publisher.close for publisher in self.parts.values()])
            finally:
                self._owner.closed(self)


class _ServiceMembers:
    """The `ServiceEvents` handed to one member."""

    def __init__(self, owner: "CompositeEndpoint", member: ServiceEndpoint) -> None:
        self._owner = owner
        self._member = member

    def service_added(self, info: ServiceInfo) -> None:
        self._owner.service_added(self._member, info)

    def service_removed(self, name: TopicName) -> None:
        self._owner.service_removed(self._member, name)

    def wants_service(self, name: TopicName) -> bool:
        return self._owner.wants_service(name)


class _Servers:
    def __init__(self, servers: list[ServiceServer]) -> None:
        self._servers = servers

    def close(self) -> None:
        for server in self._servers:
            server.close()


class CompositeEndpoint:
    """An `Endpoint` made of others, which it starts and stops.

    A topic that several members give is announced once, as the first of them describes it, and removed with the last;
    a member that gives it with another type or encoding is left out of it, with a warning. `no_services_of`: members
    that have topics only, since the services of their nodes are another member's. `no_topics_of`: members that have
    services only.
    """

    def __init__(
        self,
        endpoints: Sequence[Endpoint],
        *,
        no_services_of: Sequence[Endpoint] = (),
        no_topics_of: Sequence[Endpoint] = (),
    ) -> None:
        if not endpoints:
            raise UsageError("a composite endpoint needs at least one member")
        self.converter = Converter()
        self._members = list(endpoints)
        self._topics_only = list(no_services_of)
        self._publishing = {
            index: member for index, member in enumerate(endpoints) if not any(member is one for one in no_topics_of)
        }
        self._events: TopicEvents | None = None
        self._started: list[Endpoint] = []
        self._providers: dict[TopicName, dict[int, TopicInfo]] = {}  # members in the order they announced
        self._left_out: dict[TopicName, dict[int, TopicInfo]] = {}  # members that give it with another type
        self._joined: list[_Joined] = []
        self._unwanted: set[TopicName] = set()  # at the far side; a member that joins later is told
        self._opened: list[_Publishers] = []
        self._service_events: ServiceEvents | None = None
        self._servers: dict[TopicName, list[ServiceEndpoint]] = {}  # members in the order they announced

    async def start(self, events: TopicEvents) -> None:
        """Starts the members in order; if one fails, those already started are stopped and its error is raised."""
        self._events = events
        try:
            for index, member in enumerate(self._members):
                await member.start(_Members(self, index))
                self._started.append(member)
        except BaseException:
            await self.stop()
            raise

    async def stop(self) -> None:
        """Stops every member, the last first, also when one of them fails; then raises the first failure."""
        failure: Exception | None = None
        while self._started:
            try:
                await self._started.pop().stop()
            except Exception as error:  # noqa: BLE001  the others must be stopped too; raised below
                failure = failure or error
        if failure is not None:
            raise failure

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        if name not in self._providers:
            raise UsageError(f"{name}: no endpoint announced such a topic")
        joined = _Joined(name, sink, self)
        self._joined.append(joined)
        for index in self._providers[name]:
            self._subscribe(joined, index)
        return joined

    def _subscribe(self, joined: _Joined, index: int) -> None:
        joined.parts[index] = self._members[index].subscribe(joined.name, joined.sink)
        if joined.name in self._unwanted:
            self._members[index].interest(joined.name, False)

    def advertise(self, info: TopicInfo) -> Publisher:
        """Advertise a topic at every member that takes it. ConfigError, with every reason, when none does."""
        publishers = _Publishers(self, info)
        with ExitStack() as failed:
            failed.callback(publishers.close)
            refusals = self._offer(publishers)
            failed.pop_all()
        if publishers.parts:
            self._opened.append(publishers)
            for refusal in refusals:
                _LOG.info("%s is not published everywhere: %s", info.name, refusal)
            return publishers
        if len(refusals) == 1:
            raise refusals[0]
        if not refusals:
            raise ConfigError(f"{info.name}: the endpoints here have services only")
        raise ConfigError("; ".join(dict.fromkeys(str(error) for error in refusals)))

    def _offer(self, publishers: _Publishers) -> list[ConfigError]:
        """Offer the topic to the members that have it not yet; returns the refusals of those that do not take it."""
        refusals: list[ConfigError] = []
        for index, member in self._publishing.items():
            if index not in publishers.parts:
                try:
                    publishers.add(index, self.converter.advertise(member, publishers.info))
                except ConfigError as error:
                    refusals.append(error)
        return refusals

    def closed(self, publishers: _Publishers) -> None:
        """One is no more: a member that refused another of its name, for its sake, may take that now."""
        if publishers in self._opened:
            self._opened.remove(publishers)
            if any(len(other.parts) < len(self._publishing) for other in self._opened if other.name == publishers.name):
                loop = asyncio.get_running_loop()
                loop.call_soon(self._offer_again, publishers.name)
                loop.call_later(AGAIN_S, self._offer_again, publishers.name)

    def _offer_again(self, name: TopicName) -> None:
        for publishers in [each for each in self._opened if each.name == name]:
            self._offer(publishers)

    def interest(self, name: TopicName, wanted: bool) -> None:
        providers = self._providers.get(name, {})
        if providers:
            (self._unwanted.discard if wanted else self._unwanted.add)(name)
        for index in providers:
            self._members[index].interest(name, wanted)

    def validate(self, held: Held) -> list[Difference]:
        """Also of each member, with what is held open there."""
        publishers = Counter(opened.name for opened in self._opened)
        found = held.differences(Held(publishers, Counter(joined.name for joined in self._joined)))
        for index, member in enumerate(self._members):
            found += member.validate(
                Held(
                    Counter(opened.name for opened in self._opened if index in opened.parts),
                    Counter(joined.name for joined in self._joined if index in self._providers.get(joined.name, ())),
                )
            )
        return found

    @property
    def encoding(self) -> None:
        """Each member says for itself."""
        return None

    @property
    def drops(self) -> dict[DropReason, int]:
        """Those of all members."""
        total: Counter[DropReason] = Counter()
        for member in self._members:
            if isinstance(member, CountingEndpoint):
                total.update(member.drops)
        return total

    @property
    def keepers(self) -> list[KeepingEndpoint]:
        """The members that keep messages."""
        return [member for member in self._members if isinstance(member, KeepingEndpoint)]

    @property
    def viewers(self) -> list[ViewingEndpoint]:
        """The members at which people look."""
        return [member for member in self._members if isinstance(member, ViewingEndpoint)]

    @property
    def exhausted(self) -> bool:
        return all(member.exhausted for member in self._members)

    # Services: called at the first member that has them, served at every member that takes them

    def watch_services(self, events: ServiceEvents) -> None:
        """ConfigError when no member knows services."""
        members = self._service_members()
        if not members:
            raise ConfigError("none of the endpoints has services; leave the section `services` out")
        self._service_events = events
        for member in members:
            member.watch_services(_ServiceMembers(self, member))

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        owners = self._servers.get(name)
        if not owners:
            raise ServiceError(f"no service {name}")
        return await owners[0].call(name, request, timeout_s=timeout_s)

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        """ConfigError, with every reason, when no member takes it."""
        servers: list[ServiceServer] = []
        refusals: list[str] = []
        for member in self._service_members():
            try:
                servers.append(serve(member, info, handler))
            except ConfigError as error:
                refusals.append(str(error))
        if not servers:
            raise ConfigError("; ".join(dict.fromkeys(refusals)) or f"no endpoint serves {info.name}")
        return _Servers(servers)

    @property
    def has_services(self) -> bool:
        """Whether any member knows services. Without one `watch_services` is an error."""
        return bool(self._service_members())

    def _service_members(self) -> list[ServiceEndpoint]:
        """Compared by identity: endpoints are none but themselves."""
        with_services = [member for member in self._members if isinstance(member, ServiceEndpoint)]
        return [each for each in with_services if not any(each is one for one in self._topics_only)]

    # For the parts of this module

    def service_added(self, member: ServiceEndpoint, info: ServiceInfo) -> None:
        assert self._service_events is not None
        owners = self._servers.setdefault(info.name, [])
        if member not in owners:
            owners.append(member)
        if len(owners) == 1:
            self._service_events.service_added(info)

    def service_removed(self, member: ServiceEndpoint, name: TopicName) -> None:
        assert self._service_events is not None
        owners = self._servers.get(name, [])
        if member in owners:
            owners.remove(member)
            if not owners:
                del self._servers[name]
                self._service_events.service_removed(name)

    def wants_service(self, name: TopicName) -> bool:
        return self._service_events is not None and self._service_events.wants_service(name)

    def member_added(self, index: int, info: TopicInfo) -> None:
        assert self._events is not None
        providers = self._providers.setdefault(info.name, {})
        if not providers or set(providers) == {index}:
            providers[index] = info
            self._events.topic_added(info)
            return
        first = next(iter(providers.values()))
        if (info.type_name, info.encoding) != (first.type_name, first.encoding):
            _LOG.warning(
                "%s: two endpoints give it, as %s (%s) and as %s (%s); the second is left out",
                info.name, first.type_name, first.encoding, info.type_name, info.encoding,
            )  # fmt: skip
            self._left_out.setdefault(info.name, {})[index] = info
            return
        known = index in providers
        providers[index] = info
        for joined in self._joined:
            if joined.name == info.name and not known:
                self._subscribe(joined, index)

    def member_removed(self, index: int, name: TopicName) -> None:
        assert self._events is not None
        left_out = self._left_out.get(name, {})
        left_out.pop(index, None)
        if not left_out:
            self._left_out.pop(name, None)
        providers = self._providers.get(name, {})
        if providers.pop(index, None) is None:
            return
        for joined in self._joined:
            if joined.name == name and (part := joined.parts.pop(index, None)) is not None:
                part.close()
        if not providers:
            del self._providers[name]
            self._unwanted.discard(name)
            self._events.topic_removed(name)
            for other, info in self._left_out.pop(name, {}).items():  # now it is their turn
                self.member_added(other, info)

    def forget(self, joined: _Joined) -> None:
        if joined in self._joined:
            self._joined.remove(joined)


def with_services(endpoint: Endpoint) -> ServiceEndpoint | None:
    """The endpoint, if it knows services itself or has a member that does."""
    if isinstance(endpoint, CompositeEndpoint) and not endpoint.has_services:
        return None
    return endpoint if isinstance(endpoint, ServiceEndpoint) else None
