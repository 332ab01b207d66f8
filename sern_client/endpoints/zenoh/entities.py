"""Topics on their way to the link, and on their way from it."""

import itertools
import secrets
import time
from collections.abc import Callable
from math import inf
from typing import Any, Final, Protocol

from sern_client.endpoints.base import Sink
from sern_client.endpoints.common.first import FirstMessages, Readers
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh.names import Kind, Qos
from sern_client.endpoints.zenoh.node import Declared, Node
from sern_client.endpoints.zenoh.session import MAX_WAITING_BYTES
from sern_core.vocabulary.errors import ConfigError, WireError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason
from sern_runtime.ros_types import canonical, one_line

CDR: Final = "application/cdr"
FIRST_MESSAGES: Final = 100
"""Messages of a reliable topic that may wait for its first subscribers."""


class SubscriptionOwner(Protocol):
    """What a subscription needs of the endpoint that has it."""

    node: Node
    say_once: SayOnce

    def asks(self, info: TopicInfo) -> Qos:
        """What to ask of the publishers there are now."""
        ...

    def forget(self, subscription: "Subscription") -> None: ...


class Subscription:
    """One topic on its way to the link. While nobody wants it, the session has no subscriber of it."""

    def __init__(self, owner: SubscriptionOwner, info: TopicInfo, sink: Sink) -> None:
        self.name = info.name
        self.wanted = True
        self._owner = owner
        self._info = info
        self._sink = sink
        self._closed = False
        self._declared: Declared | None = None

    def refresh(self) -> None:
        if self._closed:
            return
        if not (self.wanted or self._info.latched):
            self._end()
        elif self._declared is None:
            try:
                self._declare()
            except self._owner.node.session.zenoh.ZError as error:
                raise ConfigError(f"zenoh: {one_line(error)}") from None

    @property
    def lacking(self) -> bool:
        return self._declared is None and (self.wanted or self._info.latched)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._end()
            self._owner.forget(self)

    def _end(self) -> None:
        declared, self._declared = self._declared, None
        if declared is not None:
            declared.end()

    def _declare(self) -> None:
        node, info, qos = self._owner.node, self._info, self._owner.asks(self._info)
        session, zenoh = node.session, node.session.zenoh
        dds_name = names.dds_type(info.type_name)
        key = node.key(info.name, dds_name, info.type_hash)

        def arrived(sample: Any) -> None:  # in a thread of zenoh's
            body = sample.payload.to_bytes()
            attachment = None if sample.attachment is None else sample.attachment.to_bytes()
            session.handover.put(lambda: deliver(body, attachment), len(body) + len(attachment or b""))

        def deliver(body: bytes, attachment: bytes | None) -> None:
            if self._declared is declared:  # not what came before nobody wanted it
                self._sink(body, self._stamp_ns(attachment))

        if qos.transient_local:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth)
            subscriber = zenoh.ext.declare_advanced_subscriber(
                session.opened, key, arrived, history=history, allowed_origin=zenoh.Locality.REMOTE
            )
        else:
            subscriber = session.opened.declare_subscriber(key, arrived, allowed_origin=zenoh.Locality.REMOTE)
        token = node.token(Kind.SUBSCRIPTION, info.name, dds_name, info.type_hash, qos)
        declared = self._declared = Declared(session, subscriber, token)

    def _stamp_ns(self, attachment: bytes | None) -> int:
        if attachment is not None:
            try:
                return names.unpack_attachment(attachment).stamp_ns
            except WireError as error:
                self._owner.say_once(f"{self.name}: {error}; its messages are stamped on arrival")
        return time.time_ns()


class PublisherOwner(Protocol):
    """What a publisher needs of the endpoint that has it."""

    node: Node

    @property
    def learning_s(self) -> float:
        """How much longer the graph may be incomplete."""
        ...

    def drop_first(self, why: DropReason) -> None:
        """Count a message that waited for its first subscribers in vain."""
        ...

    def ended(self, publisher: "Publisher") -> None: ...


class Publisher:
    """An `AgingPublisher`. `known` says how many subscribers the graph knows; of a latched topic nobody asks: whoever
    comes later gets what it has missed from a cache."""

    def __init__(self, owner: PublisherOwner, info: TopicInfo, type_hash: str, known: Callable[[], int]) -> None:
        self.name = info.name
        self.ending = False
        """It takes no more, and is closed when its first messages are written."""
        self._owner = owner
        self._session = owner.node.session
        self._gid = secrets.token_bytes(names.GID_BYTES)
        self._seq = itertools.count(1)
        self._known = known
        dds_name = names.dds_type(canonical(info.type_name))
        key, qos = owner.node.key(info.name, dds_name, type_hash), Qos(info.reliable is not False, info.latched)
        self._publisher = self._declare(key, qos)
        token = owner.node.token(Kind.PUBLISHER, info.name, dds_name, type_hash, qos)
        self._declared = Declared(self._session, self._publisher, token)
        best_effort = info.reliable is False
        self._first: FirstMessages | None = None
        if not info.latched:
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

    def _declare(self, key: str, qos: Qos) -> Any:
        session, zenoh = self._session.opened, self._session.zenoh
        blocking = zenoh.CongestionControl.BLOCK if qos.reliable else zenoh.CongestionControl.DROP
        if not qos.transient_local:
            return session.declare_publisher(key, encoding=CDR, congestion_control=blocking)
        return zenoh.ext.declare_advanced_publisher(
            session, key, encoding=CDR, congestion_control=blocking,
            cache=zenoh.ext.CacheConfig(max_samples=qos.depth), publisher_detection=True,
        )  # fmt: skip

    def _readers(self) -> Readers:
        known = self._known()
        try:
            matching = known and self._publisher.matching_status.matching
        except self._session.zenoh.ZError:
            matching = False  # the session has ended
        return Readers(known, known if matching else 0)

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self.publish_within(body, stamp_ns, inf)

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        if self.ending:
            self._session.refused()
        elif self._first is None or self._first.over:
            self._put(body, stamp_ns)
        else:
            self._first.publish(body, stamp_ns, left_s)

    def _put(self, body: bytes, stamp_ns: int) -> None:
        attachment = names.pack_attachment(next(self._seq), stamp_ns, self._gid)
        publisher = self._publisher
        put: Callable[[], None] = lambda: publisher.put(body, attachment=attachment)  # noqa: E731
        self._session.put(put, len(body))

    def close(self) -> None:
        """What was published before is still written: the last of it may be a stop command."""
        if not self.ending:
            self.ending = True
            if self._first is None:
                self._end()
            else:
                self._first.end(self._end)

    def _end(self) -> None:
        self._declared.end()
        self._owner.ended(self)

    def hurry(self) -> None:
        """Write the first messages now, if they wait."""
        if self._first is not None:
            self._first.close()
