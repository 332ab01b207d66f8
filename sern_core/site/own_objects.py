"""Cross-reality objects of this client at the relay: its metadata, transforms, patches."""

from sern_core.link.control_stream import ControlStream
from sern_core.vocabulary.types import ObjectKind
from sern_core.wire import framing


class OwnObjects:
    """What is put is there until it is deleted, or this client is forgotten."""

    def __init__(self, control: ControlStream) -> None:
        self._control = control

    def put(
        self,
        object_id: str,
        kind: ObjectKind,
        type_name: str,
        *,
        wall_ns: int,
        now: float,
        attributes: dict[str, str] | None = None,
        value: bytes = b"",
    ) -> None:
        """Create or replace one."""
        envelope: framing.Envelope = {
            "t": "object",
            "op": "put",
            "id": object_id,
            "kind": str(kind),
            "type": type_name,
            "attr": dict(attributes or {}),
            "wall": wall_ns,
        }
        self._control.send(envelope, value, now=now)

    def delete(self, object_id: str, *, now: float) -> None:
        self._control.send({"t": "object", "op": "delete", "id": object_id}, now=now)
