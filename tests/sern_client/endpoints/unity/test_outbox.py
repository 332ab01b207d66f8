"""What waits for a scene, without one: an outbox against a model of it."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from sern_client.endpoints.common.handover import ITEM_BYTES
from sern_client.endpoints.unity.outbox import ALL, NEWEST, SOME, Outbox
from sern_core.vocabulary.types import DropReason


def outbox(max_bytes: int = 10_000) -> tuple[Outbox, Counter[DropReason]]:
    drops: Counter[DropReason] = Counter()
    return Outbox(max_bytes, drops), drops


def drained(box: Outbox) -> list[bytes]:
    found = []
    while (pieces := box.pop()) is not None:
        found.append(b"".join(pieces))
    return found


def test_texts_and_services_leave_first_and_streams_take_turns() -> None:
    box, drops = outbox()
    for number in range(3):
        box.put("a", (b"a", b"%d" % number), ALL)
    box.put("b", (b"b",), NEWEST)
    assert box.service((b"request",))
    box.answer_list(b"old list")
    box.answer_list(b"list")
    box.say(b"text")
    assert drained(box) == [b"text", b"list", b"request", b"a0", b"b", b"a1", b"a2"]
    assert box.nbytes == 0 and not drops


def test_the_newest_takes_the_place_of_the_others() -> None:
    box, drops = outbox()
    for number in range(5):
        box.put("pose", (b"%d" % number,), NEWEST)
        box.put("tf", (b"t%d" % number,), SOME)
    assert drained(box) == [b"4", b"t0", b"t1", b"t2", b"t3", b"t4"]
    assert drops == {DropReason.SUPERSEDED: 4}


def test_beyond_the_bound_the_oldest_of_the_largest_goes() -> None:
    box, drops = outbox(1000)
    box.put("pose", (b"pose",), NEWEST)
    for number in range(20):
        box.put("map", (b"%d" % number * 10,), ALL)
    left = drained(box)
    assert left[0] == b"pose" and left[-1] == b"19" * 10
    assert drops[DropReason.QUEUE_FULL] == 20 - (len(left) - 1)


def test_one_message_always_may_wait_and_what_is_too_much_for_services_is_said() -> None:
    box, drops = outbox(1000)
    assert box.service((bytes(5000),))
    assert not box.service((b"more",))
    box.put("map", (bytes(10),), ALL)
    assert drops == {DropReason.QUEUE_FULL: 1}
    assert drained(box) == [bytes(5000)]
    box.put("map", (bytes(5000),), ALL)
    assert drained(box) == [bytes(5000)]


def test_what_is_forgotten_is_counted() -> None:
    box, drops = outbox()
    for number in range(3):
        box.put("a", (b"%d" % number,), ALL)
    box.put("b", (b"b",), ALL)
    box.forget("a", DropReason.UNWANTED)
    box.forget("a", DropReason.UNWANTED)
    assert drained(box) == [b"b"]
    box.service((b"request",))
    box.put("b", (b"b",), ALL)
    box.say(b"text")
    box.clear(DropReason.DISCONNECTED)
    assert drained(box) == [] and box.nbytes == 0
    assert drops == {DropReason.UNWANTED: 3, DropReason.DISCONNECTED: 2}


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("put"), st.sampled_from("abc"), st.integers(0, 600), st.sampled_from([NEWEST, SOME, ALL])),
        st.tuples(st.just("service"), st.just(""), st.integers(0, 600), st.just(ALL)),
        st.tuples(st.just("forget"), st.sampled_from("abc"), st.just(0), st.just(ALL)),
        st.tuples(st.just("pop"), st.just(""), st.just(0), st.just(ALL)),
    ),
    max_size=60,
)


@given(STEPS)
def test_every_message_leaves_or_is_counted_and_the_bound_holds(steps: list[tuple[str, str, int, object]]) -> None:
    box, drops = outbox(2000)
    given_in = left = refused = 0
    for what, stream, nbytes, keep in steps:
        if what == "put":
            box.put(stream, (bytes(nbytes),), keep)  # type: ignore[arg-type]
            given_in += 1
        elif what == "service":
            given_in += 1
            refused += not box.service((bytes(nbytes),))
        elif what == "forget":
            box.forget(stream, DropReason.UNWANTED)
        elif box.pop() is not None:
            left += 1
        assert given_in == left + refused + len(box) + drops.total()
        assert box.nbytes <= 2000 + ITEM_BYTES or len(box) == 1
    left += len(drained(box))
    assert given_in == left + refused + drops.total()
    assert box.nbytes == 0
