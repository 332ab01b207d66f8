"""Message definitions (.msg texts, as they come from peers) read in linear time and within limits.

The parser of rosbags takes 40 to 200 µs a line, blank ones included, so that a megabyte of blank lines (a kilobyte on
the link) holds the loop for minutes; and what it accepts may cost anything later: a fixed array of a million strings
becomes a million lines of generated code. This one takes 2 µs a line and gives the same types (tests compare the two
over every type that is shipped), and refuses what is out of bounds with a ConfigError before anything is made of it.
So the largest definition that is accepted costs some milliseconds, and no process beside the loop is needed for it.

    text        := lines { 80 "=" newline "MSG: " package/[msg/]Name newline lines }
    line        := [ type name [default] | base NAME "=" value ] [ "#" comment ]
    type        := ( base | "string<=" n | [package/[msg/]]Name ) [ "[" [ n | "<=" n ] "]" ]
"""

import math
import re
from collections.abc import Callable
from typing import Final, cast

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import BaseDesc, Basename, Constdefs, Fielddefs, FieldDesc, NameDesc, Typesdict
from rosbags.typesys.base import normalize_fieldname

from sern_core.vocabulary.errors import ConfigError

SEPARATOR: Final = "=" * 80
MAX_CHARACTERS: Final = 2**18
"""The largest definition in a ROS desktop install has about 50 000."""
MAX_LINES: Final = 8_000
MAX_LINE_CHARACTERS: Final = 4_096
MAX_TYPES: Final = 256
MAX_MEMBERS: Final = 1_000
"""Fields and constants in all."""
MAX_NAME_CHARACTERS: Final = 128
MAX_ARRAY: Final = 2**20
"""Elements of a fixed array, and the bound of a sequence or string up to which it is believed to be meant."""
MAX_DEPTH: Final = 32
"""Types inside each other."""
MAX_ELEMENTS: Final = 5_000
"""Values that a message has for certain: its fields, those of the types in it, and the elements of fixed arrays of
strings and messages; an array of numbers is one."""

_WHITE: Final = " \t\r"
_BASE: Final = r"bool|byte|char|float32|float64|u?int(?:8|16|32|64)|string"
_PACKAGE: Final = r"[a-z](?:_?[a-z0-9])*"
_TYPE: Final = re.compile(
    rf"(?:(?P<base>{_BASE})(?:(?<=string)<=(?P<limit>[0-9]{{1,10}}))?(?![A-Za-z0-9_/])"
    rf"|(?P<name>(?:{_PACKAGE}/)*[A-Za-z](?:_?[A-Za-z0-9])*))"
    r"(?P<many>\[(?P<bounded><=)?(?P<size>[0-9]{1,10})?\])?[ \t]+(?P<field>[A-Za-z][A-Za-z0-9_]*)(?P<rest>.*)"
)
_HEADING: Final = re.compile(r"MSG: ([A-Za-z0-9_]+/(?:(?:msg|srv|action)/)?[A-Za-z0-9_]+)")
_CONSTANT: Final = re.compile(r"[A-Z](?:_?[A-Z0-9])*")
_FLOAT: Final = re.compile(
    r"[+-]?(?:[0-9]+\.[0-9]*(?:[eE][+-]?[0-9]+)?|[0-9]+[eE][+-]?[0-9]+)|\.[0-9]+(?:[eE][+-]?[0-9]+)?"
)
_INTEGER: Final = re.compile(r"([+-]?)(?:0[xX]([0-9a-fA-F]+)|0b([01]+)|0([0-7]+)|([0-9]+))")
_QUOTED: Final = re.compile(r"""'((?:\\.|[^'\\])*)'|"((?:\\.|[^"\\])*)\"""")
_NUMBER_CHARACTERS: Final = 64
_ALIASES: Final = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
_OTHER_ELEMENTS: Final = 10
_LONGEST_TYPE: Final = 3 * MAX_NAME_CHARACTERS


def sections(type_name: str, text: str) -> dict[str, list[str]]:
    """The lines of each type in a definition, by its name as the text has it; `type_name` is the first.

    ConfigError for one that is out of bounds.
    """
    _bound(type_name, "characters", len(text), MAX_CHARACTERS)
    _bound(type_name, "lines", text.count("\n"), MAX_LINES)
    current: list[str] = []
    found = {type_name: current}
    heading = False
    for line in text.split("\n"):
        if heading:
            match = _HEADING.fullmatch(line.rstrip(_WHITE))
            if match is None:
                raise _unreadable(type_name, f"{line[:80]!r} is no heading like MSG: std_msgs/Header")
            current = found[match[1]] = []
            _bound(type_name, "types", len(found), MAX_TYPES)
            heading = False
        elif line.startswith(SEPARATOR) and line.rstrip(_WHITE) == SEPARATOR:
            heading = True
        else:
            current.append(line)
    if heading:
        raise _unreadable(type_name, "it ends where the name of a type should be")
    return found


def parse(type_name: str, text: str) -> Typesdict:
    """The types of a definition, by canonical name; `type_name`, which is canonical, is the first. ConfigError."""
    types: Typesdict = {}
    members = 0
    for index, (name, lines) in enumerate(sections(type_name, text).items()):
        owner = type_name if index == 0 else _canonical(name)
        _bound(type_name, "characters in a name", len(owner), _LONGEST_TYPE)
        constants: Constdefs = []
        fields: Fielddefs = []
        for line in lines:
            stripped = line.strip(_WHITE)
            if stripped and stripped[0] not in "#@":
                members += 1
                _bound(type_name, "fields and constants", members, MAX_MEMBERS)
                _bound(type_name, "characters in a line", len(line), MAX_LINE_CHARACTERS)
                _line(type_name, owner, stripped, constants, fields)
        names = [normalize_fieldname(field) for field, _ in fields]
        if len(set(names)) != len(names):
            raise _unreadable(type_name, f"two fields of {owner} have one name")
        types[owner] = (constants, fields)
    return types


def check_size(type_name: str, types: Typesdict) -> None:
    """ConfigError for a type that has too many values, or too many inside each other, or contains itself. Types that
    are not in `types` count as `_OTHER_ELEMENTS`."""
    sizes: dict[str, int] = {}

    def size(name: str, depth: int) -> int:
        if name in sizes:
            if not sizes[name]:
                raise _unreadable(type_name, f"{name} contains itself")
            return sizes[name]
        if name not in types:
            return _OTHER_ELEMENTS
        _bound(type_name, "types inside each other", depth, MAX_DEPTH)
        sizes[name] = 0
        total = 1
        for _, desc in types[name][1]:
            total += _elements(desc, lambda used: size(used, depth + 1))
            _bound(type_name, "values in a message", total, MAX_ELEMENTS)
        sizes[name] = total
        return total

    size(type_name, 1)


def _elements(desc: FieldDesc, size: Callable[[str], int]) -> int:
    if desc[0] == Nodetype.BASE:
        return 1
    if desc[0] == Nodetype.NAME:
        return size(str(desc[1]))
    item, count = desc[1]
    inner = 1 if item[0] == Nodetype.BASE else size(str(item[1]))
    if desc[0] == Nodetype.SEQUENCE or (item[0] == Nodetype.BASE and item[1][0] != "string"):
        return 1
    return 1 + inner * int(count)


def _line(type_name: str, owner: str, line: str, constants: Constdefs, fields: Fielddefs) -> None:
    match = _TYPE.match(line)
    if match is None:
        raise _unreadable(type_name, f"{line[:80]!r} of {owner} is neither a field nor a constant")
    base = cast("Basename | None", match["base"])
    name, field, rest = match["name"], match["field"], match["rest"].strip(_WHITE)
    _bound(type_name, "characters in a name", max(len(field), len(name or "")), MAX_NAME_CHARACTERS)
    if rest.startswith("="):
        if base is None or match["many"] or match["limit"] or not _CONSTANT.fullmatch(field):
            raise _unreadable(type_name, f"{line[:80]!r} of {owner} is no constant")
        constants.append((field, base, _value(type_name, base, rest[1:].strip(_WHITE))))
        return
    if rest and match["rest"][0] not in " \t#\r":
        raise _unreadable(type_name, f"{line[:80]!r} of {owner} is no field")
    inner: BaseDesc | NameDesc
    if base is not None:
        inner = (Nodetype.BASE, (base, int(match["limit"] or 0)))
    else:
        inner = (Nodetype.NAME, _reference(owner, name))
    if not match["many"]:
        fields.append((field, inner))
        return
    size = int(match["size"] or 0)
    if match["bounded"] and not match["size"]:
        raise _unreadable(type_name, f"{line[:80]!r} of {owner} has no bound")
    if match["bounded"] or not match["size"]:
        fields.append((field, (Nodetype.SEQUENCE, (inner, size))))
        return
    _bound(type_name, f"elements in {field}", size, MAX_ARRAY)
    fields.append((field, (Nodetype.ARRAY, (inner, size))))


def _value(type_name: str, base: str, text: str) -> str | float | bool:
    """A constant's value. What is no number, truth value or quoted text is the rest of the line, comments included."""
    for pattern in (_FLOAT, _INTEGER):
        match = pattern.match(text)
        if match is None or (base == "string" and not _ends(text[match.end() :])):
            continue
        if not _ends(text[match.end() :]):
            raise _unreadable(type_name, f"{text[:80]!r} is no value")
        _bound(type_name, "characters in a number", match.end(), _NUMBER_CHARACTERS)
        if pattern is _FLOAT:
            number = float(match[0])
            if not math.isfinite(number):
                raise _unreadable(type_name, f"{match[0]} is beyond what a float64 holds")
            return number
        sign, *digits = match.groups()
        value = next(int(text, radix) for text, radix in zip(digits, (16, 2, 8, 10), strict=True) if text is not None)
        return -value if sign == "-" else value
    word = text.partition("#")[0].strip(_WHITE).lower()
    if word in ("true", "false"):
        return word == "true"
    quoted = _QUOTED.match(text)
    if quoted is not None and _ends(text[quoted.end() :]):
        return quoted[1] if quoted[1] is not None else quoted[2]
    if base != "string":
        raise _unreadable(type_name, f"{text[:80]!r} is no value")
    return text


def _ends(rest: str) -> bool:
    rest = rest.strip(_WHITE)
    return not rest or rest[0] == "#"


def _canonical(name: str) -> str:
    package, *kind, base = name.split("/")
    return f"{package}/{kind[0] if kind else 'msg'}/{base}"


def _reference(owner: str, name: str) -> str:
    """The type a field names: alone, of the package and kind of its owner."""
    name = _ALIASES.get(name, name)
    parts = name.split("/")
    if len(parts) == 1:
        return f"{owner.rpartition('/')[0]}/{name}"
    if len(parts) == 2:
        return f"{parts[0]}/msg/{parts[1]}"
    return name


def _unreadable(type_name: str, problem: str) -> ConfigError:
    return ConfigError(f"type {type_name}: its definition cannot be parsed: {problem}")


def _bound(type_name: str, what: str, value: int, limit: int) -> None:
    if value > limit:
        raise ConfigError(f"type {type_name}: its definition is too large: {value} {what}, up to {limit} are read")
