"""Who may have which object: the global name that its id stands for, and whose it is. Pure.

`node:NAME` is the object of the client of that name, which needs no right for it. Any other id stands for a global
name: itself, without the `@client` at its end, under the leading `/` of names. Who may publish that name may put it,
who may subscribe to it is told of it; `node:NAME` is told to who may subscribe to `/NAME/node`. Transforms are what a
relay read on a topic: who may publish that may have them.
"""

import re
from typing import Final

from sern_core.objects.xr_object import XrObject
from sern_core.relay.access import AccessTable
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.types import ClientName, TopicName

NODE: Final = "node:"
"""How the id of a client's own object begins."""
TRANSFORM: Final = "tf:"
"""How the id of a transform begins that a relay has read."""
_OWNED: Final = re.compile(r"(.*)@[a-z][a-z0-9_]{0,62}", re.DOTALL)


def name_of(object_id: str) -> TopicName:
    """The global name that an object's id stands for."""
    if object_id.startswith(NODE):
        return TopicName(f"/{object_id.removeprefix(NODE)}/node")
    owned = _OWNED.fullmatch(object_id)
    return TopicName("/" + (object_id if owned is None else owned[1]).lstrip("/"))


def check_right(access: AccessTable, client: ClientName, object_id: str) -> None:
    """Raises RefusedError when the client may not have an object of this id."""
    if object_id.startswith(NODE):
        if object_id != NODE + client:
            raise RefusedError("not_owner", f"{client} may not put {object_id[:80]}: it belongs to the client it names")
        return
    name = TopicName("/" + object_id.removesuffix(f"@{client}").lstrip("/"))
    if not access.may_publish(client, name):
        raise RefusedError(
            "forbidden",
            f"{client} may not put {object_id[:80]}: no access rule lets it publish {name[:80]}; "
            "add it under access.publish",
        )


def check_far_right(access: AccessTable, item: XrObject) -> None:
    """Raises RefusedError when an owner who is at another relay may not have this object by the rules of this one."""
    topic = item.attributes.get("topic") if item.id.startswith(TRANSFORM) else None
    if topic is not None and access.may_publish(item.owner, TopicName(topic)):
        return
    check_right(access, item.owner, item.id)
