"""What the HTTP server is asked for, without the server: an import of this costs nothing where there is none."""

import json
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

from sern_core.vocabulary.errors import UsageError

JsonSource = Callable[[], object]
"""Gives what `json.dumps` takes, from state, at once."""


class UnknownError(UsageError):
    """What was asked for is not here: answered with 404 and one line that says what is."""


class JsonParts(NamedTuple):
    """A large answer: pieces of JSON text, each made when it is asked for, some of them in a turn of the loop. Above
    MAX_ANSWER_BYTES it is refused with `too_large`, one line."""

    pieces: Iterator[str]
    too_large: str


def array(values: Iterable[object]) -> Iterator[str]:
    """The pieces of a JSON array, a value each."""
    return _joined("[]", map(json.dumps, values))


def closing_array(head: Mapping[str, object], name: str, values: Iterable[object]) -> Iterator[str]:
    """The pieces of a JSON object: the members of `head`, and behind them an array, a value each."""
    yield f"{json.dumps(head)[:-1]}, {json.dumps(name)}: "
    yield from array(values)
    yield "}"


def table(rows: Iterable[tuple[str, object]]) -> Iterator[str]:
    """The pieces of a JSON object, a member each."""
    return _joined("{}", (f"{json.dumps(name)}: {json.dumps(value)}" for name, value in rows))


def _joined(brackets: str, pieces: Iterable[str]) -> Iterator[str]:
    yield brackets[0]
    comma = ""
    for piece in pieces:
        yield comma + piece
        comma = ", "
    yield brackets[1]


class JsonQuery(NamedTuple):
    """A JSON source with parameters, all optional: `?name=value`. `read` gets those that were given, and raises
    UsageError for a value it does not take; that and unknown names are answered with 400 and one line,
    UnknownError with 404. What it gives is what `json.dumps` takes, or JsonParts."""

    accepts: tuple[str, ...]
    read: Callable[[Mapping[str, str]], object]
    prepare: Callable[[Mapping[str, str]], Awaitable[None]] | None = None
    """What takes long and has to be done first, elsewhere than on the loop; raises as `read` does."""


class Health(NamedTuple):
    """An answer for /healthz or /readyz. `reason` is one line, shown whatever the answer is."""

    ok: bool
    reason: str


HealthCheck = Callable[[], Health]
