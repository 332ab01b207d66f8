"""What our node has for topics: subscribers, and writers."""

import itertools
import time
from collections.abc import Callable
from typing import Any, Final

from sern_client.endpoints.common.first_messages import Readers
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh.names import Kind, Qos
from sern_client.endpoints.zenoh.node import Declared, Node
from sern_core.vocabulary.errors import ConfigError, WireError
from sern_core.vocabulary.message import TopicInfo
from sern_runtime.ros_types import canonical, one_line

CDR: Final = "application/cdr"


def receive(
    node: Node, info: TopicInfo, qos: Qos, say_once: SayOnce, arrived: Callable[[bytes, int], None], *,
    accept_bridged: bool,
) -> Callable[[], None]:  # fmt: skip
    """Have `arrived(body, stamp_ns)` called on the event loop, until what is returned is called. What another SERN
    endpoint published is left out, unless with `accept_bridged`."""
    session, zenoh = node.session, node.session.zenoh
    dds_name = names.dds_type(info.type_name)
    key = node.key(info.name, dds_name, info.type_hash)

    def came(sample: Any) -> None:  # in a thread of zenoh's
        body = sample.payload.to_bytes()
        attachment = None if sample.attachment is None else sample.attachment.to_bytes()
        session.handover.put(lambda: take(body, attachment), len(body) + len(attachment or b""))

    def take(body: bytes, attachment: bytes | None) -> None:
        stamp_ns = None
        if attachment is not None:
            try:
                _, stamp_ns, gid = names.unpack_attachment(attachment)
                if gid.startswith(names.GID_MARK) and not accept_bridged:
                    return
            except WireError as error:
                say_once(f"{info.name}: {error}; its messages are stamped on arrival")
        arrived(body, time.time_ns() if stamp_ns is None else stamp_ns)

    try:
        if qos.transient_local:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth)
            subscriber = zenoh.ext.declare_advanced_subscriber(
                session.opened, key, came, history=history, allowed_origin=zenoh.Locality.REMOTE
            )
        else:
            subscriber = session.opened.declare_subscriber(key, came, allowed_origin=zenoh.Locality.REMOTE)
        token = node.token(Kind.SUBSCRIPTION, info.name, dds_name, info.type_hash, qos)
    except zenoh.ZError as error:
        raise ConfigError(f"zenoh: {one_line(error)}") from None
    return Declared(session, subscriber, token).end


class Writer:
    """Publishes on a topic. `known` says how many subscribers of others the graph knows."""

    def __init__(self, node: Node, info: TopicInfo, type_hash: str, known: Callable[[], int]) -> None:
        dds_name = names.dds_type(canonical(info.type_name))
        qos = Qos(info.reliable is not False, info.latched)
        self._session = node.session
        self._gid = node.new_gid()
        self._seq = itertools.count(1)
        self._known = known
        self._publisher = self._declare(node.key(info.name, dds_name, type_hash), qos)
        token = node.token(Kind.PUBLISHER, info.name, dds_name, type_hash, qos)
        self._declared = Declared(self._session, self._publisher, token)

    def _declare(self, key: str, qos: Qos) -> Any:
        session, zenoh = self._session.opened, self._session.zenoh
        blocking = zenoh.CongestionControl.BLOCK if qos.reliable else zenoh.CongestionControl.DROP
        if not qos.transient_local:
            return session.declare_publisher(key, encoding=CDR, congestion_control=blocking)
        return zenoh.ext.declare_advanced_publisher(
            session, key, encoding=CDR, congestion_control=blocking,
            cache=zenoh.ext.CacheConfig(max_samples=qos.depth), publisher_detection=True,
        )  # fmt: skip

    def readers(self) -> Readers:
        """How many subscribers there are, and whether we reach them."""
        known = self._known()
        try:
            matching = known and self._publisher.matching_status.matching
        except self._session.zenoh.ZError:
            matching = False  # the session has ended
        return Readers(known, known if matching else 0)

    def publish(self, body: bytes, stamp_ns: int) -> None:
        attachment = names.pack_attachment(next(self._seq), stamp_ns, self._gid)
        publisher = self._publisher
        put: Callable[[], None] = lambda: publisher.put(body, attachment=attachment)  # noqa: E731
        self._session.put(put, len(body))

    def close(self) -> None:
        """Close it after what was published before has left."""
        self._declared.end()
