"""The `object` message: a client creates, replaces or deletes a cross-reality object of its own."""

from sern_core import wire
from sern_core.errors import WireError
from sern_core.objects import ObjectRegistry
from sern_core.types import ClientName, ObjectKind


def apply_object(
    registry: ObjectRegistry, client: ClientName, envelope: wire.Envelope, attachment: bytes, *, now: float
) -> None:
    """Do what a client's `object` message says (schemas/wire.md). Raises WireError for one that no honest client sends,
    RefusedError for what the registry does not take."""
    object_id = wire.take_str(envelope, "id")
    attributes = envelope.get("attr", {})
    kind = wire.take_str(envelope, "kind", max_length=16, default="node")
    if kind not in set(ObjectKind) or not isinstance(attributes, dict):
        raise WireError(f"bad object {object_id!r}")
    if not all(isinstance(key, str) and isinstance(value, str) for key, value in attributes.items()):
        raise WireError(f"attributes of object {object_id!r} must map strings to strings")
    if wire.take_str(envelope, "op", max_length=8) == "delete":
        registry.delete(object_id, owner=client)
    else:
        registry.put(
            object_id,
            owner=client,
            kind=ObjectKind(kind),
            type_name=wire.take_str(envelope, "type", default=""),
            attributes=attributes,
            value=attachment or None,
            wall_ns=wire.take_int(envelope, "wall", default=0),
            now=now,
        )
