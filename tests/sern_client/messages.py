"""Made-up messages of any type, and message objects as plain values, for tests by value."""

from random import Random
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.typesys.store import Typestore

from sern_runtime import ros_types


def made_up(store: Typestore, type_name: str, random: Random) -> Any:
    """A message with something in every field; sequences of 0 to 3 elements."""
    fields = store.fielddefs[type_name][1]
    return store.types[type_name](**{ros_types.attribute(key): _value(desc, store, random) for key, desc in fields})


def _value(desc: FieldDesc, store: Typestore, random: Random) -> Any:
    if desc[0] == Nodetype.BASE:
        return _number(str(desc[1][0]), random)
    if desc[0] == Nodetype.NAME:
        return made_up(store, str(desc[1]), random)
    item, size = desc[1]
    length = int(size) if desc[0] == Nodetype.ARRAY else random.randrange(4)
    values = [_value(item, store, random) for _ in range(length)]
    if item[0] == Nodetype.BASE and item[1][0] != "string":
        base = str(item[1][0])
        return np.array(values, dtype={"byte": "int8", "char": "uint8"}.get(base, base))
    return values


def _number(base: str, random: Random) -> Any:
    if base == "string":
        return "".join(random.choice("abcé /_") for _ in range(random.randrange(6)))
    if base == "bool":
        return random.random() < 0.5
    if base.startswith("float"):
        return float(np.float32(random.uniform(-1e6, 1e6)))
    bits = 8 if base in {"byte", "char"} else int(base.lstrip("uint"))
    signed = base.startswith("int") or base == "byte"
    low = -(1 << (bits - 1)) if signed else 0
    high = (1 << (bits - 1)) - 1 if signed else (1 << bits) - 1
    return random.choice([low, high, 0, random.randint(low, high)])


def plain(message: Any, store: Typestore) -> Any:
    """Nested dictionaries and lists, names in lower case, without what ROS 2 does not have (`seq` of a Header)."""
    if hasattr(message, "__msgtype__"):
        name = message.__msgtype__
        return {
            key.lower(): plain(getattr(message, ros_types.attribute(key)), store)
            for key, _ in store.fielddefs[name][1]
            if key != "structure_needs_at_least_one_member" and (name, key) != ("std_msgs/msg/Header", "seq")
        }
    if isinstance(message, np.ndarray):
        return message.tolist()
    if isinstance(message, list):
        return [plain(item, store) for item in message]
    return message
