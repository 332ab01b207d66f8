"""The `object` message: a client creates, replaces or deletes a cross-reality object of its own.

`node:NAME` is the object of the client of that name, which needs no right for it. Any other id stands for a global
name: itself, without the `@client` at its end, under the leading `/` of names. Who may publish that name may put it.
"""

from sern_core.objects.registry import ObjectRegistry
from sern_core.relay.access import AccessTable
from sern_core.vocabulary.errors import RefusedError, WireError
from sern_core.vocabulary.types import ClientName, ObjectKind, TopicName
from sern_core.wire import framing

NODE = "node:"
"""How the id of a client's own object begins."""


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


def apply_object(
    registry: ObjectRegistry,
    access: AccessTable,
    client: ClientName,
    envelope: framing.Envelope,
    attachment: bytes,
    *,
    now: float,
) -> None:
    """Do what a client's `object` message says (schemas/wire.md). Raises WireError for one that no honest client sends,
    RefusedError for what it may not put, or the registry does not take."""
    object_id = framing.take_str(envelope, "id")
    attributes = envelope.get("attr", {})
    kind = framing.take_str(envelope, "kind", max_length=16, default="node")
    if kind not in set(ObjectKind) or not isinstance(attributes, dict):
        raise WireError(f"bad object {object_id!r}")
    if not all(isinstance(key, str) and isinstance(value, str) for key, value in attributes.items()):
        raise WireError(f"attributes of object {object_id!r} must map strings to strings")
    if framing.take_str(envelope, "op", max_length=8) == "delete":
        registry.delete(object_id, owner=client)
    else:
        check_right(access, client, object_id)
        registry.put(
            object_id,
            owner=client,
            kind=ObjectKind(kind),
            type_name=framing.take_str(envelope, "type", default=""),
            attributes=attributes,
            value=attachment or None,
            wall_ns=framing.take_int(envelope, "wall", default=0),
            now=now,
        )
