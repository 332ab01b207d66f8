"""The object registry over HTTP: /api/objects with its parameters.

kind=transform      objects of this kind only
owner=jackal1       objects of this client only
definitions=no      without the texts of message definitions; their hashes stay
since=VERSION       what has changed after this version (`objects`) and the ids that are gone (`deleted`); with
                    `resync` true forget everything first. epoch=EPOCH of the earlier answer, so that a relay that
                    was started anew is noticed

Large values that came encoded are decoded, and large values hashed, in another thread before the answer. Of one that
came while that was done the answer has the size alone.
"""

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

from sern_core.codecs import INLINE_BYTES
from sern_core.errors import UsageError
from sern_core.hub import Hub
from sern_core.objects import ValueRequest, text_hash, topic_object_id
from sern_core.types import ClientName, ObjectKind
from sern_core.xr_object import changes_to_json
from sern_runtime import clock
from sern_runtime.http import JsonQuery


def objects_view(hub: Hub) -> JsonQuery:
    """The route of /api/objects."""
    registry = hub.objects
    registry.inline_bytes = INLINE_BYTES

    def selected(query: Mapping[str, str]) -> tuple[ObjectKind | None, ClientName | None]:
        kind = _one_of("kind", query["kind"], [str(kind) for kind in ObjectKind]) if "kind" in query else None
        owner = ClientName(query["owner"]) if "owner" in query else None
        return None if kind is None else ObjectKind(kind), owner

    async def prepare(query: Mapping[str, str]) -> None:
        """Decode and hash large values in another thread."""
        kind, owner = selected(query)
        version = _number("since", query["since"]) if "since" in query else 0
        requests = registry.unread(kind=kind, owner=owner, version=version)
        if requests:
            await asyncio.to_thread(_run, requests)
            for request in requests:
                request.done(now=clock.now())

    def read(query: Mapping[str, str]) -> object:
        wanted, owner = selected(query)
        definitions = _one_of("definitions", query.get("definitions", "yes"), ["yes", "no"]) == "yes"
        if "since" not in query:
            if "epoch" in query:
                raise UsageError("epoch has no use without since")
            return _defined(hub, registry.to_json(kind=wanted, owner=owner, definitions=definitions), definitions)
        epoch = _number("epoch", query["epoch"]) if "epoch" in query else None
        changes = registry.since(_number("since", query["since"]), epoch=epoch)
        return _defined(hub, changes_to_json(changes, kind=wanted, owner=owner, definitions=definitions), definitions)

    return JsonQuery(("kind", "owner", "definitions", "since", "epoch"), read, prepare)


def _run(requests: Sequence[ValueRequest]) -> None:
    for request in requests:
        request.run()


def _defined(hub: Hub, answer: dict[str, Any], definitions: bool) -> dict[str, Any]:
    """Put in the texts of streams, which the hub has once for all streams of a type, and the hashes of these texts."""
    streams = [relayed.stream.stream for relayed in hub.relayed.values()]
    digests = {topic_object_id(stream.id): stream.definition_hash for stream in streams}
    for item in answer["objects"]:
        text = hub.definitions.get(digests.get(item["id"], ""), "")
        item["definition_hash"] = item["definition_hash"] or text_hash(text)
        if definitions:
            item["definition"] = item["definition"] or text
    return answer


def _one_of(name: str, value: str, accepted: list[str]) -> str:
    if value not in accepted:
        raise UsageError(f"{name} is {value[:80]!r}; accepted: {', '.join(accepted)}")
    return value


def _number(name: str, value: str) -> int:
    if not (value.isascii() and value.isdecimal() and len(value) <= 20):
        raise UsageError(f"{name} is {value[:80]!r}; a version or epoch of an earlier answer is needed")
    return int(value)
