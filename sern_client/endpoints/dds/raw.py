"""The only module that uses what the Python binding of Cyclone DDS does not document.

The binding (de)serialises every sample in Python; here bytes go through as they are. `ddspy_take` and `ddspy_write` are
the C functions below its `take` and `write`; the version of the binding is pinned for their sake. The wait set is used
below its Python class too, because that does not tell what woke it.
"""

import ctypes
from collections.abc import Callable
from typing import Any, Final

from cyclonedds import _clayer
from cyclonedds.core import Entity, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import dds_c_t
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader

ANY: Final = SampleState.Any | ViewState.Any | InstanceState.Any
NOT_READ: Final = SampleState.NotRead | ViewState.Any | InstanceState.Any
INFINITE_NS: Final = 2**63 - 1
RETCODE_TIMEOUT: Final = -10
"""What a write returns when slow reliable readers leave it no room."""
_WAKES: Final = 64
"""How many of the entities that are ready one wait names; the others come with the next."""


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
