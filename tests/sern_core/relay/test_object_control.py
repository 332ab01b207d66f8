"""Objects that clients put by hand: what is whose, who may, how much, and what is none."""

from typing import Any

import pytest

from sern_core.objects.changes import OBJECTS_TOPIC
from sern_core.objects.registry import ObjectRegistry
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.object_rights import name_of
from sern_core.site.object_mirror import Selection
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, ObjectKind, TopicName
from sern_core.wire import framing
from tests.fuzz.test_hostile_peer import Hostile
from tests.world import World, spec

RULES = AccessTable([AccessRule(client="robot", publish=("/{self}/.*", "/zones/.*"))])


class Owner(Hostile):
    """A client that puts objects by hand."""

    def __init__(self, world: World, name: str = "robot") -> None:
        super().__init__(world, name)
        self.announce(1, OBJECTS_TOPIC, reliable=True)
        self.seq = 0

    def change(self, attachment: bytes = b"", **envelope: Any) -> None:
        self.seq += 1
        body = framing.encode_control(envelope, attachment)
        self.say(framing.encode_data_first(0, 1, self.seq, len(body), len(body), 0, 0.0, 0) + body)

    def put(self, object_id: str, **fields: Any) -> None:
        self.change(**{"op": "put", "id": object_id, "kind": "node", "type": "a", "n": -1, **fields})


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
    peer = Owner(world, client)
    peer.put(object_id)
    assert [refused for refused, _text in world.relay.refusals] == ([code] if code else [])
    assert (peer.hub.objects.get(object_id) is not None) == (code is None)
    peer.change(op="delete", id=object_id)
    assert len(peer.hub.objects) == 0
    peer.hub.validate()


@pytest.mark.parametrize(
    ("object_id", "name"),
    [
        ("node:robot", "/robot/node"),
        ("/robot/odom@robot", "/robot/odom"),
        ("zones/hall", "/zones/hall"),
        ("zones/hall@Robot", "/zones/hall@Robot"),
        ("//zones/hall@a", "/zones/hall"),
    ],
)
def test_the_name_that_an_id_stands_for(object_id: str, name: str) -> None:
    assert name_of(object_id) == name


@pytest.mark.parametrize(
    "change",
    [
        {"op": "put", "id": "robot/a"},
        {"op": "put", "id": "robot/a", "kind": "thing", "n": -1},
        {"op": "put", "id": "robot/a", "kind": "node", "n": -2},
        {"op": "put", "id": "robot/a", "kind": "node", "n": 3, "val": True},
        {"op": "put", "id": "robot/a", "kind": "node", "n": -1, "attr": {"a": 1}},
        {"op": "put", "id": "robot/\x00", "kind": "node", "n": -1},
        {"op": "define", "dh": "0" * 32},
        {"op": "take", "id": "robot/a"},
        {"op": "end"},
        {"op": "begin", "epoch": -1},
        {},
    ],
)
def test_what_is_no_change_is_refused_and_changes_nothing(change: dict[str, Any]) -> None:
    world = World(access=RULES)
    peer = Owner(world)
    peer.put("robot/kept")
    peer.change(**change)
    peer.put("robot/later")
    assert [refused for refused, _text in world.relay.refusals] == ["bad_object"]
    assert {item.id for item in peer.hub.objects.select()} == {"robot/kept", "robot/later"}
    assert peer.hub.exchange.counts == {"taken": 2, "bad_object": 1}
    peer.hub.validate()


def test_an_object_that_could_not_be_told_to_others_is_refused_and_harms_nobody() -> None:
    """Its envelope is as long as one may be: with its owner's name, as others are told, it would be longer."""
    world = World()
    world.tell_objects()
    site = world.client("site")
    site.core.subscribe_objects([Selection()], now=site.now)
    world.run(1.0)
    peer = Owner(world, "mallory")
    peer.now = world.now
    fields = {f"k{number}": "v" * 460 for number in range(8)}
    fields["k"] = "v" * (4096 - 40 - len("".join(fields)) - 8 * 464 - 64)
    while (
        framing.envelope_bytes({"op": "put", "id": "x", "kind": "node", "type": "a", "n": -1, "attr": fields})
        < framing.MAX_ENVELOPE_BYTES
    ):
        fields["k"] += "v"
    peer.put("x", attr=fields)
    peer.put("y")
    world.run(2.0)
    assert [refused for refused, _text in world.relay.refusals] == ["too_large"]
    assert set(site.core.mirror.objects) == {"y"} and not site.downs
    world.relay.hub.validate()


def test_what_fits_into_no_message_is_left_out_for_the_one_object() -> None:
    world = World()
    world.tell_objects()
    site = world.client("site")
    site.core.subscribe_objects([Selection()], now=site.now)
    world.run(1.0)
    objects = world.relay.hub.objects
    for name, size in (("wide", 4000), ("fine", 10)):
        objects.put(
            name, owner=ClientName("relay"), kind=ObjectKind.TRANSFORM, type_name="t" * 200,
            attributes={"a": "v" * size}, wall_ns=0, now=world.relay.now,
        )  # fmt: skip
    world.run(2.0)
    assert set(site.core.mirror.objects) == {"fine"} and not site.downs
    assert world.relay.hub.exchange.feeds[ClientName("site")].untold >= 1
    world.check_faults()


def test_a_subscription_that_is_none_ends_the_session_or_is_denied() -> None:
    world = World()
    peer = Owner(world)
    peer.control({"t": "objects", "kinds": [""], "match": ["(a"]})
    assert [code for code, _text in world.relay.refusals] == ["bad_pattern"]
    assert peer.hub.links[ClientName("robot")].established
    for wrong in (
        {"kinds": ["thing"], "match": [".*"]},
        {"kinds": [""]},
        {"kinds": [""] * 25, "match": [".*"] * 25},
        {"kinds": [""], "match": [".*"], "bare": 2},
    ):
        again = Owner(World())
        with pytest.raises(WireError, match="a subscription"):
            again.control({"t": "objects", **wrong})
    peer.hub.validate()


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
