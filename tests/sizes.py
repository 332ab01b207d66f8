"""How many items the tables of an object graph hold, by the path of attributes that leads to them."""

from array import array
from collections import Counter, deque
from collections.abc import Callable
from enum import Enum
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

_PLAIN = (str, bytes, int, float, bool, complex, type(None), Enum, type, ModuleType, FunctionType, BuiltinFunctionType)
_TABLES = (dict, list, set, frozenset, tuple, deque, bytearray, array)


def sizes(root: object, *, stop: Callable[[str, object], bool] = lambda _path, _value: False) -> Counter[str]:
    """Items of every container that can be reached from `root`, added up by path; a key or index is `[]` in a path, so
    that the tables of all links count together. Each object counts once, under the shortest path. What `stop` says yes
    to is left out."""
    found: Counter[str] = Counter()
    seen: set[int] = set()
    keep: list[object] = []  # else an id could be used twice
    front: list[tuple[str, object]] = [("", root)]
    while front:
        following: list[tuple[str, object]] = []
        for path, value in front:
            if isinstance(value, _PLAIN) or id(value) in seen or stop(path, value):
                continue
            seen.add(id(value))
            keep.append(value)
            following += _within(path, value, found)
        front = following
    return found


def _within(path: str, value: object, found: Counter[str]) -> list[tuple[str, object]]:
    if isinstance(value, np.ndarray):
        return []
    if isinstance(value, MethodType):
        return [(f"{path}()", value.__self__)]
    parts: list[tuple[str, object]] = []
    if isinstance(value, _TABLES):
        if not isinstance(value, tuple):
            found[path] += len(value)
        if isinstance(value, dict):
            parts += [(f"{path}[]", key) for key in value] + [(f"{path}[]", item) for item in value.values()]
        elif not isinstance(value, bytearray | array):
            parts += [(f"{path}[]", item) for item in value]
    attributes: dict[str, Any] = dict(getattr(value, "__dict__", {}))
    for kind in type(value).__mro__:
        slots = getattr(kind, "__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if hasattr(value, name):
                attributes[name] = getattr(value, name)
    return parts + [(f"{path}.{name}", item) for name, item in attributes.items() if name not in ("__dict__",)]
