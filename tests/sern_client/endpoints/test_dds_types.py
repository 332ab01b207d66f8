"""DDS types made from definitions: they last as long as somebody uses them, and the newest a while longer."""

import gc
import weakref
from typing import Any

import pytest

pytest.importorskip("cyclonedds")

from sern_client.endpoints.dds.idl import KEPT_TYPES, TypeMaker
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_runtime.ros_types import ResolvedType


@pytest.fixture(autouse=True)
def unresolved() -> None:
    ros_types.resolve.cache_clear()


def resolved(number: int) -> ResolvedType:
    """A definition that no other number has, with a type in it that none has either; nobody else keeps its store."""
    text = f"Part part\nuint8 f{number}\n{'=' * 80}\nMSG: peer_msgs/Part\nfloat32[{number + 1}] x\n"
    found = ros_types.resolve("peer_msgs/msg/Whole", text, Encoding.CDR)
    ros_types.resolve.cache_clear()
    return found


def alive(found: list[weakref.ref[Any]]) -> list[int]:
    gc.collect()
    return [number for number, one in enumerate(found) if one() is not None]


def test_definitions_that_nobody_uses_go_and_their_stores_with_them() -> None:
    """A peer may send as many as it likes."""
    maker = TypeMaker()
    types: list[weakref.ref[Any]] = []
    stores: list[weakref.ref[Any]] = []
    for number in range(3 * KEPT_TYPES):
        one = resolved(number)
        made = maker.make(one)
        made.__idl__.populate()
        types.append(weakref.ref(made))
        stores.append(weakref.ref(one.store))
    del one, made
    newest = list(range(2 * KEPT_TYPES, 3 * KEPT_TYPES))
    assert alive(types) == newest and alive(stores) == newest
    assert len(maker) == 2 * KEPT_TYPES  # each with its part


def test_a_type_in_use_is_the_same_for_everybody_however_many_come_after_it() -> None:
    maker = TypeMaker()
    first = resolved(0)
    used = maker.make(first)
    as_request = maker.make(first, header=True)
    assert used is not as_request
    for number in range(1, 2 * KEPT_TYPES):
        maker.make(resolved(number))
    gc.collect()
    assert maker.make(first) is used and maker.make(first, header=True) is as_request
    assert used.__idl__.populate() is None and "Part" in str(used.__annotations__["part"])
