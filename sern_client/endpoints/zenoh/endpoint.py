"""ROS 2 through zenoh, as rmw_zenoh does it: no ROS installation, bodies pass through as they are.

The graph is what liveliness tokens say (`names`). A topic exists here while some other session has a publisher of it;
services likewise. Our own session's entities are left out, so that what is published here does not come back.
Publishers whose type or hash differs from the topic's first one are left out, with one line that names both.
"""

import asyncio
import itertools
import logging
import secrets
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

from sern_client.endpoints.base import GUARD_SUFFIX, Difference, Held, Publisher, Sink, Subscription, TopicEvents
from sern_client.endpoints.common.first import LEARN_S, FirstMessages, Readers
from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh.names import Entity, Kind, Qos
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.endpoints.zenoh.services import Services
from sern_client.endpoints.zenoh.session import MAX_WAITING_BYTES, ZenohSession
from sern_core.vocabulary.errors import ConfigError, UsageError, WireError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.outages import Outages
from sern_runtime.ros_files import TypeFiles

CDR: Final = "application/cdr"
ROUTER_WAIT_S: Final = 3.0
"""After so long without a router and without a peer we say so."""
LOOK_S: Final = 1.0
"""How often it is looked whether there is one."""
MAX_COMPLAINTS: Final = 256
FIRST_MESSAGES: Final = 100
"""Messages of a reliable topic that may wait for its first subscribers."""

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Topic:
    """A topic of others: publishers by their key in the graph, the first one's type holds."""

    dds_type: str
    type_hash: str
    publishers: dict[str, Qos] = field(default_factory=dict)


class ZenohEndpoint(Services):
    """An `Endpoint` and a `ServiceEndpoint`."""

    def __init__(self, options: ZenohOptions) -> None:
        super().__init__()
        self.options = options
        self.types = TypeFiles(options.type_paths)
        self.session = ZenohSession(options.session)
        self._events: TopicEvents | None = None
        self._entities = itertools.count(1)
        self._topics: dict[TopicName, _Topic] = {}
        self._left_out: dict[TopicName, dict[str, Entity]] = {}  # publishers of another type, by their key
        self._subscribers: dict[TopicName, dict[str, tuple[str, str]]] = {}  # of others: their types by their keys
        self._first_dropped: Counter[DropReason] = Counter()
        self._started_s = 0.0
        self._open: list[_Declared] = []
        self._said: set[str] = set()
        self._look_again: asyncio.TimerHandle | None = None
        self._outages = Outages(_log, logging.WARNING, after_s=ROUTER_WAIT_S)

    @property
    def encoding(self) -> Encoding | None:
        return Encoding.CDR

    @property
    def exhausted(self) -> bool:
        return False

    @property
    def drops(self) -> dict[DropReason, int]:
        """Messages dropped between zenoh and us: one side was behind the other, or the session had ended."""
        counted = {
            DropReason.QUEUE_FULL: self.session.put_dropped + (self.session.handover.dropped if self._events else 0),
            DropReason.DISCONNECTED: self.session.put_failed,
        }
        return {reason: count for reason, count in (Counter(counted) + self._first_dropped).items() if count}

    async def start(self, events: TopicEvents) -> None:
        """ConfigError when zenoh does not take the settings. A router that is not there yet is waited for."""
        await self.session.open()
        self._events = events
        self._loop = asyncio.get_running_loop()
        self._started_s = self._loop.time()
        try:
            self._join()
        except self.session.zenoh.ZError as error:
            await self.session.close()
            raise ConfigError(f"zenoh: {ros_types.one_line(error)}") from None
        self._look_for_others()

    def _join(self) -> None:
        session = self.session.opened
        self._zid = self.session.zid
        self._node = session.liveliness().declare_token(
            names.node_token(self.options.domain, self._zid, self.options.node_name)
        )
        # `history`: what is there already is told first.
        self._graph = session.liveliness().declare_subscriber(
            f"{names.SPACE}/{self.options.domain}/**", self._token, history=True
        )

    def _look_for_others(self) -> None:
        """Say that nobody is there, and when somebody is again."""
        info, there = self.session.opened.info, ", ".join(self.session.connect) or "the locators we listen on"
        self._outages.look(
            there, lost=not info.routers_zid() and not info.peers_zid(), now=clock.now(),
            gone=f"nobody answers at {there}; is the router (rmw_zenohd) running there? Trying again until it works",
            back=f"somebody answers at {there} now",
        )  # fmt: skip
        self._look_again = self._loop.call_later(LOOK_S, self._look_for_others)

    async def stop(self) -> None:
        if self._look_again is not None:
            self._look_again.cancel()
        for declared in list(self._open):
            declared.close()
            declared.hurry()
        await self.end_services()
        await self.session.close()

    def interest(self, name: TopicName, wanted: bool) -> None:
        """A subscription costs nothing while nobody publishes."""

    # --- topics of others -------------------------------------------------------------------------------------------

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        topic = self._topics.get(name)
        if topic is None:
            raise UsageError(f"{name}: no such topic was announced")
        qos = _offered(topic)
        key = names.data_key(self.options.domain, name, topic.dds_type, topic.type_hash)
        session, zenoh = self.session, self.session.zenoh

        def arrived(sample: Any) -> None:
            body = sample.payload.to_bytes()
            attachment = None if sample.attachment is None else sample.attachment.to_bytes()
            session.handover.put(lambda: deliver(body, attachment), len(body) + len(attachment or b""))

        def deliver(body: bytes, attachment: bytes | None) -> None:
            if declared.closed:
                return
            try:
                stamp_ns = time.time_ns() if attachment is None else names.unpack_attachment(attachment).stamp_ns
            except WireError as error:
                self._say_once(f"{name}: {error}; its messages are stamped on arrival")
                stamp_ns = time.time_ns()
            sink(body, stamp_ns)

        if qos.transient_local:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth)
            subscriber = zenoh.ext.declare_advanced_subscriber(
                session.opened, key, arrived, history=history, allowed_origin=zenoh.Locality.REMOTE
            )
        else:
            subscriber = session.opened.declare_subscriber(key, arrived, allowed_origin=zenoh.Locality.REMOTE)
        token = self._declare_token(Kind.SUBSCRIPTION, name, topic.dds_type, topic.type_hash, qos)
        declared = _Declared(self, name, token, subscriber)
        return declared

    def advertise(self, info: TopicInfo) -> Publisher:
        dds_name = names.dds_type(ros_types.canonical(info.type_name))
        type_hash = info.type_hash or self._hash_of(info)
        known = self._topics.get(info.name)
        if known is not None and (known.dds_type, known.type_hash) != (dds_name, type_hash):
            raise ConfigError(
                f"{info.name}: what comes is {info.type_name} {type_hash}, "
                f"nodes here publish {names.ros_type(known.dds_type)} {known.type_hash}"
            )
        qos = Qos(info.reliable is not False, info.latched)
        zenoh = self.session.zenoh
        key = names.data_key(self.options.domain, info.name, dds_name, type_hash)
        blocking = zenoh.CongestionControl.BLOCK if qos.reliable else zenoh.CongestionControl.DROP
        if info.latched:
            publisher = zenoh.ext.declare_advanced_publisher(
                self.session.opened, key, encoding=CDR, congestion_control=blocking,
                cache=zenoh.ext.CacheConfig(max_samples=qos.depth), publisher_detection=True,
            )  # fmt: skip
        else:
            publisher = self.session.opened.declare_publisher(key, encoding=CDR, congestion_control=blocking)
        token = self._declare_token(Kind.PUBLISHER, info.name, dds_name, type_hash, qos)
        return _ZenohPublisher(
            self,
            info,
            token,
            publisher,
            None if info.latched else lambda: self._readers(info.name, dds_name, type_hash),
        )

    def _readers(self, name: TopicName, dds_name: str, type_hash: str) -> int:
        """How many subscribers of others the graph knows."""
        return sum(kind == (dds_name, type_hash) for kind in self._subscribers.get(name, {}).values())

    @property
    def learning_s(self) -> float:
        """How much longer the graph may be incomplete."""
        return max(0.0, self._started_s + LEARN_S - self._loop.time())

    def drop_first(self, why: DropReason) -> None:
        """Count a message that waited for its first subscribers in vain."""
        self._first_dropped[why] += 1

    def validate(self, held: Held) -> list[Difference]:
        """Without the thread that writes nothing is published: that is a difference of every topic."""
        here = Held()
        for declared in self._open:
            if isinstance(declared, _ZenohPublisher) and declared.ending:
                continue  # until its first messages are written
            (here.publishers if isinstance(declared, _ZenohPublisher) else here.subscriptions)[declared.name] += 1
        found = held.differences(here)
        if (problem := self.session.problem) is not None:
            found.append(Difference(TopicName(""), problem))
        return found

    def _hash_of(self, info: TopicInfo) -> str:
        definition = info.definition or self.types.message(info.type_name)
        if not definition:
            raise ConfigError(
                f"{info.name}: neither hash nor definition of {info.type_name} is known; "
                "add the directory of its .msg file to type_paths"
            )
        return ros_types.hash_of(info.type_name, definition, Encoding.CDR)

    # --- the graph --------------------------------------------------------------------------------------------------

    def _token(self, sample: Any) -> None:
        """Runs in a thread of zenoh's."""
        key, alive = str(sample.key_expr), sample.kind == self.session.zenoh.SampleKind.PUT
        self.session.handover.news(lambda: self._token_changed(key, alive))

    def _token_changed(self, key: str, alive: bool) -> None:
        try:
            entity = names.parse_token(key)
            if entity.session == self._zid or entity.node == f"/{self.options.node_name}{GUARD_SUFFIX}":
                return
            if entity.kind is Kind.PUBLISHER:
                if alive:
                    self._publisher_appeared(entity)
                else:
                    self._publisher_went(entity)
            elif entity.kind is Kind.SUBSCRIPTION:
                there = self._subscribers.setdefault(entity.name, {})
                there.pop(entity.key, None)
                if alive:
                    there[entity.key] = entity.dds_type, entity.type_hash
                elif not there:
                    del self._subscribers[entity.name]
            elif entity.kind is Kind.SERVER:
                self.server_changed(entity, alive)
        except (WireError, ConfigError) as error:
            self._say_once(str(error))

    def _publisher_appeared(self, entity: Entity) -> None:
        assert self._events is not None
        qos = Qos.decode(entity.qos)
        type_name = names.ros_type(entity.dds_type)
        topic = self._topics.get(entity.name)
        if topic is None:
            topic = self._topics[entity.name] = _Topic(entity.dds_type, entity.type_hash)
        elif (topic.dds_type, topic.type_hash) != (entity.dds_type, entity.type_hash):
            self._left_out.setdefault(entity.name, {})[entity.key] = entity
            raise ConfigError(
                f"{entity.name}: {entity.node} publishes {type_name} {entity.type_hash}, others "
                f"{names.ros_type(topic.dds_type)} {topic.type_hash}; {entity.node} is left out"
            )
        first = not topic.publishers
        topic.publishers[entity.key] = qos
        if first:
            self._events.topic_added(
                TopicInfo(
                    entity.name, type_name, Encoding.CDR, entity.type_hash, self._definition(entity, type_name),
                    qos.transient_local, qos.reliable,
                )
            )  # fmt: skip

    def _publisher_went(self, entity: Entity) -> None:
        assert self._events is not None
        left_out = self._left_out.get(entity.name, {})
        left_out.pop(entity.key, None)
        if not left_out:
            self._left_out.pop(entity.name, None)
        topic = self._topics.get(entity.name)
        if topic is None or topic.publishers.pop(entity.key, None) is None or topic.publishers:
            return
        del self._topics[entity.name]
        self._events.topic_removed(entity.name)
        for other in self._left_out.pop(entity.name, {}).values():  # now it is their turn
            try:
                self._publisher_appeared(other)
            except ConfigError as error:
                self._say_once(str(error))

    def _definition(self, entity: Entity, type_name: str) -> str:
        """Empty where unknown: bytes pass through all the same, only conversion needs it."""
        definition = self.types.message(type_name)
        if definition is None:
            self._say_once(
                f"{type_name}: its definition is not known; {entity.name} passes as it is and cannot be converted or "
                "recorded; add the directory of its .msg file to type_paths"
            )
            return ""
        mine = ros_types.hash_of(type_name, definition, Encoding.CDR)
        if entity.type_hash.startswith("RIHS01_") and entity.type_hash != mine:
            self._say_once(
                f"{entity.name}: {entity.node} has {type_name} with hash {entity.type_hash}, here it is {mine}; "
                "its definition is left out"
            )
            return ""
        return definition

    # --- for the parts of this package ------------------------------------------------------------------------------

    def _declare_token(self, kind: Kind, name: TopicName, dds_name: str, type_hash: str, qos: Qos) -> Any:
        return self.session.opened.liveliness().declare_token(
            names.entity_token(
                self.options.domain, self._zid, next(self._entities), kind, self.options.node_name,
                name=name, dds_name=dds_name, type_hash=type_hash, qos=qos,
            )
        )  # fmt: skip

    def _say_once(self, text: str) -> None:
        if text not in self._said and len(self._said) < MAX_COMPLAINTS:
            self._said.add(text)
            _log.warning("%s", text)

    def opened(self, declared: "_Declared") -> None:
        self._open.append(declared)

    def closed(self, declared: "_Declared") -> None:
        if declared in self._open:
            self._open.remove(declared)


class _Declared:
    """Something declared in the session, with its token."""

    def __init__(self, owner: ZenohEndpoint, name: TopicName, token: Any, thing: Any) -> None:
        self.closed = False
        self.name = name
        self._owner = owner
        self._token = token
        self._thing = thing
        owner.opened(self)

    def hurry(self) -> None:
        """Be closed now, if it is to be."""

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        self._owner.closed(self)
        token, thing = self._token, self._thing

        def undeclare() -> None:
            try:
                thing.undeclare()
            finally:  # or the graph would name it for ever
                token.undeclare()

        self._owner.session.put(undeclare, 0)  # after what it has still to send


class _ZenohPublisher(_Declared):
    """An `AgingPublisher`. `known` says how many subscribers the graph knows; None: whoever comes later gets what it
    has missed from a cache."""

    def __init__(
        self, owner: ZenohEndpoint, info: TopicInfo, token: Any, publisher: Any, known: Callable[[], int] | None
    ) -> None:
        super().__init__(owner, info.name, token, publisher)
        self._publisher = publisher
        self._gid = secrets.token_bytes(names.GID_BYTES)
        self._seq = itertools.count(1)
        self._known = known
        self.ending = False
        """It takes no more, and is closed when its first messages are written."""
        best_effort = info.reliable is False
        self._first: FirstMessages | None = None
        if known is not None:
            self._first = FirstMessages(
                info.name,
                readers=self._readers,
                write=self._put,
                dropped=owner.drop_first,
                max_messages=(info.depth or 1) if best_effort else FIRST_MESSAGES,
                max_bytes=MAX_WAITING_BYTES,
                overflow=DropReason.SUPERSEDED if best_effort else DropReason.QUEUE_FULL,
                learning_s=owner.learning_s,
            )

    def _readers(self) -> Readers:
        known = 0 if self._known is None else self._known()
        try:
            matching = known and self._publisher.matching_status.matching
        except self._owner.session.zenoh.ZError:
            matching = False  # the session has ended
        return Readers(known, known if matching else 0)

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self.publish_within(body, stamp_ns, inf)

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        if self.closed or self.ending:
            self._owner.session.refused()
        elif self._first is None or self._first.over:
            self._put(body, stamp_ns)
        else:
            self._first.publish(body, stamp_ns, left_s)

    def _put(self, body: bytes, stamp_ns: int) -> None:
        attachment = names.pack_attachment(next(self._seq), stamp_ns, self._gid)
        publisher = self._publisher
        put: Callable[[], None] = lambda: publisher.put(body, attachment=attachment)  # noqa: E731
        self._owner.session.put(put, len(body))

    def close(self) -> None:
        """What was published before is still written: the last of it may be a stop command."""
        if not self.ending:
            self.ending = True
            if self._first is None:
                super().close()
            else:
                self._first.end(super().close)

    def hurry(self) -> None:
        if self._first is not None:
            self._first.close()


def _offered(topic: _Topic) -> Qos:
    """What to ask for: what any of the publishers offers."""
    offers = topic.publishers.values()
    return Qos(
        any(qos.reliable for qos in offers),
        any(qos.transient_local for qos in offers),
        max((qos.depth for qos in offers), default=names.DEFAULT_DEPTH),
    )
