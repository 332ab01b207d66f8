"""/api/site_objects: the cross-reality objects that a client has, its own and those of others that it subscribes to.

kind=robot   objects of this kind only
owner=twin   objects of this client only
id=ID        this one only

The shape is that of the relay's /api/objects (sern_core/objects/xr_object.py); `version` counts a client's own changes,
and of others' objects it is the relay's version that came before.
"""

from collections.abc import Mapping
from typing import Any

from sern_core.objects.xr_object import object_to_json
from sern_core.site.client import ClientCore
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import ObjectKind
from sern_core.wire.announce import definition_hash
from sern_runtime.http_routes import JsonQuery


def objects_view(core: ClientCore) -> JsonQuery:
    """The route."""

    def read(query: Mapping[str, str]) -> Any:
        kinds = [str(kind) for kind in ObjectKind]
        if query.get("kind", kinds[0]) not in kinds:
            raise UsageError(f"kind is {query['kind'][:80]!r}; accepted: {', '.join(kinds)}")
        everything = [*core.objects.registry.select(), *core.mirror.objects.values()]
        found = [
            item
            for item in everything
            if query.get("kind") in (None, str(item.kind))
            and query.get("owner") in (None, item.owner)
            and query.get("id") in (None, item.id)
        ]
        return {
            "objects": [object_to_json(item, key=definition_hash(item.definition)) for item in found],
            "definitions": {definition_hash(item.definition): item.definition for item in found if item.definition},
        }

    return JsonQuery(("kind", "owner", "id"), read)
