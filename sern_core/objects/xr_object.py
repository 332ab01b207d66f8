"""A cross-reality object as its readers see it, and its JSON shape.

Served at /api/objects

    {"epoch": 7, "version": 120, "objects": [{
        "id": "/jackal1/odom@jackal1", "owner": "jackal1", "kind": "topic", "type": "nav_msgs/Odometry",
        "definition_hash": "<64 hex digits>", "definition_key": "<32 hex digits>", "attributes": {"class": "control"},
        "version": 119, "seq": 42, "created_s": 12.5, "updated_s": 99.0,       monotonic seconds of the registry's host
        "ros_stamp_ns": null or int, "wall_ns": int,                           nanoseconds
        "value": {"bytes": 720, "base64": "..."}                               up to 4 KiB
              or {"bytes": 1000000, "sha256": "<64 hex digits>" or null}       larger
              or null                                                          nothing seen yet
    }], "definitions": {"<32 hex digits>": "..."}}                             each text once, by its definition_key
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from sern_core.vocabulary.types import ClientName, ObjectKind


@dataclass(frozen=True, slots=True)
class XrObject:
    """One cross-reality object as it was when asked for.

    `definition_hash` is the SHA-256 hex of the definition text unless its owner gave another (ROS 1 md5, RIHS01);
    empty where neither is known.
    `value` is the latest value, None when there is none or it is larger than the limit; then `value_bytes` and
    `value_sha256` still tell about it (`value_bytes` -1: nothing seen yet). `created_s` and `updated_s` are monotonic
    seconds of this host, `wall_ns` is the wall time at the origin, `ros_stamp_ns` the ROS stamp, untouched.
    """

    id: str
    owner: ClientName
    kind: ObjectKind
    type_name: str
    definition: str
    definition_hash: str
    attributes: Mapping[str, str]
    value: bytes | None
    value_bytes: int
    value_sha256: str | None
    seq: int
    ros_stamp_ns: int | None
    wall_ns: int
    created_s: float
    updated_s: float
    version: int


class ObjectChanges(NamedTuple):
    """What changed since a version. With `resync`, forget everything and take `updated` as the whole registry."""

    epoch: int
    version: int
    resync: bool
    updated: tuple[XrObject, ...]  # oldest change first
    deleted: tuple[str, ...]  # ids, oldest first, without those that exist again


class ChangedIds(NamedTuple):
    """`ObjectChanges` with ids in place of objects."""

    epoch: int
    version: int
    resync: bool
    updated: tuple[str, ...]
    deleted: tuple[str, ...]
    in_order: tuple[str, ...]  # both, the oldest change first


def object_to_json(item: XrObject, *, key: str = "", values: bool = True) -> dict[str, Any]:
    """One element of `objects` in the module's JSON shape; `key` of its definition, without `values` none."""
    value: dict[str, Any] | None = None
    if item.value is not None:
        value = {"bytes": item.value_bytes, "base64": base64.b64encode(item.value).decode("ascii")}
    elif item.value_bytes >= 0:
        value = {"bytes": item.value_bytes, "sha256": item.value_sha256}
    return {
        "id": item.id,
        "owner": item.owner,
        "kind": item.kind.value,
        "type": item.type_name,
        "definition_hash": item.definition_hash,
        "definition_key": key,
        "attributes": dict(item.attributes),
        "version": item.version,
        "seq": item.seq,
        "created_s": item.created_s,
        "updated_s": item.updated_s,
        "ros_stamp_ns": item.ros_stamp_ns,
        "wall_ns": item.wall_ns,
        **({"value": value} if values else {}),
    }
