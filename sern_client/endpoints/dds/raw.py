"""The only module that uses what the Python binding of Cyclone DDS does not document.

The binding (de)serialises every sample in Python; here bytes go through as they are. `ddspy_take` and `ddspy_write` are
the C functions below its `take` and `write`; the version of the binding is pinned for their sake. The wait set is used
below its Python class too, because that does not tell what woke it. And the binding reads policies into variables that
all threads share, and frees what it finds there: with two endpoints in a process, one got the other's policies, or the
process broke. Here every reading has its own.
"""

import ctypes
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Final
from uuid import UUID

from cyclonedds import _clayer
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
from cyclonedds.core import Entity, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import DDS, dds_c_t
from cyclonedds.pub import DataWriter
from cyclonedds.qos import _CQos
from cyclonedds.sub import DataReader

ANY: Final = SampleState.Any | ViewState.Any | InstanceState.Any
NOT_READ: Final = SampleState.NotRead | ViewState.Any | InstanceState.Any
INFINITE_NS: Final = 2**63 - 1
RETCODE_TIMEOUT: Final = -10
"""What a write returns when slow reliable readers leave it no room."""
_WAKES: Final = 64
"""How many of the entities that are ready one wait names; the others come with the next."""

_log = logging.getLogger(__name__)


def take(reader: DataReader[Any], count: int) -> list[tuple[bytes, Any]]:
    """Up to `count` samples: body (CDR with its header), and sample info. Empty when the reader is gone."""
    taken = _clayer.ddspy_take(reader._ref, ANY, count)
    return [] if isinstance(taken, int) else taken


def write(writer: DataWriter[Any], body: bytes, stamp_ns: int | None) -> int:
    """Write a body, with a source time stamp or now. 0, or a negative return code."""
    padding = -len(body) & 3
    if padding:
        body += bytes(padding)
    if stamp_ns is None:
        return int(_clayer.ddspy_write(writer._ref, body))
    return int(_clayer.ddspy_write_ts(writer._ref, body, stamp_ns))


@dataclass(frozen=True, slots=True)
class Announced:
    """What a participant, reader or writer announces of itself. Kinds count upwards, as DDS numbers them."""

    name: str
    user_data: bytes
    reliable: bool
    durability: int
    deadline_ns: int
    lifespan_ns: int
    liveliness: int
    lease_ns: int
    exclusive: bool
    partitions: tuple[str, ...]


def announced(address: int) -> Announced:
    """The policies at an address of Cyclone DDS. What was not announced is the least; text that is none, made one."""
    qos = ctypes.cast(address, dds_c_t.qos_p)
    reliability, blocking_ns = dds_c_t.reliability(), dds_c_t.duration()
    _CQos._get_reliability(qos, ctypes.byref(reliability), ctypes.byref(blocking_ns))
    durability = dds_c_t.durability()
    _CQos._get_durability(qos, ctypes.byref(durability))
    deadline_ns = dds_c_t.duration(INFINITE_NS)
    _CQos._get_deadline(qos, ctypes.byref(deadline_ns))
    lifespan_ns = dds_c_t.duration(INFINITE_NS)
    _CQos._get_lifespan(qos, ctypes.byref(lifespan_ns))
    liveliness, lease_ns = dds_c_t.liveliness(), dds_c_t.duration(INFINITE_NS)
    _CQos._get_liveliness(qos, ctypes.byref(liveliness), ctypes.byref(lease_ns))
    ownership = dds_c_t.ownership()
    _CQos._get_ownership(qos, ctypes.byref(ownership))
    return Announced(
        _name(qos),
        _user_data(qos),
        reliability.value != 0,
        durability.value,
        deadline_ns.value,
        lifespan_ns.value,
        liveliness.value,
        lease_ns.value,
        ownership.value != 0,
        _partitions(qos),
    )


def _name(qos: Any) -> str:
    text = ctypes.c_char_p()
    _CQos._get_entity_name(qos, ctypes.byref(text))
    try:
        return (text.value or b"").decode("utf-8", "replace")
    finally:
        _CQos.free(text)


def _user_data(qos: Any) -> bytes:
    data, size = ctypes.c_void_p(), ctypes.c_size_t()
    _CQos._get_userdata(qos, ctypes.byref(data), ctypes.byref(size))
    try:
        return ctypes.string_at(data, size.value) if data else b""
    finally:
        _CQos.free(data)


def _partitions(qos: Any) -> tuple[str, ...]:
    count, texts = ctypes.c_uint32(), ctypes.POINTER(ctypes.c_char_p)()
    _CQos._get_partition(qos, ctypes.byref(count), ctypes.byref(texts))
    addresses = ctypes.cast(texts, ctypes.POINTER(ctypes.c_void_p))
    try:
        return tuple((texts[k] or b"").decode("utf-8", "replace") for k in range(count.value))
    finally:
        for k in range(count.value):
            _CQos.free(addresses[k])
        _CQos.free(addresses)


@dataclass(frozen=True, slots=True)
class Change:
    """A participant, writer or reader that came, changed or went. `announced`: None when it went.

    Of a participant, `participant` is its own GUID, and it has no topic and no type.
    """

    guid: UUID
    handle: int
    announced: Announced | None
    participant: UUID
    topic: str = ""
    type_name: str = ""


class _ParticipantSample(ctypes.Structure):
    """`dds_builtintopic_participant_t` of Cyclone DDS."""

    _fields_: ClassVar = [("key", ctypes.c_uint8 * 16), ("qos", ctypes.c_void_p)]


class _EndpointSample(ctypes.Structure):
    """`dds_builtintopic_endpoint_t` of Cyclone DDS."""

    _fields_: ClassVar = [
        ("key", ctypes.c_uint8 * 16),
        ("participant_key", ctypes.c_uint8 * 16),
        ("participant_instance_handle", ctypes.c_uint64),
        ("topic_name", ctypes.c_char_p),
        ("type_name", ctypes.c_char_p),
        ("qos", ctypes.c_void_p),
    ]


_SAMPLES: Final = ctypes.POINTER(ctypes.c_void_p)
# Functions of our own: the types of arguments that the binding gives to its own are for all who use those.
_dds_take: Final = ctypes.CFUNCTYPE(
    ctypes.c_int32, dds_c_t.entity, _SAMPLES, ctypes.POINTER(dds_c_t.sample_info), ctypes.c_size_t, ctypes.c_uint32
)(("dds_take", DDS._dll_handle))
_dds_return_loan: Final = ctypes.CFUNCTYPE(ctypes.c_int32, dds_c_t.entity, _SAMPLES, ctypes.c_int32)(
    ("dds_return_loan", DDS._dll_handle)
)


class DiscoveryReader:
    """What participants, writers or readers come and go in a domain, each with what it announces.

    The binding's own way of taking them gives up at a name that is no text, and leaves all that it took in memory.
    """

    def __init__(self, participant: DomainParticipant, topic: Any) -> None:
        self.reader = BuiltinDataReader(participant, topic)
        self._sample = _ParticipantSample if topic is BuiltinTopicDcpsParticipant else _EndpointSample

    def take(self, count: int) -> tuple[list[Change], int]:
        """Up to `count` changes, and how many more could not be read, which is logged. Fewer in all: there is no more.

        OSError when Cyclone DDS does not give them.
        """
        samples, infos = (ctypes.c_void_p * count)(), (dds_c_t.sample_info * count)()
        taken = _dds_take(self.reader._ref, samples, infos, count, count)
        if taken < 0:
            raise OSError(f"Cyclone DDS does not say who came and went (return code {taken})")
        changes, unreadable = [], 0
        try:
            for address, info in zip(samples[:taken], infos, strict=False):
                try:
                    changes.append(self._change(address, info))
                except UnicodeDecodeError as error:
                    unreadable += 1
                    _log.error("a peer announces what cannot be read: the name %.100r", error.object)
        finally:
            if taken:
                _dds_return_loan(self.reader._ref, samples, taken)
        return changes, unreadable

    def _change(self, address: int | None, info: Any) -> Change:
        """UnicodeDecodeError for a topic or type whose name is no text."""
        sample = ctypes.cast(ctypes.c_void_p(address), ctypes.POINTER(self._sample)).contents
        guid = UUID(bytes=bytes(sample.key))
        if not info.valid_data or info.instance_state != InstanceState.Alive:
            return Change(guid, info.instance_handle, None, guid)  # of one that went only the key is there
        said = announced(sample.qos)
        if self._sample is _ParticipantSample:
            return Change(guid, info.instance_handle, said, guid)
        topic, type_name = (sample.topic_name or b"").decode(), (sample.type_name or b"").decode()
        return Change(guid, info.instance_handle, said, UUID(bytes=bytes(sample.participant_key)), topic, type_name)


def matched_readers(writer: DataWriter[Any]) -> list[int]:
    """The handles of the readers that a writer has, as discovery tells them."""
    return _handles(writer._get_matched_subscriptions, writer)


def matched_writers(reader: DataReader[Any]) -> list[int]:
    """The handles of the writers that a reader has, as discovery tells them."""
    return _handles(reader._get_matched_publications, reader)


def _handles(ask: Callable[[Any, Any, int], int], entity: Entity) -> list[int]:
    """The handles that `ask` writes into an array, which is made larger until all have room.

    The binding's own function asks for their number first, and raises an IndexError where one came in between.
    """
    room = 8
    while True:
        handles = (dds_c_t.instance_handle * room)()
        count = ask(entity._ref, ctypes.cast(handles, ctypes.POINTER(dds_c_t.instance_handle)), room)
        if count < 0:
            raise OSError(f"Cyclone DDS does not say whom {entity!r} is matched with (return code {count})")
        if count <= room:
            return [handle & 2**64 - 1 for handle in handles[:count]]  # the binding makes them signed
        room = count


class Waiter:
    """A wait set that says which of its entities are ready, each by the number it was attached with."""

    def __init__(self, participant: DomainParticipant) -> None:
        self._set = WaitSet(participant)
        self._ready = (dds_c_t.attach * _WAKES)()
        self._kept: dict[int, Entity] = {}

    def attach(self, entity: Entity, number: int) -> None:
        result = self._set._waitset_attach(self._set._ref, entity._ref, number)
        if result < 0:
            raise OSError(f"Cyclone DDS cannot wait for {entity!r} ({result})")
        self._kept[number] = entity

    def attach_reader(self, reader: DataReader[Any], number: int) -> None:
        self.attach(ReadCondition(reader, NOT_READ), number)

    def detach(self, number: int) -> None:
        entity = self._kept.pop(number, None)
        if entity is not None:
            self._set._waitset_detach(self._set._ref, entity._ref)

    def wait(self, timeout_ns: int = INFINITE_NS) -> list[int]:
        """The numbers of what is ready; empty after `timeout_ns`. Lets other threads run meanwhile."""
        count = self._set._waitset_wait(
            self._set._ref, ctypes.cast(self._ready, ctypes.POINTER(dds_c_t.attach)), _WAKES, timeout_ns
        )
        return [number for number in self._ready[: max(0, min(count, _WAKES))] if number is not None]

    def close(self) -> None:
        for number in list(self._kept):
            self.detach(number)
