"""`ros_discovery_info`: which nodes a participant has, and which readers and writers are whose (since ROS 2 Iron)."""

from collections.abc import Iterable
from typing import Any, Final
from uuid import UUID

import numpy as np

from sern_core.errors import ConfigError
from sern_core.types import Encoding
from sern_runtime import ros_types

TYPE: Final = "rmw_dds_common/msg/ParticipantEntitiesInfo"


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


def decode(body: bytes) -> tuple[UUID, list[tuple[str, list[UUID]]]] | None:
    """Participant, and of each of its nodes the full name and its readers and writers. None if it does not decode:
    before Iron, GUIDs were longer."""
    try:
        info = ros_types.deserialise(body, TYPE, Encoding.CDR)
    except ConfigError:
        return None
    nodes = [
        (
            f"{node.node_namespace.rstrip('/')}/{node.node_name}",
            [_guid(gid) for gid in (*node.reader_gid_seq, *node.writer_gid_seq)],
        )
        for node in info.node_entities_info_seq
    ]
    return _guid(info.gid), nodes


def _new(name: str, **fields: Any) -> Any:
    return ros_types.new(f"rmw_dds_common/msg/{name}", Encoding.CDR, **fields)


def _gid(guid: UUID) -> Any:
    return _new("Gid", data=np.frombuffer(guid.bytes, dtype="uint8"))


def _guid(gid: Any) -> UUID:
    return UUID(bytes=gid.data.tobytes())
