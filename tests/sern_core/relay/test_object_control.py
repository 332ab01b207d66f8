"""Objects that clients put: what is whose, who may, and how much."""

from typing import Any

import pytest

from sern_core.objects.registry import ObjectRegistry
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from tests.fuzz.test_hostile_peer import Hostile
from tests.world import World, spec

RULES = AccessTable([AccessRule(client="robot", publish=("/{self}/.*", "/zones/.*"))])


def put(object_id: str, **fields: Any) -> dict[str, Any]:
    return {"t": "object", "op": "put", "id": object_id, "kind": "node", "type": "a", "attr": {}, "wall": 0, **fields}


@pytest.mark.parametrize(
    ("client", "object_id", "code"),
    [
        ("robot", "node:robot", None),
        ("mallory", "node:mallory", None),  # needs no right: it says that a client is there
        ("mallory", "node:robot", "not_owner"),
        ("mallory", "node:", "not_owner"),
        ("mallory", "node:mallory@mallory", "not_owner"),
        ("mallory", "anything", "forbidden"),
        ("mallory", "/robot/odom", "forbidden"),
        ("mallory", "/robot/odom@mallory", "forbidden"),
        ("robot", "/robot/odom@mallory", "not_owner"),
        ("robot", "/robot/patch@robot", None),
        ("robot", "robot/patch", None),
        ("robot", "zones/hall@robot", None),
        ("robot", "zones/hall@mallory", "not_owner"),
        ("robot", "zones", "forbidden"),
        ("robot", "robot/" + "x" * 300, "forbidden"),
    ],
)
def test_an_id_is_taken_from_who_may_publish_its_name(client: str, object_id: str, code: str | None) -> None:
    world = World(access=RULES)
    peer = Hostile(world, client)
    peer.control(put(object_id))
    assert [refused for refused, _text in world.relay.refusals] == ([code] if code else [])
    assert (peer.hub.objects.get(object_id) is not None) == (code is None)
    peer.control({"t": "object", "op": "delete", "id": object_id})
    assert len(peer.hub.objects) == 0
    peer.hub.validate()


def test_a_client_fills_what_is_its_own_and_nobody_elses() -> None:
    world = World()
    mallory, robot = Hostile(world, "mallory"), Hostile(world, "robot")
    hub = world.relay.hub
    large = {f"k{index}": "v" * 460 for index in range(6)}
    for index in range(4095):
        mallory.control(put(f"x{index:0200d}", attr=large), bytes(4096))
        while mallory.port.next_datagram(now=mallory.now) is not None:
            pass
    limits = hub.objects.limits
    assert hub.objects.total_bytes <= limits.max_bytes_per_owner < limits.max_total_bytes / 4
    assert ("registry_full" in dict(world.relay.refusals)) and len(hub.objects) > 500
    world.relay.refusals.clear()
    robot.announce(1, "/robot/odom")
    assert hub.objects.get("/robot/odom@robot") is not None and not world.relay.refusals
    hub.validate()
    hub.forget(ClientName("mallory"), "test", now=0.0)
    assert len(hub.objects) == 1
    hub.validate()


def test_large_values_of_one_client_leave_room_for_those_of_others() -> None:
    objects = ObjectRegistry()
    for owner, count in (("robot", 40), ("other", 1)):
        for index in range(count):
            identity = StreamId(ClientName(owner), 1, TopicName(f"/{owner}/t{index}"))
            info = TopicInfo(identity.topic, "a/b", Encoding.CDR)
            objects.put_stream(StreamInfo(identity, info, spec()), wall_ns=0, now=0.0)
            objects.observe(identity, 1, bytes(2**20), wall_ns=0, now=0.0)
    assert 0 < objects.held_bytes - 2**20 <= objects.limits.max_held_per_owner
    seen = objects.get("/other/t0@other")
    assert seen is not None and seen.value_sha256 is not None
    objects.validate()
