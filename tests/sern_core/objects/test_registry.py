"""The object registry: ownership, limits, values large and small, and a change feed that never misses anything."""

import base64
import hashlib
import json
from collections.abc import Callable

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from sern_core.bodies.codecs import SIZE, encode
from sern_core.objects.object_limits import ObjectLimits
from sern_core.objects.registry import ObjectRegistry, kind_of, topic_object_id
from sern_core.objects.xr_object import object_to_json
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, ObjectKind, PriorityClass, TopicName
from tests.exploring import cases

A, B = ClientName("a"), ClientName("b")


def stream(
    topic: str = "/odom",
    *,
    origin: str = "a",
    boot: int = 1,
    type_name: str = "nav_msgs/Odometry",
    priority: PriorityClass = PriorityClass.BULK,
    definition: str = "float64 x",
) -> StreamInfo:
    name = TopicName(topic)
    return StreamInfo(
        StreamId(ClientName(origin), boot, name),
        TopicInfo(name, type_name, Encoding.ROS1, "cafe", definition),
        TopicSpec(priority=priority),
        {"frame_id": "base"},
    )


def put(
    registry: ObjectRegistry, object_id: str, owner: ClientName = A, value: bytes | None = None, text: str = ""
) -> None:
    registry.put(
        object_id,
        owner=owner,
        kind=ObjectKind.NODE,
        type_name="t",
        definition=text,
        value=value,
        wall_ns=1,
        now=1.0,
    )


def refused(registry: ObjectRegistry, object_id: str, owner: ClientName = A, **more: str) -> RefusedError:
    before = registry.version, registry.select()
    with pytest.raises(RefusedError) as caught:
        put(registry, object_id, owner, **more)  # type: ignore[arg-type]
    assert (registry.version, registry.select()) == before
    assert "\n" not in str(caught.value)
    registry.validate()
    return caught.value


@pytest.mark.parametrize(
    ("type_name", "priority", "kind"),
    [
        ("geometry_msgs/Twist", PriorityClass.CONTROL, ObjectKind.COMMAND),
        ("geometry_msgs/msg/TwistStamped", PriorityClass.CONTROL, ObjectKind.COMMAND),
        ("trajectory_msgs/JointTrajectory", PriorityClass.CONTROL, ObjectKind.COMMAND),
        ("geometry_msgs/Twist", PriorityClass.STATE, ObjectKind.TOPIC),
        ("nav_msgs/Odometry", PriorityClass.CONTROL, ObjectKind.TOPIC),
        ("tf2_msgs/msg/TFMessage", PriorityClass.CONTROL, ObjectKind.TRANSFORM),
        ("tf/tfMessage", PriorityClass.BULK, ObjectKind.TRANSFORM),
        ("map_msgs/msg/OccupancyGridUpdate", PriorityClass.STATE, ObjectKind.PATCH),
        ("map_msgs/PointCloud2Update", PriorityClass.BULK, ObjectKind.PATCH),
    ],
)
def test_kinds(type_name: str, priority: PriorityClass, kind: ObjectKind) -> None:
    assert kind_of(stream(type_name=type_name, priority=priority)) is kind


def test_the_life_of_a_topic_object() -> None:
    registry = ObjectRegistry(epoch=7)
    info = stream()
    created = registry.put_stream(info, wall_ns=10, now=1.0)
    assert (created.id, created.owner, created.seq, created.value, created.value_bytes) == ("/odom@a", A, 0, None, -1)
    assert created.attributes["class"] == "bulk" and created.attributes["frame_id"] == "base"
    assert registry.observe(info.id, 1, b"first", wall_ns=11, now=2.0, ros_stamp_ns=5)
    assert not registry.observe(info.id, 1, b"again", wall_ns=12, now=3.0)
    seen = registry.get("/odom@a")
    assert seen is not None
    assert (seen.value, seen.seq, seen.wall_ns, seen.ros_stamp_ns) == (b"first", 1, 11, 5)
    assert (seen.created_s, seen.updated_s, seen.version) == (1.0, 2.0, 2)
    assert seen.value_sha256 == hashlib.sha256(b"first").hexdigest()
    assert registry.delete_stream(info.id)
    assert not registry.delete_stream(info.id)
    assert not registry.observe(info.id, 2, b"late", wall_ns=13, now=4.0)
    assert registry.get("/odom@a") is None and registry.total_bytes == 0
    registry.validate()


def test_a_new_boot_starts_over_and_the_old_one_is_not_heard() -> None:
    registry = ObjectRegistry()
    old, new = stream(boot=9), stream(boot=3)
    registry.put_stream(old, wall_ns=0, now=0.0)
    registry.observe(old.id, 50, b"old", wall_ns=0, now=0.0)
    registry.put_stream(old, wall_ns=0, now=0.0)  # announced again: the value stays
    again = registry.get(topic_object_id(old.id))
    assert again is not None and again.value == b"old" and again.seq == 50
    fresh = registry.put_stream(new, wall_ns=0, now=1.0)
    assert (fresh.seq, fresh.value, fresh.value_bytes) == (0, None, -1)
    assert not registry.observe(old.id, 51, b"late", wall_ns=0, now=1.0)
    assert not registry.delete_stream(old.id)
    assert registry.observe(new.id, 1, b"new", wall_ns=0, now=1.0)
    registry.validate()


def test_large_values_are_referenced_and_hashed_on_demand() -> None:
    registry = ObjectRegistry(limits=ObjectLimits(max_value_bytes=4, max_held_bytes=20))
    one, two = stream("/one"), stream("/two")
    registry.put_stream(one, wall_ns=0, now=0.0)
    registry.put_stream(two, wall_ns=0, now=0.0)
    body = b"0123456789ab"
    assert registry.observe(one.id, 1, body, wall_ns=0, now=0.0)
    assert registry._by_stream[one.id].body is body
    assert registry.held_bytes == 12
    assert registry.observe(two.id, 1, body, wall_ns=0, now=0.0)  # over the budget: only the size
    assert registry.held_bytes == 12
    registry.validate()
    seen, unhashed = registry.get("/one@a"), registry.get("/two@a")
    assert seen is not None and unhashed is not None
    assert (seen.value, seen.value_bytes, seen.value_sha256) == (None, 12, hashlib.sha256(body).hexdigest())
    assert (unhashed.value, unhashed.value_bytes, unhashed.value_sha256) == (None, 12, None)
    assert registry.held_bytes == 0
    assert registry.get("/one@a") == seen  # remembered without the body
    assert registry.observe(one.id, 2, b"tiny", wall_ns=0, now=0.0)
    small = registry.get("/one@a")
    assert small is not None and small.value == b"tiny"
    registry.validate()


def test_a_full_registry_keeps_only_sizes() -> None:
    registry = ObjectRegistry(limits=ObjectLimits(max_total_bytes=20))
    put(registry, "0123456789")
    put(registry, "0123456789", value=b"123")
    assert refused(registry, "another one").code == "registry_full"
    assert refused(registry, "0123456789", text="x" * 10).code == "registry_full"


def test_other_owners_are_refused_by_name() -> None:
    registry = ObjectRegistry()
    put(registry, "plan")
    assert str(refused(registry, "plan", B)) == "b may not put plan: a owns it; choose another id"
    with pytest.raises(RefusedError, match="b may not delete plan: a owns it"):
        registry.delete("plan", owner=B)
    assert refused(registry, "/odom@a", B).code == "not_owner"  # before `a` ever announced it
    put(registry, "/odom@b", B)
    assert registry.delete("plan", owner=A) and not registry.delete("plan", owner=A)
    put(registry, "plan", B)


@pytest.mark.parametrize("object_id", ["", "x" * 513, "a\nb", "a\0", "\ud800"])
def test_bad_ids(object_id: str) -> None:
    assert refused(ObjectRegistry(), object_id).code == "bad_id"


def test_limits_are_refused_by_name() -> None:
    registry = ObjectRegistry(
        limits=ObjectLimits(max_objects_per_owner=1, max_definition_bytes=3, max_attributes=1, max_attribute_bytes=4)
    )
    put(registry, "x", text="abc")
    assert str(refused(registry, "y")) == "a may not put y: it has 1 objects, which is the limit; delete some"
    assert refused(registry, "x", text="abcd").code == "too_large"
    for attributes in ({"a": "1", "b": "2"}, {"a": "1234"}):
        with pytest.raises(RefusedError, match="attributes; at most") as caught:
            registry.put("x", owner=A, kind=ObjectKind.NODE, type_name="t", attributes=attributes, wall_ns=0, now=0.0)
        assert caught.value.code == "too_large"
    registry.delete("x", owner=A)
    put(registry, "x", B)
    assert len(registry) == 1
    registry.validate()


def test_definition_hash_is_sha256_unless_given() -> None:
    registry = ObjectRegistry()
    put(registry, "x", text="int32 a")
    seen = registry.get("x")
    assert seen is not None and seen.definition_hash == hashlib.sha256(b"int32 a").hexdigest()
    assert registry.put_stream(stream(), wall_ns=0, now=0.0).definition_hash == "cafe"


def test_selecting_and_deleting_by_owner() -> None:
    registry = ObjectRegistry()
    put(registry, "n2")
    put(registry, "n1")
    put(registry, "m", B)
    registry.put_stream(stream(), wall_ns=0, now=0.0)
    assert [item.id for item in registry.select()] == ["/odom@a", "m", "n1", "n2"]
    assert [item.id for item in registry.select(owner=A, kind=ObjectKind.NODE)] == ["n1", "n2"]
    assert registry.select(owner=ClientName("c")) == ()
    assert registry.delete_owned(A) == ("/odom@a", "n1", "n2")
    assert registry.delete_owned(A) == ()
    assert len(registry) == 1
    registry.validate()


def test_the_feed_coalesces_and_reports_deletions() -> None:
    registry = ObjectRegistry(epoch=7)
    info = stream()
    registry.put_stream(info, wall_ns=0, now=0.0)
    put(registry, "x")
    put(registry, "y")
    start = registry.since(0)
    assert [item.id for item in start.updated] == ["/odom@a", "x", "y"] and not start.resync
    for seq in range(1, 101):
        registry.observe(info.id, seq, b"v", wall_ns=0, now=0.0)
    registry.delete("x", owner=A)
    registry.delete("y", owner=A)
    put(registry, "y")
    changes = registry.since(start.version)
    assert [(item.id, item.seq) for item in changes.updated] == [("/odom@a", 100), ("y", 0)]
    assert changes.deleted == ("x",)
    assert registry.since(changes.version).updated == ()
    assert registry.since(changes.version, epoch=7).resync is False


@pytest.mark.parametrize(("version", "epoch"), [(999, None), (-1, None), (2, 8), (0, 8)])
def test_the_feed_of_another_run_starts_over(version: int, epoch: int | None) -> None:
    registry = ObjectRegistry(epoch=7)
    put(registry, "x")
    put(registry, "y")
    changes = registry.since(version, epoch=epoch)
    assert changes.resync and changes.epoch == 7
    assert [item.id for item in changes.updated] == ["x", "y"]


@pytest.mark.parametrize("length", [0, 2])
def test_a_short_deletion_log_asks_for_a_resync(length: int) -> None:
    registry = ObjectRegistry(limits=ObjectLimits(deletions=length))
    put(registry, "keep")
    for name in "abc":
        put(registry, name)
    before = registry.version
    for name in "abc":
        registry.delete(name, owner=A)
    assert registry.since(before).resync
    assert [item.id for item in registry.since(before).updated] == ["keep"]
    assert registry.since(before + 1).resync is (length == 0)
    assert not registry.since(registry.version).resync
    assert not registry.since(0).resync  # a reader that has nothing needs no deletions


def test_json_shape() -> None:
    registry = ObjectRegistry(epoch=7, limits=ObjectLimits(max_value_bytes=4))
    info = stream()
    registry.put_stream(info, wall_ns=3, now=1.0)
    registry.observe(info.id, 1, b"\x00\xff", wall_ns=5, now=2.0)
    put(registry, "big", value=b"12345")
    put(registry, "none")
    odom, big, none = json.loads(json.dumps([object_to_json(item, key="k") for item in registry.select()]))
    assert odom == {
        "id": "/odom@a",
        "owner": "a",
        "kind": "topic",
        "type": "nav_msgs/Odometry",
        "definition_hash": "cafe",
        "definition_key": "k",
        "attributes": {
            "frame_id": "base",
            "topic": "/odom",
            "class": "bulk",
            "reliability": "best_effort",
            "durability": "volatile",
            "encoding": "ros1",
        },
        "version": 2,
        "seq": 1,
        "created_s": 1.0,
        "updated_s": 2.0,
        "ros_stamp_ns": None,
        "wall_ns": 5,
        "value": {"bytes": 2, "base64": base64.b64encode(b"\x00\xff").decode()},
    }
    assert big["value"] == {"bytes": 5, "sha256": hashlib.sha256(b"12345").hexdigest()}
    assert none["value"] is None
    assert "value" not in object_to_json(registry.select()[0], values=False)
    assert registry.named(topic=TopicName("/odom")) == registry.named(owner=A, topic=TopicName("/odom")) == ["/odom@a"]
    assert registry.named(owner=ClientName("c"), topic=TopicName("/odom")) == []
    assert sorted(registry.named()) == sorted(registry.named(owner=A)) == ["/odom@a", "big", "none"]


# Against a model -----------------------------------------------------------------------------------------------------

IDS = ("x", "y", "z", "/t@a", "/u@b")
OWNERS = (A, B)


def test_where_it_must_not_take_long_large_values_are_read_elsewhere() -> None:
    """Nothing large is decoded or hashed by whoever asks; what `unread` gave is, and counts while it is the latest."""
    registry = ObjectRegistry()
    registry.inline_bytes = 1000
    info = stream()
    registry.put_stream(info, wall_ns=0, now=0.0)
    raw = b"point " * 10_000
    codec, body = encode(Compression.ZSTD, raw)
    for seq, value in ((1, body), (2, bytes(bytearray(body)))):
        assert registry.observe(info.id, seq, value, wall_ns=0, now=1.0, codec=codec)
    object_id = topic_object_id(info.id)

    def told() -> object:
        return object_to_json(registry.select()[0])["value"]

    assert told() == {"bytes": len(raw), "sha256": None}
    assert registry.unread(kind=ObjectKind.NODE) == [] == registry.unread(version=registry.version)
    (request,) = registry.unread(kind=ObjectKind.TOPIC, owner=A)
    request.run()
    assert told() == {"bytes": len(raw), "sha256": None}  # done is what tells it
    request.done(now=2.0)
    assert told() == {"bytes": len(raw), "sha256": hashlib.sha256(raw).hexdigest()}
    assert registry.unread() == []
    registry.validate()

    other = b"other " * 10_000  # a value that came meanwhile is not lost
    codec, newer = encode(Compression.ZSTD, other)
    registry.observe(info.id, 3, body, wall_ns=0, now=3.0, codec=codec)
    (late,) = registry.unread()
    late.run()
    registry.observe(info.id, 4, newer, wall_ns=0, now=4.0, codec=codec)
    late.done(now=5.0)
    assert told() == {"bytes": len(other), "sha256": None}
    registry.observe(info.id, 5, SIZE.pack(50_000) + b"no frame", wall_ns=0, now=6.0, codec=codec)
    (damaged,) = registry.unread()
    damaged.run()
    damaged.done(now=6.0)
    assert told() is None
    small, text = encode(Compression.ZSTD, b"abc " * 200)
    registry.observe(info.id, 6, text, wall_ns=0, now=7.0, codec=small)
    assert registry.unread() == []
    found = registry.get(object_id)
    assert found is not None and found.value == b"abc " * 200
    registry.validate()


class RegistryMachine(RuleBasedStateMachine):
    """A model of plain dictionaries, and a reader that follows the feed and must end up with the same."""

    @initialize()
    def start(self) -> None:
        self.limits = ObjectLimits(
            max_objects_per_owner=3, max_total_bytes=160, max_held_bytes=25, max_value_bytes=4, deletions=3
        )
        self.registry = ObjectRegistry(limits=self.limits)
        self.owner: dict[str, ClientName] = {}
        self.size: dict[str, int] = {}
        self.mirror: dict[str, int] = {}  # id -> version, as a reader of the feed knows them
        self.read = 0
        self.seq = 0
        self.boot: dict[str, int] = {}

    def attempt(self, call: Callable[[], object]) -> str | None:
        try:
            call()
        except RefusedError as error:
            return error.code
        return None

    def forget(self, object_id: str) -> None:
        self.owner.pop(object_id, None)
        self.size.pop(object_id, None)
        self.boot.pop(object_id, None)

    @rule(object_id=st.sampled_from(IDS), owner=st.sampled_from(OWNERS), value=st.none() | st.binary(max_size=15))
    def put(self, object_id: str, owner: ClientName, value: bytes | None) -> None:
        wrong = self.owner.get(object_id, owner) != owner or ("@" in object_id and object_id[-1] != owner)
        full = object_id not in self.owner and list(self.owner.values()).count(owner) == 3
        before, held_bytes = self.registry.version, self.registry.held_bytes
        code = self.attempt(lambda: put(self.registry, object_id, owner, value))
        if wrong or full:
            assert code == ("not_owner" if wrong else "too_many_objects")
        if code is not None:
            assert wrong or full or code == "registry_full"
            assert (self.registry.version, self.registry.held_bytes) == (before, held_bytes)
            return
        self.owner[object_id] = owner
        if value is not None:
            self.size[object_id] = len(value)

    @rule(topic=st.sampled_from(("/t@a", "/u@b")), boot=st.integers(1, 2))
    def put_stream(self, topic: str, boot: int) -> None:
        name, origin = topic.split("@")
        info = StreamInfo(
            StreamId(ClientName(origin), boot, TopicName(name)),
            TopicInfo(TopicName(name), "t", Encoding.RAW),
            TopicSpec(),
        )
        code = self.attempt(lambda: self.registry.put_stream(info, wall_ns=0, now=0.0))
        if code is not None:
            assert code in {"too_many_objects", "registry_full"}
            return
        if self.boot.get(topic, boot) != boot:
            self.size.pop(topic, None)
        self.boot[topic] = boot
        self.owner[topic] = ClientName(origin)

    @rule(topic=st.sampled_from(("/t@a", "/u@b")), boot=st.integers(1, 2), body=st.binary(max_size=15))
    def observe(self, topic: str, boot: int, body: bytes) -> None:
        name, origin = topic.split("@")
        self.seq += 1
        held = StreamId(ClientName(origin), boot, TopicName(name))
        taken = self.registry.observe(held, self.seq, body, wall_ns=0, now=0.0)
        assert taken == (self.boot.get(topic) == boot)
        if taken:
            self.size[topic] = len(body)

    @rule(object_id=st.sampled_from(IDS), owner=st.sampled_from(OWNERS))
    def delete(self, object_id: str, owner: ClientName) -> None:
        if self.owner.get(object_id, owner) != owner:
            with pytest.raises(RefusedError):
                self.registry.delete(object_id, owner=owner)
            return
        assert self.registry.delete(object_id, owner=owner) == (object_id in self.owner)
        self.forget(object_id)

    @rule(owner=st.sampled_from(OWNERS))
    def delete_owned(self, owner: ClientName) -> None:
        mine = sorted(object_id for object_id, held in self.owner.items() if held == owner)
        assert self.registry.delete_owned(owner) == tuple(mine)
        for object_id in mine:
            self.forget(object_id)

    @rule()
    def follow(self) -> None:
        changes = self.registry.since(self.read)
        if changes.resync:
            self.mirror.clear()
        for object_id in changes.deleted:
            self.mirror.pop(object_id, None)
        self.mirror.update({item.id: item.version for item in changes.updated})
        self.read = changes.version
        assert self.mirror == {item.id: item.version for item in self.registry.select()}

    @invariant()
    def agrees(self) -> None:
        self.registry.validate()
        assert {object_id: entry.owner for object_id, entry in self.registry._entries.items()} == self.owner
        sizes = {object_id: entry.value_bytes for object_id, entry in self.registry._entries.items()}
        assert {object_id: size for object_id, size in sizes.items() if size >= 0} == self.size


def test_against_a_model() -> None:
    run_state_machine_as_test(
        RegistryMachine,
        settings=settings(max_examples=cases(60), stateful_step_count=30),
    )
