"""Conversion between ROS 1 and ROS 2 (CDR), where a stream's encoding is not its endpoint's: at the egress only.

Everywhere else bodies pass through unread. Small messages take 1 to 10 µs, a cloud of 1 MB 30 µs, and nothing that a
body may hold takes more than about 15 ms (`sern_runtime/ros_bodies.py`), so it is done inline. What the two sides do
not have in common:

- `seq` of a ROS 1 Header does not exist in ROS 2: it is counted here, per topic, from 1.
- Range, SolidPrimitive and Marker have fields in ROS 2 that ROS 1 lacks: zero one way, lost the other.
- A custom type is made up from its definition (`ros_types.counterpart`).
"""

import logging
import struct
from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Any, Final, Protocol, runtime_checkable

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.serde import SerdeError

from sern_client.endpoints.base import (
    Endpoint,
    KnowsServiceTypes,
    Publisher,
    ServiceEndpoint,
    ServiceHandler,
    ServiceInfo,
    ServiceServer,
    publisher_within,
)
from sern_core.vocabulary.errors import BodyError, ConfigError, ServiceError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_bodies, ros_services, ros_types
from sern_runtime.ros_types import Counterpart, ResolvedType, one_line

Convert = Callable[[bytes], bytes]
"""Body in one encoding in, body in the other out. ConfigError for bytes that are not a message of the type."""

MAX_BY_VALUE_STEPS: Final = 2_000
"""Texts and groups of fields of a big endian body, which is read value by value: 5 µs each."""

_HEADER: Final = "std_msgs/msg/Header"
_LITTLE_ENDIAN: Final = b"\x00\x01"
_SEQ: Final = struct.Struct("<I")
_UNREADABLE: Final = (BodyError, SerdeError, AssertionError, IndexError, ValueError, OverflowError, struct.error)
"""What a converter raises for bytes that are not a message of its type."""

_log = logging.getLogger(__name__)


def converted(info: TopicInfo, wanted: Encoding) -> tuple[TopicInfo, Convert]:
    """What a topic is called and consists of in the other encoding, and what turns its bodies into that.

    ConfigError with one line when the type cannot be converted, or its hash is not that of its definition.
    """
    source, target = _both(info.name, info.type_name, info.definition, info.type_hash, info.encoding, wanted)
    other = replace(
        info,
        type_name=target.type.name,
        encoding=wanted,
        type_hash=target.type.text.type_hash,
        definition=target.type.text.definition,
    )
    return other, body_converter(source, target)


def converted_service(info: ServiceInfo, wanted: Encoding) -> tuple[ServiceInfo, Convert, Convert]:
    """A service in the other encoding, with what converts a request from `wanted` to the service's own encoding, and a
    response from the service's own to `wanted`. Raises as `converted` does."""
    parts = ros_services.resolve(info.type_name, info.definition, info.encoding)
    if info.type_hash and info.type_hash != parts.text.type_hash:
        raise _mismatch(info.name, info.type_name, info.type_hash, parts.text.type_hash)
    other = ros_services.counterpart(info.type_name, info.definition, info.encoding)
    request, response = other.request, other.response
    # The way back of the request: the same pair of types, seen from the other side.
    back = Counterpart(parts.request, request.same_layout)
    return (
        replace(info, encoding=wanted, type_hash=other.text.type_hash, definition=other.text.definition),
        body_converter(request.type, back),
        body_converter(parts.response, response),
    )


def body_converter(source: ResolvedType, target: Counterpart) -> Convert:
    """Turns bodies of one type into the other encoding; keeps the `seq` counter of a topic that goes to ROS 1."""
    if source.encoding is Encoding.ROS1:
        convert = _ros1_to_cdr(source, target.type)
    else:
        convert = _cdr_to_ros1(source, target.type)
    if target.type.encoding is Encoding.ROS1 and _begins_with_header(target.type):
        convert = _numbered(convert)

    def checked(body: bytes) -> bytes:
        try:
            return convert(body)
        except _UNREADABLE as error:
            raise ConfigError(
                f"type {source.name}: {len(body)} bytes cannot be converted to {target.type.encoding}: "
                f"{one_line(error)}"
            ) from None

    return checked


class Converter:
    """Advertises at endpoints that take one encoding what comes in the other.

    `failures` counts messages that could not be converted and were dropped; the first of each topic is logged.
    """

    def __init__(self) -> None:
        self.failures = 0

    def advertise(self, endpoint: Endpoint, info: TopicInfo) -> Publisher:
        """Call `Endpoint.advertise`, with a conversion where the endpoint wants another encoding than the topic has."""
        wanted = endpoint.encoding
        if wanted is None or wanted is info.encoding:
            return endpoint.advertise(info)
        other, convert = converted(info, wanted)
        _log.info("%s: %s is converted from %s to %s", info.name, info.type_name, info.encoding, wanted)
        return _Converting(self, info, endpoint.advertise(other), convert)


@runtime_checkable
class HasConverter(Protocol):
    """An endpoint that converts what it is given by itself."""

    @property
    def converter(self) -> Converter: ...


def serve(endpoint: ServiceEndpoint, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
    """Call `ServiceEndpoint.serve`, with requests and responses converted where the endpoint wants another encoding."""
    wanted = endpoint.encoding
    if wanted is None or wanted is info.encoding:
        return endpoint.serve(info, handler)
    if not info.definition and isinstance(endpoint, KnowsServiceTypes):  # ROS 1 says it of no service
        info = replace(info, definition=endpoint.service_definition(info.type_name, info.encoding) or "")
    other, request_back, response_on = converted_service(info, wanted)

    async def convert(request: bytes) -> bytes:
        try:
            return response_on(await handler(request_back(request)))
        except ConfigError as error:
            raise ServiceError(str(error)) from None

    return endpoint.serve(other, convert)


class _Converting:
    def __init__(self, owner: Converter, info: TopicInfo, publisher: Publisher, convert: Convert) -> None:
        self._owner = owner
        self._info = info
        self._publisher = publisher
        self._within = publisher_within(publisher)
        self._convert = convert
        self._complained = False

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self.publish_within(body, stamp_ns, inf)

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        try:
            body = self._convert(body)
        except ConfigError as error:
            self._owner.failures += 1
            if not self._complained:
                self._complained = True
                _log.error("%s: a message is dropped, and others like it: %s", self._info.name, error)
            return
        self._within(body, stamp_ns, left_s)

    def close(self) -> None:
        self._publisher.close()


def _both(
    topic: str, type_name: str, definition: str, type_hash: str, encoding: Encoding, wanted: Encoding
) -> tuple[ResolvedType, Counterpart]:
    if Encoding.RAW in (encoding, wanted):
        raise ConfigError(f"{topic}: {encoding} bodies cannot be converted to {wanted}; both sides need the same")
    try:
        source = ros_types.resolve(type_name, definition, encoding)
        target = ros_types.counterpart(type_name, definition, encoding)
    except ConfigError as error:
        raise ConfigError(f"{topic}: {error}") from None
    if type_hash and type_hash != source.text.type_hash:
        raise _mismatch(topic, type_name, type_hash, source.text.type_hash)
    return source, target


def _mismatch(topic: str, type_name: str, offered: str, computed: str) -> ConfigError:
    return ConfigError(
        f"{topic}: {type_name} came with hash {offered}, but its definition here has {computed}; "
        "both sides need the same version of the type"
    )


def _ros1_to_cdr(source: ResolvedType, target: ResolvedType) -> Convert:
    plan = ros_bodies.plan_of(target, ros1=source)
    return lambda body: ros_bodies.convert(plan, body, Encoding.ROS1, Encoding.CDR)


def _cdr_to_ros1(source: ResolvedType, target: ResolvedType) -> Convert:
    plan = ros_bodies.plan_of(source, ros1=target)
    parts = ros_bodies.plan_of(source, one_by_one=True)
    by_value = _by_value(source, target)

    def convert(body: bytes) -> bytes:
        if body[:2] != _LITTLE_ENDIAN:
            ros_bodies.check_steps(parts, body, Encoding.CDR, MAX_BY_VALUE_STEPS)
            return by_value(body)
        return ros_bodies.convert(plan, body, Encoding.CDR, Encoding.ROS1)

    return convert


def _begins_with_header(target: ResolvedType) -> bool:
    fields = target.store.fielddefs[target.name][1]
    return target.name == _HEADER or (bool(fields) and fields[0][1] == (Nodetype.NAME, _HEADER))


def _numbered(convert: Convert) -> Convert:
    seq = 0

    def numbered(body: bytes) -> bytes:
        nonlocal seq
        seq = (seq + 1) & 0xFFFFFFFF
        return _SEQ.pack(seq) + convert(body)[_SEQ.size :]

    return numbered


def _by_value(source: ResolvedType, target: ResolvedType) -> Convert:
    def convert(body: bytes) -> bytes:
        if source.encoding is Encoding.ROS1:
            message = source.store.deserialize_ros1(body, source.name)
        else:
            message = source.store.deserialize_cdr(body, source.name)
        mapped = _map(message, source, target, target.name)
        if target.encoding is Encoding.ROS1:
            return bytes(target.store.serialize_ros1(mapped, target.name))
        return bytes(target.store.serialize_cdr(mapped, target.name))

    return convert


def _map(message: Any, source: ResolvedType, target: ResolvedType, name: str) -> Any:
    """A message object of `target`'s store with the values of one of `source`'s, field by field, zero where missing."""
    mine = {key.lower(): key for key, _ in source.store.fielddefs[name][1]}
    values: dict[str, Any] = {}
    for key, desc in target.store.fielddefs[name][1]:
        if key.lower() not in mine:
            values[ros_types.attribute(key)] = ros_types.zero(desc, target.store)
            continue
        values[ros_types.attribute(key)] = _map_field(
            getattr(message, ros_types.attribute(mine[key.lower()])), desc, source, target, key
        )
    return target.store.types[name](**values)


def _map_field(value: Any, desc: FieldDesc, source: ResolvedType, target: ResolvedType, key: str) -> Any:
    if desc[0] == Nodetype.BASE:
        return value
    if desc[0] == Nodetype.NAME:
        return _map(value, source, target, str(desc[1]))
    item, size = desc[1]
    if desc[0] == Nodetype.SEQUENCE and size and len(value) > size:
        raise ValueError(f"{key} has {len(value)} elements, ROS 2 allows {size}")
    if item[0] == Nodetype.NAME:
        return [_map(element, source, target, str(item[1])) for element in value]
    return value
