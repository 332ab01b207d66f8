"""The object registry over HTTP: /api/objects with its parameters.

kind=transform      objects of this kind only
owner=jackal1       objects of this client only
topic=/jackal1/odom the objects of this topic only, one for each client that publishes it
definitions=no      without the texts of message definitions; their hashes stay
values=no           without the values
since=VERSION       what has changed after this version (`objects`) and the ids that are gone (`deleted`); with
                    `resync` true forget everything first. epoch=EPOCH of the earlier answer, so that a relay that
                    was started anew is noticed

The text of a definition is there once, however many objects have it: `definitions` maps the `definition_key` of objects
to texts. The answer is made piece by piece, a few of them in a turn of the loop: what changes meanwhile is told as it
is then, and again after `version`. Above 64 MiB it is refused with 400.

Objects of clients of other relays are there, too. Their values are where a client here subscribes to them, or where
somebody has asked for their kind or topic in the last ten seconds; so the first answer may lack them.

Large values that came encoded are decoded, and large values hashed, in another thread before the answer. Of one that
came while that was done the answer has the size alone.
"""

import asyncio
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from sern_core.bodies.codecs import INLINE_BYTES
from sern_core.objects.registry import ValueRequest, text_hash
from sern_core.objects.xr_object import object_to_json
from sern_core.relay.hub import Hub
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import ClientName, ObjectKind, TopicName
from sern_core.wire.announce import definition_hash
from sern_runtime import clock
from sern_runtime.http_routes import JsonParts, JsonQuery

TOO_LARGE = "the answer is too large; ask for one kind, owner or topic, or with values=no or definitions=no"


class _Wanted(NamedTuple):
    """What the parameters of a query ask for."""

    kind: ObjectKind | None
    owner: ClientName | None
    topic: TopicName | None
    definitions: bool
    values: bool


def objects_view(hub: Hub) -> JsonQuery:
    """The route of /api/objects."""
    registry = hub.objects
    registry.inline_bytes = INLINE_BYTES

    def selected(query: Mapping[str, str]) -> _Wanted:
        kind = _one_of("kind", query["kind"], [str(kind) for kind in ObjectKind]) if "kind" in query else None
        definitions, values = (
            _one_of(name, query.get(name, "yes"), ["yes", "no"]) == "yes" for name in ("definitions", "values")
        )
        return _Wanted(
            None if kind is None else ObjectKind(kind),
            ClientName(query["owner"]) if "owner" in query else None,
            TopicName(query["topic"]) if "topic" in query else None,
            definitions,
            values,
        )

    async def prepare(query: Mapping[str, str]) -> None:
        """Decode and hash large values in another thread."""
        wanted = selected(query)
        if not wanted.values:
            return
        version = _number("since", query["since"]) if "since" in query else 0
        requests = registry.unread(kind=wanted.kind, owner=wanted.owner, topic=wanted.topic, version=version)
        if requests:
            await asyncio.to_thread(_run, requests)
            for request in requests:
                request.done(now=clock.now())

    def read(query: Mapping[str, str]) -> JsonParts:
        wanted = selected(query)
        if wanted.values:
            hub.exchange.peers.look(wanted.kind or "", wanted.topic or "", now=clock.now())
        if "since" not in query:
            if "epoch" in query:
                raise UsageError("epoch has no use without since")
            head: dict[str, Any] = {"epoch": registry.epoch, "version": registry.version}
            ids: Iterable[str] = registry.named(owner=wanted.owner, topic=wanted.topic)
        else:
            epoch = _number("epoch", query["epoch"]) if "epoch" in query else None
            changes = registry.changed(_number("since", query["since"]), epoch=epoch)
            head = {"epoch": changes.epoch, "version": changes.version, "resync": changes.resync}
            head["deleted"] = list(changes.deleted)
            ids = changes.updated
            if wanted.topic is not None:
                of_topic = set(registry.named(owner=wanted.owner, topic=wanted.topic))
                ids = [object_id for object_id in ids if object_id in of_topic]
        return JsonParts(_pieces(hub, head, ids, wanted), TOO_LARGE)

    return JsonQuery(("kind", "owner", "topic", "definitions", "values", "since", "epoch"), read, prepare)


def _pieces(hub: Hub, head: dict[str, Any], ids: Iterable[str], wanted: _Wanted) -> Iterator[str]:
    """JSON text: what `head` has, the objects, and the texts that they name. A piece that is empty: something was
    looked at, and is not asked for."""
    registry = hub.objects
    own: dict[str, str] = {}  # texts that objects have themselves, and their keys
    keys: dict[str, str] = {}  # of the texts to be told: the hash of the whole text
    yield json.dumps(head)[:-1] + ', "objects": ['
    comma = ""
    for object_id in ids:
        about = registry.about(object_id)
        asked = about is not None and wanted.kind in (None, about[0]) and wanted.owner in (None, about[1])
        item = registry.get(object_id) if asked else None
        if about is None or item is None:
            yield ""
            continue
        text, key = item.definition, ""
        relayed = None if about[2] is None else hub.relayed.get(about[2])
        if text:
            key = own.get(text) or own.setdefault(text, definition_hash(text))
        elif relayed is not None and relayed.stream.stream.definition_hash in hub.definitions:
            # The hub has the text once for all streams of a type.
            key = relayed.stream.stream.definition_hash
            text = hub.definitions.get(key)
        else:
            text, key = hub.exchange.peers.far.text(object_id)
        if key and key not in keys:
            keys[key] = text_hash(text)
            own.setdefault(text, key)
        item = replace(item, definition_hash=item.definition_hash or keys.get(key, ""))
        yield comma + json.dumps(object_to_json(item, key=key, values=wanted.values))
        comma = ", "
    yield "]"
    if wanted.definitions:
        yield ', "definitions": {'
        comma = ""
        for text, key in own.items():
            yield f"{comma}{json.dumps(key)}: {json.dumps(text)}"
            comma = ", "
        yield "}"
    yield "}"


def _run(requests: Sequence[ValueRequest]) -> None:
    for request in requests:
        request.run()


def _one_of(name: str, value: str, accepted: list[str]) -> str:
    if value not in accepted:
        raise UsageError(f"{name} is {value[:80]!r}; accepted: {', '.join(accepted)}")
    return value


def _number(name: str, value: str) -> int:
    if not (value.isascii() and value.isdecimal() and len(value) <= 20):
        raise UsageError(f"{name} is {value[:80]!r}; a version or epoch of an earlier answer is needed")
    return int(value)
