"""YAML text as plain data with the line of every key: the first half of reading a configuration file.

The scanner and parser are ruamel.yaml's (YAML 1.2); the tree is built here from its events, because that bounds depth,
size and alias expansion before any memory is spent, keeps the line of each node, and admits nothing but mappings with
string keys, lists, and the scalars of the YAML 1.2 core schema (section 10.3): null, bool, int, float, str. So `yes`,
`on` and `12:30` are strings. Tags, merge keys, several documents, infinities and control characters are errors.

For any bytes, ConfigError is the only exception that comes out.
"""

import io
import re
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    Event,
    MappingEndEvent,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
)
from ruamel.yaml.reader import ReaderError

from sern_core.vocabulary.errors import ConfigError

MAX_FILE_BYTES: Final = 256 * 1024
MAX_DEPTH: Final = 16
MAX_NODES: Final = 20_000
"""Nodes after aliases are expanded: nine lines of nested aliases would otherwise make a billion."""
MAX_NUMBER_CHARS: Final = 40

Scalar = str | int | float | bool | None
Data = Scalar | list["Data"] | dict[str, "Data"]
Loc = tuple[str | int, ...]

_INT: Final = re.compile(r"[-+]?[0-9]+")
_OCTAL: Final = re.compile(r"0o[0-7]+")
_HEX: Final = re.compile(r"0x[0-9a-fA-F]+")
_FLOAT: Final = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_NOT_FINITE: Final = re.compile(r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)")
_WORDS: Final[dict[str, bool | None]] = {
    "": None,
    "~": None,
    **dict.fromkeys(("null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
# C0 and C1 controls but tab and newline, and lone surrogates: no setting needs them and file names break on them.
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\u2028\u2029]")


@dataclass(slots=True, eq=False)
class Node:
    """One node of the file. `line` is 1-based; of a mapping's values, the line where their key stands.

    `value` holds a scalar, a list of nodes, or a mapping from key to node.
    """

    value: "Scalar | list[Node] | dict[str, Node]"
    line: int
    size: int = 1  # nodes in this tree, aliases counted each time
    height: int = 0  # levels of lists and mappings in this tree

    def child(self, part: str | int) -> "Node | None":
        """The value of key `part`, or the item with index `part`; None when there is none."""
        if isinstance(self.value, dict):
            return self.value.get(part) if isinstance(part, str) else None
        if isinstance(self.value, list) and isinstance(part, int) and 0 <= part < len(self.value):
            return self.value[part]
        return None


class Place(NamedTuple):
    """Where something is in the file: dotted key path and line."""

    key: str
    line: int


@dataclass(frozen=True, slots=True)
class Document:
    """A file that is valid YAML: its data, and the place of each part."""

    file: str
    root: Node
    data: Data = field(repr=False)

    def at(self, loc: Sequence[str | int]) -> Node:
        """The nearest node to `loc` (keys and list indices from the root)."""
        return self._walk(loc)[-1]

    def place(self, loc: Sequence[str | int]) -> Place:
        """The dotted path of `loc` (also of parts that are not there) and the line of the nearest node."""
        nodes = self._walk(loc)
        return Place(".".join(shown_key(part) for part in loc), nodes[-1].line)

    def error(self, loc: Sequence[str | int], problem: str) -> ConfigError:
        key, line = self.place(loc)
        return ConfigError(one_line(problem), file=self.file, line=line, key=key or None)

    def _walk(self, loc: Sequence[str | int]) -> list[Node]:
        nodes = [self.root]
        for part in loc:
            child = nodes[-1].child(part)
            if child is None:
                break
            nodes.append(child)
        return nodes


def one_line(text: str) -> str:
    """`text` with everything that would break a line or a terminal escaped."""
    return re.sub(r"[^\x20-\x7e\xa0-\ud7ff\ue000-\uffff\U00010000-\U0010ffff]|[\u2028\u2029]", _escaped, text)


def _escaped(match: re.Match[str]) -> str:
    return match.group().encode("unicode_escape", "surrogatepass").decode("ascii")


def shown_key(part: str | int) -> str:
    """A key as it appears in a dotted path: quoted when it is not a plain word, cut when it is long."""
    text = str(part)
    if re.fullmatch(r"[A-Za-z0-9_-]{1,60}", text):
        return text
    return repr(text[:60])


def read_document(path: Path) -> Document:
    """The document in `path`. ConfigError when it is missing, unreadable, too large or not valid YAML."""
    file = one_line(str(path))
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError as error:
        raise ConfigError("no such file", file=file) from error
    except IsADirectoryError as error:
        raise ConfigError("is a directory; a file is needed", file=file) from error
    except PermissionError as error:
        raise ConfigError("may not be read; check its owner and permissions", file=file) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"can not be read: {one_line(str(error))}", file=file) from error
    return parse_document(data, file=file)


def parse_document(data: bytes, *, file: str) -> Document:
    """The document in `data`; `file` is only a name for error messages."""
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"is larger than {MAX_FILE_BYTES} bytes", file=file)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"byte {data[error.start]:#04x} is not UTF-8 text", file=file, line=line) from error
    root = _Builder(file).build(text)
    if not isinstance(root.value, dict):
        raise ConfigError("the file must be a mapping (key: value)", file=file, line=root.line)
    return Document(file, root, _plain(root))


def _plain(node: Node) -> Data:
    value = node.value
    if isinstance(value, dict):
        return {key: _plain(child) for key, child in value.items()}
    if isinstance(value, list):
        return [_plain(child) for child in value]
    return value


@dataclass(slots=True)
class _Open:
    """A list or mapping that is still being read. `key` is the mapping key whose value comes next."""

    node: Node
    anchor: str | None
    key: str | None = None
    key_line: int = 0


@dataclass(slots=True)
class _Builder:
    file: str
    _open: list[_Open] = field(default_factory=list)
    _anchors: dict[str, Node] = field(default_factory=dict)
    _root: Node | None = None

    def build(self, text: str) -> Node:
        with closing(self._events(text)) as events:
            for event in events:
                self._take(event)
        return self._root or Node(None, 1)

    def _events(self, text: str) -> Generator[Event, None, None]:
        """ruamel's events. Its own errors become ConfigError with the line where the problem was met."""
        parser = YAML(typ="safe", pure=True)
        try:
            yield from parser.parse(io.StringIO(text))
        except MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            reason = ", ".join(part for part in (error.context, error.problem) if part)
            raise self._error(f"not valid YAML: {reason}", None if mark is None else mark.line + 1) from error
        except ReaderError as error:
            line = text.count("\n", 0, error.position) + 1
            raise self._error(f"character {error.character:#x} is not allowed", line) from error
        except (YAMLError, ValueError, LookupError, TypeError, AttributeError, AssertionError, RecursionError) as error:
            # Malformed directives and escapes make the parser fail in its own code; to us it is one more bad file.
            raise self._error(f"not valid YAML: {type(error).__name__} {error}", None) from error

    def _error(self, problem: str, line: int | None, key: str | None = None) -> ConfigError:
        return ConfigError(one_line(problem), file=self.file, line=line, key=key)

    def _too_deep(self, line: int) -> ConfigError:
        return self._error(f"nested deeper than {MAX_DEPTH} levels", line)

    def _take(self, event: Event) -> None:
        line = event.start_mark.line + 1
        if isinstance(event, DocumentStartEvent):
            if self._root is not None:
                raise self._error("a second document starts here; one file holds one", line)
        elif isinstance(event, (MappingEndEvent, SequenceEndEvent)):
            self._close()
        elif isinstance(event, AliasEvent):
            self._add(self._alias(event, line), line)
        elif isinstance(event, NodeEvent):
            self._start(event, line)

    def _start(self, event: NodeEvent, line: int) -> None:
        if isinstance(event, (MappingStartEvent, SequenceStartEvent, ScalarEvent)) and event.tag not in (None, "!"):
            raise self._error(f"tag {event.tag!r} is not allowed; write the plain value", line, self._path())
        if isinstance(event, ScalarEvent):
            self._add(Node(self._scalar(event, line), line), line, event.anchor)
            return
        if len(self._open) >= MAX_DEPTH:
            raise self._too_deep(line)
        if self._open and isinstance(self._open[-1].node.value, dict) and self._open[-1].key is None:
            raise self._error("a key must be a word, not a list or mapping", line, self._path())
        node = Node({} if isinstance(event, MappingStartEvent) else [], line)
        self._open.append(_Open(node, event.anchor))

    def _close(self) -> None:
        done = self._open.pop()
        self._add(done.node, done.node.line, done.anchor)

    def _alias(self, event: AliasEvent, line: int) -> Node:
        node = self._anchors.get(event.anchor)
        if node is None:
            raise self._error(f"alias *{event.anchor} has no anchor &{event.anchor} before it", line, self._path())
        return node

    def _add(self, node: Node, line: int, anchor: str | None = None) -> None:
        """Put a finished node where it belongs: as key or value of the open collection, or as the root."""
        if anchor is not None:
            self._anchors[anchor] = node
        if not self._open:
            self._root = node
            return
        parent = self._open[-1]
        value = parent.node.value
        if isinstance(value, dict) and parent.key is None:
            parent.key, parent.key_line = self._key(node, value, line), line
            return
        parent.node.size += node.size
        if parent.node.size > MAX_NODES:
            raise self._error(f"more than {MAX_NODES} values (aliases count each time they are used)", line)
        parent.node.height = max(parent.node.height, node.height + 1)
        if len(self._open) + node.height > MAX_DEPTH:
            raise self._too_deep(line)
        if isinstance(value, dict) and parent.key is not None:
            # The key's line is what a person looks for, also when the value starts on a later line.
            value[parent.key] = replace(node, line=parent.key_line)
            parent.key = None
        elif isinstance(value, list):
            value.append(node)

    def _key(self, node: Node, siblings: dict[str, Node], line: int) -> str:
        key = node.value
        if not isinstance(key, str):
            shown = "empty" if key is None else repr(key)
            raise self._error(f"a key must be a word, not {shown}; quote it if it is meant", line, self._path())
        if key == "<<":
            raise self._error("merge keys (<<) are not supported; write the keys out", line, self._path())
        if key in siblings:
            raise self._error(
                f"is given twice; first on line {siblings[key].line}", line, ".".join(self._parts([shown_key(key)]))
            )
        return key

    def _parts(self, last: list[str]) -> list[str]:
        parts = []
        for level in self._open:
            if level.key is not None:
                parts.append(shown_key(level.key))
            elif isinstance(level.node.value, list):
                parts.append(str(len(level.node.value)))
        return parts + last

    def _path(self) -> str | None:
        return ".".join(self._parts([])) or None

    def _scalar(self, event: ScalarEvent, line: int) -> Scalar:
        """A scalar by the core schema; only plain (unquoted) ones are anything but strings."""
        text: str = event.value
        bad = _CONTROL.search(text)
        if bad is not None:
            raise self._error(f"character {bad.group()!a} is not allowed in a value", line, self._path())
        if not (event.implicit[0] and event.style is None):
            return text
        if text in _WORDS:
            return _WORDS[text]
        if _NOT_FINITE.fullmatch(text):
            raise self._error(f"{text} is not a finite number", line, self._path())
        if not text.isascii() or not _looks_numeric(text):
            return text
        if len(text) > MAX_NUMBER_CHARS:
            raise self._error(f"a number has at most {MAX_NUMBER_CHARS} characters", line, self._path())
        if _INT.fullmatch(text):
            return int(text)
        if _OCTAL.fullmatch(text) or _HEX.fullmatch(text):
            return int(text, 0)
        number = float(text)
        if number in (float("inf"), float("-inf")):
            raise self._error(f"{text} is not a finite number", line, self._path())
        return number


def _looks_numeric(text: str) -> bool:
    return any(pattern.fullmatch(text) for pattern in (_INT, _OCTAL, _HEX, _FLOAT))
