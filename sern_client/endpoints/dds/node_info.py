"""`ros_discovery_info`: which nodes a participant has, and which readers and writers are whose.

Two layouts are read, that of ROS 2 Iron and later, and that before, with longer ids. Only the former is written.
"""

import struct
from collections.abc import Iterable
from typing import Any, Final, NamedTuple
from uuid import UUID

import numpy as np

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

TYPE: Final = "rmw_dds_common/msg/ParticipantEntitiesInfo"
MAX_BODY_BYTES: Final = 2**16
"""The largest body that is looked at: some 4000 readers and writers of one process."""
GID_BYTES: Final = 16
OLD_GID_BYTES: Final = 24
"""Before Iron: a GUID, and zeros."""
_HEADER_BYTES: Final = 4
_ALIGNMENT: Final = 4
_LITTLE: Final = struct.Struct("<I").unpack_from
_BIG: Final = struct.Struct(">I").unpack_from


def encode(participant: UUID, node_name: str, readers: Iterable[UUID], writers: Iterable[UUID]) -> bytes:
    """The body that says: this participant is one node, in the root namespace, with these readers and writers."""
    node = _new(
        "NodeEntitiesInfo",
        node_namespace="/",
        node_name=node_name,
        reader_gid_seq=[_gid(guid) for guid in readers],
        writer_gid_seq=[_gid(guid) for guid in writers],
    )
    info = _new("ParticipantEntitiesInfo", gid=_gid(participant), node_entities_info_seq=[node])
    return ros_types.serialise(info, TYPE, Encoding.CDR)


class Node(NamedTuple):
    """A node by its full name. `gids`: its readers and writers, 16 bytes each."""

    name: str
    gids: bytes


def by_entity(nodes: Iterable[Node]) -> dict[bytes, str]:
    """Names of nodes by the GUIDs of their readers and writers; the first node that names one has it."""
    found: dict[bytes, str] = {}
    for node in nodes:
        for at in range(0, len(node.gids), GID_BYTES):
            found.setdefault(node.gids[at : at + GID_BYTES], node.name)
    return found


def decode(body: bytes) -> tuple[UUID, list[Node]] | None:
    """Participant, and its nodes. None for what is larger than `MAX_BODY_BYTES` or does not decode in either layout.

    In the other layout there is always something left over: where one has zeros, the other has the number of nodes.
    """
    if not _HEADER_BYTES <= len(body) <= MAX_BODY_BYTES:
        return None
    return _decode(body, GID_BYTES) or _decode(body, OLD_GID_BYTES)


def _decode(body: bytes, gid_bytes: int) -> tuple[UUID, list[Node]] | None:
    """What others send costs no more than its bytes: GUIDs of today's layout are not looked at one by one."""
    number = _LITTLE if body[1] & 1 else _BIG
    at = _HEADER_BYTES + gid_bytes
    participant = body[_HEADER_BYTES : _HEADER_BYTES + GID_BYTES]
    if len(participant) < GID_BYTES:
        return None

    def part(element_bytes: int) -> bytes:
        """The next sequence: the number of its elements, which is aligned, and they."""
        nonlocal at
        at += -at % _ALIGNMENT  # the header has the size of the alignment
        start = at + _ALIGNMENT
        at = start + number(body, at)[0] * element_bytes
        if at > len(body):
            raise ValueError("a sequence with no end")
        return body[start:at]

    try:
        nodes = []
        count = number(body, at)[0]
        at += _ALIGNMENT
        for _ in range(count):
            namespace, name = part(1), part(1)
            if namespace[-1:] != b"\0" or name[-1:] != b"\0":
                return None
            full = f"{namespace[:-1].decode().rstrip('/')}/{name[:-1].decode()}"
            gids = part(gid_bytes) + part(gid_bytes)
            if gid_bytes > GID_BYTES:
                gids = b"".join(gids[start : start + GID_BYTES] for start in range(0, len(gids), gid_bytes))
            nodes.append(Node(full, gids))
    except (ValueError, struct.error):
        return None
    return (UUID(bytes=participant), nodes) if len(body) - at < _ALIGNMENT else None


def _new(name: str, **fields: Any) -> Any:
    return ros_types.new(f"rmw_dds_common/msg/{name}", Encoding.CDR, **fields)


def _gid(guid: UUID) -> Any:
    return _new("Gid", data=np.frombuffer(guid.bytes, dtype="uint8"))
