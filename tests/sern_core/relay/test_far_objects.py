"""What another relay may tell of objects: also what no honest one tells, and how much of it is kept."""

from collections import Counter
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_core.objects.changes import Begin, Change, Define, Delete, End, Put, Set, text_hash
from sern_core.objects.mirror import Mirror, MirrorLimits
from sern_core.objects.registry import ObjectRegistry
from sern_core.objects.xr_object import XrObject
from sern_core.relay.far_objects import MAX_SAID, FarObjects
from sern_core.vocabulary.errors import RefusedError, WireError
from sern_core.vocabulary.types import ClientName, ObjectKind, TopicName
from tests.world import OPEN_ACCESS

A, B = ClientName("@a"), ClientName("@b")
HOMES = {"robot": A, "rover": B, "site": None}
TEXTS = ("float64 x\n", "float64 y\n", "z" * 200)


class Relay:
    """A registry and what peers tell of. `homes` may be changed."""

    def __init__(self) -> None:
        self.homes: dict[str, ClientName | None] = dict(HOMES)
        self.registry = ObjectRegistry(epoch=7)
        self.counts: Counter[str] = Counter()
        self.refused: list[tuple[ClientName, str, str]] = []
        self.topics: list[TopicName] = []
        self.now = 0.0
        self.far = FarObjects(
            self.registry,
            {ClientName("site")},
            access=lambda: OPEN_ACCESS,
            home=self.homes.get,
            refused=lambda peer, code, text: self.refused.append((peer, code, text)),
            counts=self.counts,
        )
        self.far.on_topic = self.topics.append

    def tell(self, peer: ClientName, change: Change) -> None:
        self.far.take(peer, change, now=self.now)

    def validate(self) -> None:
        self.far.validate()
        self.registry.validate()


def a_put(object_id: str, owner: str = "robot", *, value: bytes | None = b"v", text: str = "", **more: str) -> Put:
    size = -1 if value is None else len(value)
    return Put(object_id, owner, ObjectKind.TOPIC, "a", "", text_hash(text), more, value, size, "", 1, None, 0)


@pytest.mark.parametrize("owner", ["", "@a", "Robot", "a b", "x" * 64])
def test_an_owner_is_a_client(owner: str) -> None:
    relay = Relay()
    with pytest.raises(WireError, match="no client"):
        relay.tell(A, a_put("box", owner))


@pytest.mark.parametrize(("object_id", "code"), [("", "bad_id"), ("a\nb", "bad_id"), ("a@rover", "not_owner")])
def test_an_id_is_one_that_the_owner_may_have(object_id: str, code: str) -> None:
    relay = Relay()
    with pytest.raises(RefusedError) as refusal:
        relay.tell(A, a_put(object_id))
    assert refusal.value.code == code
    relay.validate()


def test_a_relay_tells_no_large_value() -> None:
    relay = Relay()
    with pytest.raises(WireError, match="5000 bytes"):
        relay.tell(A, a_put("box", value=bytes(5000)))
    relay.tell(A, a_put("box"))
    with pytest.raises(WireError, match="5000 bytes"):
        relay.tell(A, Set("box", bytes(5000), 5000, "", 2, None, 0))
    relay.tell(A, Set("box", None, 5000, "ab", 2, None, 0))
    item = relay.registry.get("box")
    assert item is not None and (item.value, item.value_bytes, item.value_sha256, item.seq) == (None, 5000, "ab", 2)


def test_an_object_is_shown_while_its_owner_is_at_the_relay_that_tells_of_it() -> None:
    relay = Relay()
    relay.tell(A, a_put("box", "rover"))
    relay.tell(A, a_put("wall", "nobody"))
    assert not len(relay.registry)
    relay.homes["rover"] = A
    relay.far.moved(ClientName("rover"), now=0.0)
    assert relay.registry.named() == ["box"]
    relay.homes["rover"] = None  # that relay says anew who is there
    relay.tell(A, Set("box", b"2", 1, "", 2, None, 0))
    item = relay.registry.get("box")
    assert item is not None and item.value == b"2"
    relay.homes["rover"] = B
    relay.far.moved(ClientName("rover"), now=0.0)
    relay.tell(A, Delete("box"))
    assert relay.registry.named() == ["box"], "it may be about to tell that one"
    relay.far.work(now=60.0)
    assert not len(relay.registry)
    relay.validate()


def test_what_is_refused_is_counted_each_time_and_said_once() -> None:
    relay = Relay()
    relay.registry.put("box", owner=ClientName("site"), kind=ObjectKind.NODE, type_name="", wall_ns=0, now=0.0)
    for number in range(5):
        relay.tell(A, a_put("box", value=b"%d" % number))
    assert [code for _peer, code, _text in relay.refused] == ["not_owner"] and relay.counts == {"not_owner": 5}
    for number in range(2 * MAX_SAID):
        relay.far.refuse(A, ClientName(f"r{number}"), "forbidden", "")
    assert len(relay.refused) == MAX_SAID
    relay.far.lost(A)
    relay.far.refuse(A, ClientName("robot"), "forbidden", "")
    assert len(relay.refused) == MAX_SAID + 1


def test_topics_of_other_relays_are_known_by_their_objects() -> None:
    relay = Relay()
    relay.tell(A, a_put("/tf@robot", topic="/tf"))
    relay.tell(B, a_put("/tf@rover", "rover", topic="/tf"))
    relay.tell(A, a_put("tf:a>b@robot", topic="/tf"))
    assert relay.far.topics == {"/tf": 2} and relay.topics == ["/tf"]
    relay.tell(A, Delete("/tf@robot"))
    assert relay.far.topics == {"/tf": 1} and relay.topics == ["/tf"]
    relay.far.lost(B)
    relay.far.work(now=1.0)
    assert relay.far.topics == {} and relay.topics == ["/tf", "/tf"]
    assert relay.registry.named() == ["tf:a>b@robot"]
    relay.validate()


IDS = st.sampled_from(["box", "wall", "/tf@robot", "/tf@rover", "node:robot", "x@nobody", "", "y" * 600])
OWNERS = st.sampled_from(["robot", "rover", "site", "nobody", "@a", ""])
VALUES = st.sampled_from([None, b"", b"v", bytes(4096), bytes(4097)])
UPTO = st.sampled_from([None, None, 3, 9])
TEXT = st.sampled_from(["", *TEXTS])


@st.composite
def puts(draw: st.DrawFn) -> Put:
    put = a_put(draw(IDS), draw(OWNERS), value=draw(VALUES), text=draw(TEXT), topic=draw(st.sampled_from(["/tf", ""])))
    return put._replace(kind=draw(st.sampled_from(list(ObjectKind))), upto=draw(UPTO))


CHANGES: st.SearchStrategy[Change] = st.one_of(
    puts(),
    st.builds(lambda name, value, upto: Set(name, value, 1, "", 1, None, 0, upto), IDS, VALUES, UPTO),
    st.builds(Delete, IDS, UPTO),
    st.builds(Begin, st.integers(0, 3), st.booleans()),
    st.builds(lambda text: Define(text_hash(text), text), st.sampled_from(TEXTS)),
    st.builds(End, st.integers(0, 9)),
)
STEPS = st.one_of(
    st.tuples(st.sampled_from([A, B]), CHANGES),
    st.tuples(st.sampled_from(["robot", "rover", "site"]), st.sampled_from([None, A, B])),
    st.sampled_from([("lost", A), ("lost", B), ("work", 0.5), ("work", 20.0), ("put", "box"), ("delete", "site")]),
)


@given(st.lists(STEPS, max_size=60))
def test_whatever_relays_tell_and_clients_do_the_tables_agree(steps: list[tuple[object, object]]) -> None:
    relay = Relay()
    for what, detail in steps:
        with suppress(WireError, RefusedError):
            if what == "lost":
                relay.far.lost(ClientName(str(detail)))
            elif what == "work":
                assert isinstance(detail, float)
                relay.now += detail
            elif what == "put":
                relay.registry.put(
                    str(detail), owner=ClientName("site"), kind=ObjectKind.NODE, type_name="", wall_ns=0, now=relay.now
                )
            elif what == "delete":
                relay.registry.delete_owned(ClientName(str(detail)))
            elif what in (A, B):
                relay.tell(ClientName(str(what)), detail)  # type: ignore[arg-type]
            else:
                relay.homes[str(what)] = None if detail is None else ClientName(str(detail))
                relay.far.moved(ClientName(str(what)), now=relay.now)
        relay.far.work(now=relay.now)
        relay.validate()
    relay.far.work(now=relay.now + 60.0)
    for item in relay.registry.select():
        teller = relay.registry.teller(item.id)
        assert teller is None or relay.homes.get(item.owner) in (teller, None)


SMALL = MirrorLimits(max_objects=4, max_bytes=4000, max_texts_bytes=250)


@given(st.lists(CHANGES, max_size=80))
def test_a_mirror_keeps_no_more_than_its_limits(changes: list[Change]) -> None:
    seen: dict[str, XrObject] = {}

    def changed(item: XrObject, before: XrObject | None) -> None:
        assert seen.get(item.id) is before
        seen[item.id] = item

    def deleted(item: XrObject) -> None:
        del seen[item.id]

    mirror = Mirror(SMALL, changed=changed, deleted=deleted)
    for change in changes:
        mirror.apply(change, now=0.0)
        mirror.validate()
        assert mirror.objects == seen


def test_what_is_left_of_an_earlier_batch_is_no_loss_to_who_was_not_there() -> None:
    mirror = Mirror(SMALL, changed=lambda _item, _before: None, deleted=lambda _item: None)
    mirror.apply(Set("box", b"2", 1, "", 2, None, 0), now=0.0)
    assert dict(mirror.counts) == {"full": 0} and not mirror.objects
    mirror.apply(Begin(7, whole=True), now=0.0)
    mirror.apply(Set("box", b"2", 1, "", 2, None, 0), now=0.0)
    assert dict(mirror.counts) == {"full": 1}
