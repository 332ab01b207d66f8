"""Reads a file into a checked model, and makes one line that a person can act on of each of pydantic's errors.

`file:line: dotted.key: problem`, where the problem names the accepted values or the closest key.
"""

import difflib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar, get_args

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config.base import FileModel, Section, resolve
from sern_runtime.config.renamed import renamed_key, renamed_value
from sern_runtime.config.yaml import Document, Loc, Node, parse_document, read_document

M = TypeVar("M", bound=FileModel)
S = TypeVar("S", bound=Section)

SHOWN_CHARS: Final = 60
_SECRET_KEYS: Final = frozenset({"secret_key"})


@dataclass(frozen=True, slots=True)
class Loaded(Generic[M]):
    """A valid file. `warnings` are full lines (file, line, key, text) for the log."""

    model: M
    path: Path
    warnings: tuple[str, ...] = ()

    def resolve(self, text: str) -> Path:
        """A path that the file names, relative to the file."""
        return resolve(self.path.parent, text)


@dataclass(frozen=True, slots=True)
class Checked(Generic[M]):
    """The outcome of a check: every error in the order of the file, and the model if there is none."""

    loaded: Loaded[M] | None
    errors: tuple[ConfigError, ...] = ()


def load(path: Path, model: type[M], *, files: bool = True) -> Loaded[M]:
    """The file at `path` as `model`; raises the first ConfigError. `files`: also check the files that it names."""
    checked = check(path, model, files=files)
    if checked.loaded is None:
        raise checked.errors[0]
    return checked.loaded


def check(path: Path, model: type[M], *, files: bool = True) -> Checked[M]:
    """Like `load`, with every error instead of the first."""
    try:
        document = read_document(path)
    except ConfigError as error:
        return Checked(None, (error,))
    return check_document(document, path, model, files=files)


def check_bytes(data: bytes, path: Path, model: type[M]) -> Checked[M]:
    """Check a file's content without reading any file; `path` is for messages only."""
    try:
        document = parse_document(data, file=str(path))
    except ConfigError as error:
        return Checked(None, (error,))
    return check_document(document, path, model, files=False)


def check_document(document: Document, path: Path, model: type[M], *, files: bool) -> Checked[M]:
    foreign = model.foreign(document.data) if isinstance(document.data, dict) else None
    if foreign is not None:
        return Checked(None, (document.error((), foreign),))
    try:
        # JSON, because pydantic's strict mode then takes lists for tuples and words for enums, and nothing else.
        value = model.model_validate_json(json.dumps(document.data))
    except ValidationError as error:
        details = _without_echoes(error.errors(include_url=False, include_input=False))
        return Checked(None, _in_order(_render(document, model, item) for item in details))
    placed = value.placed(path.parent)
    if not files:
        return Checked(Loaded(placed, path))
    problems = list(value.file_problems(path.parent))
    errors = [document.error(item.loc, item.problem) for item in problems if not item.warning]
    if errors:
        return Checked(None, _in_order(errors))
    warnings = [document.error(item.loc, item.problem) for item in problems if item.warning]
    return Checked(Loaded(placed, path, tuple(str(warning) for warning in warnings)))


def checked_section(data: Mapping[str, Any], model: type[S]) -> S:
    """One section that is in no file. Raises ConfigError with the key at fault and what is wrong with it."""
    text = json.dumps(data)
    document = parse_document(text.encode(), file="")
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        raise _render(document, model, error.errors(include_url=False, include_input=False)[0]) from None


def _without_echoes(details: list[ErrorDetails]) -> list[ErrorDetails]:
    """Leave out "too short" for a list of which pydantic has only taken out the items that have errors of their own."""
    locs = [item["loc"] for item in details]
    return [
        item
        for item in details
        if item["type"] != "too_short" or not any(loc[: len(item["loc"])] == item["loc"] != loc for loc in locs)
    ]


def _in_order(errors: Iterable[ConfigError]) -> tuple[ConfigError, ...]:
    unique = {str(error): error for error in errors}
    return tuple(sorted(unique.values(), key=lambda error: error.line or 0))


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a pydantic `loc` leads: the path without union tags, the nearest node, the models it may be."""

    loc: Loc
    node: Node
    models: tuple[type[Section], ...]


def _trace(document: Document, model: type[Section], loc: Sequence[str | int]) -> _Place:
    """Follow `loc` through file and models together. Union tags, which pydantic puts into `loc`, are left out."""
    path: list[str | int] = []
    node: Node = document.root
    models: tuple[type[Section], ...] = (model,)
    for part in loc:
        if isinstance(node.value, dict) and isinstance(part, str):
            chosen = tuple(candidate for candidate in models if _kind(candidate) == part)
            if len(models) > 1 and chosen:
                models = chosen
                continue
            fields = [candidate.model_fields for candidate in models]
            inner = [f.annotation for table in fields for key, f in table.items() if (f.alias or key) == part]
            known = bool(inner) or part in node.value
            if not known:
                continue
            path.append(part)
            models = tuple(dict.fromkeys(found for annotation in inner for found in models_in(annotation)))
        elif isinstance(node.value, list) and isinstance(part, int):
            path.append(part)
        else:
            continue
        child = node.child(part)
        if child is None:
            break
        node = child
    return _Place(tuple(path), node, models)


def models_in(annotation: object) -> tuple[type[Section], ...]:
    """The models that a field's type mentions: the members of a union, the items of a list."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return (annotation,)
    return tuple(found for inner in get_args(annotation) for found in models_in(inner))


def _kind(model: type[Section]) -> str | None:
    """The value of the discriminator `kind` that selects `model` from its union."""
    kind = model.model_fields.get("kind")
    literals = () if kind is None else get_args(kind.annotation)
    return str(literals[0]) if literals else None


def accepted_keys(models: Sequence[type[Section]]) -> list[str]:
    return list(dict.fromkeys(f.alias or name for model in models for name, f in model.model_fields.items()))


def _render(document: Document, model: type[Section], details: ErrorDetails) -> ConfigError:
    kind, context = details["type"], details.get("ctx", {})
    loc = details["loc"]
    if kind == "extra_forbidden":
        parent = _trace(document, model, loc[:-1])
        key = str(loc[-1])
        accepted = accepted_keys(parent.models)
        new = renamed_key(key, accepted)
        problem = _unknown("key", key, accepted, quiet=True) if new is None else f"is called {new} now"
        return document.error((*parent.loc, key), problem)
    place = _trace(document, model, loc)
    if kind == "fault":
        return document.error((*place.loc, *context["at"]), str(context["problem"]))
    if kind == "union_tag_invalid":
        kinds = [_kind(candidate) or "" for candidate in place.models]
        return document.error((*place.loc, "kind"), _unknown("kind", str(context["tag"]), kinds))
    if kind == "union_tag_not_found":
        kinds = [_kind(candidate) or "" for candidate in place.models]
        if not isinstance(place.node.value, dict):
            return document.error(place.loc, f"expected a mapping (key: value), not {_shown(place)}")
        return document.error((*place.loc, "kind"), f"is missing; accepted: {', '.join(kinds)}")
    phrase = _PHRASES.get(kind)
    problem = details["msg"] if phrase is None else phrase(context, place)
    return document.error(place.loc, problem)


def _unknown(what: str, word: str, accepted: Sequence[str], *, quiet: bool = False) -> str:
    """`quiet`: the word is already in the message, as the last part of the path."""
    close = difflib.get_close_matches(word, accepted, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    shown = "" if quiet else f" {word[:SHOWN_CHARS]!r}"
    return f"unknown {what}{shown}{hint}; accepted: {', '.join(accepted)}"


def _shown(place: _Place) -> str:
    """The value at fault, short; never a secret."""
    if place.loc and place.loc[-1] in _SECRET_KEYS:
        return "what is there"
    value = place.node.value
    if value is None:
        return "null"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, bool):
        return "true" if value else "false"
    text = repr(value)
    return text if len(text) <= SHOWN_CHARS else text[: SHOWN_CHARS - 3] + "..."


def _expected(what: str) -> Callable[[dict[str, Any], _Place], str]:
    return lambda _, place: f"expected {what}, not {_shown(place)}"


def _choice(context: dict[str, Any], place: _Place) -> str:
    words = [word.strip().strip("'") for word in str(context["expected"]).replace(" or ", ", ").split(",")]
    value = place.node.value
    if isinstance(value, str) and place.loc:
        new = renamed_value(str(place.loc[-1]), value, words)
        if new is not None:
            return f"{_shown(place)} is called {new} now"
    close = difflib.get_close_matches(value, words, n=1) if isinstance(value, str) else []
    hint = f" (did you mean {close[0]}?)" if close else ""
    return f"{_shown(place)} is not accepted{hint}; accepted: {', '.join(words)}"


def _bound(sign: str, name: str) -> Callable[[dict[str, Any], _Place], str]:
    return lambda context, place: f"must be {sign} {context[name]:g}, not {_shown(place)}"


_PHRASES: Final[dict[str, Callable[[dict[str, Any], _Place], str]]] = {
    "missing": lambda _context, _place: "is missing",
    "unexpected": lambda context, place: f"expected {context['expected']}, not {_shown(place)}",
    "bool_type": _expected("true or false"),
    "int_type": _expected("a whole number"),
    "int_from_float": _expected("a whole number"),
    "int_parsing_size": _expected("a smaller whole number"),
    "float_type": _expected("a number"),
    "string_type": _expected("text"),
    "list_type": _expected("a list"),
    "tuple_type": _expected("a list"),
    "model_type": _expected("a mapping (key: value)"),
    "dict_type": _expected("a mapping (key: value)"),
    "model_attributes_type": _expected("a mapping (key: value)"),
    "enum": _choice,
    "literal_error": _choice,
    "greater_than": _bound(">", "gt"),
    "greater_than_equal": _bound(">=", "ge"),
    "less_than": _bound("<", "lt"),
    "less_than_equal": _bound("<=", "le"),
    "too_short": lambda context, _: f"is too short; at least {context['min_length']} needed",
    "too_long": lambda context, _: f"is too long; at most {context['max_length']} accepted",
}
