"""Messages as text for `sern echo`: YAML of decoded ones, hex of the others."""

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from struct import error as StructError  # noqa: N812  (an exception, named like one)
from typing import Any, Final

import numpy as np
from rosbags.typesys import TypesysError

from sern_core.vocabulary.errors import ConfigError, SernError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

MAX_ITEMS: Final = 32
"""Items of an array that are shown, without --full."""
MAX_RAW_BYTES: Final = 256
NOT_FIELDS: Final = frozenset({"__msgtype__", "structure_needs_at_least_one_member"})
"""What rosbags adds: the name of the type, and what stands in for the fields of a type that has none."""


def text_of(message: object, *, max_items: int | None = MAX_ITEMS) -> str:
    """A decoded message as YAML, one field a line. Longer arrays end in `...` and a comment; None shows all."""
    lines = list(_fields(message, "", max_items))
    return "\n".join(lines) if lines else "{}"


def _fields(value: Any, indent: str, max_items: int | None) -> Iterator[str]:
    for item in fields(value):
        if item.name in NOT_FIELDS:
            continue
        yield from _field(f"{indent}{item.name}:", getattr(value, item.name), indent, max_items)


def _field(label: str, value: Any, indent: str, max_items: int | None) -> Iterator[str]:
    if is_dataclass(value):
        inner = list(_fields(value, indent + "  ", max_items))
        yield label if inner else f"{label} {{}}"
        yield from inner
    elif isinstance(value, list) and value and is_dataclass(value[0]):
        yield label
        shown = value[:max_items]
        for element in shown:
            lines = list(_fields(element, indent + "  ", max_items)) or [f"{indent}  {{}}"]
            yield f"{indent}- {lines[0].strip()}"
            yield from lines[1:]
        if len(shown) < len(value):
            yield f"{indent}# {len(value) - len(shown)} more"
    elif isinstance(value, (list, tuple, np.ndarray)):
        cells = [scalar(cell) for cell in np.asarray(value, dtype=object)[:max_items].tolist()]
        if len(cells) < len(value):
            yield f"{label} [{', '.join([*cells, '...'])}]  # {len(value)} in all"
        else:
            yield f"{label} [{', '.join(cells)}]"
    else:
        yield f"{label} {scalar(value)}"


_ESCAPES: Final = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r"}


def scalar(value: Any) -> str:
    """One number, bool or string as YAML. Text from elsewhere cannot steer a terminal."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        if math.isfinite(value):
            return repr(value)
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    if isinstance(value, str):
        return '"' + "".join(_ESCAPES.get(c) or (c if c.isprintable() else _escaped(c)) for c in value) + '"'
    return str(value)


def _escaped(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def hex_text(body: bytes, *, max_bytes: int | None = MAX_RAW_BYTES) -> str:
    """The bytes in hex, 32 to a line."""
    shown = body[:max_bytes]
    lines = [shown[start : start + 32].hex(" ", 4) for start in range(0, len(shown), 32)]
    if len(shown) < len(body):
        lines.append(f"# {len(body) - len(shown)} more bytes")
    return "\n".join(lines)


class Decoder:
    """Makes text of bodies. `raw`: hex, whatever the type. Raises SernError of one line for what cannot be decoded."""

    def __init__(self, *, raw: bool, full: bool) -> None:
        self._raw = raw
        self._max_items = None if full else MAX_ITEMS
        self._max_bytes = None if full else MAX_RAW_BYTES
        self._known: set[tuple[str, Encoding]] = set()

    def prepare(self, topic: str, type_name: str, definition: str, encoding: Encoding) -> None:
        """Take the type of a stream, before its first body."""
        if self._raw:
            return
        if encoding is Encoding.RAW:
            raise SernError(f"{topic} carries raw bytes without a ROS type; --raw prints them")
        try:
            name = ros_types.canonical(type_name)
            if definition:
                ros_types.register(name, definition, encoding)
            if name not in ros_types.typestore(encoding).fielddefs:
                raise ConfigError(f"type {name} is unknown here, and no definition came with the topic")
        except ConfigError as error:
            raise SernError(f"{topic} cannot be decoded: {error}; --raw prints the bytes") from None

    def text(self, topic: str, type_name: str, encoding: Encoding, body: bytes) -> str:
        if self._raw:
            return hex_text(body, max_bytes=self._max_bytes)
        try:
            message = ros_types.deserialise(body, ros_types.canonical(type_name), encoding)
        except (ConfigError, ValueError, KeyError, StructError, TypesysError) as error:
            text = ros_types.one_line(error)
            raise SernError(f"{topic} cannot be decoded: {text}; --raw prints the bytes") from None
        return text_of(message, max_items=self._max_items)
