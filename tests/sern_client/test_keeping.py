"""Which messages wait for which recordings: every order in which they may be kept or lost."""

from collections.abc import Mapping

from hypothesis import given
from hypothesis import strategies as st

from sern_client.endpoints.base import KeptUpTo
from sern_client.keeping import Keeping
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, DropReason, TopicName

STREAM = StreamId(ClientName("robot"), 1, TopicName("/robot/chat"))


class FakeKeeper:
    def __init__(self) -> None:
        self.taken = 0
        self.told: KeptUpTo = lambda upto, lost: None
        self.flushes = self.asked = 0

    def watch_kept(self, told: KeptUpTo) -> None:
        self.told = told

    def flush(self) -> None:
        self.flushes += 1

    def keep_soon(self) -> None:
        self.asked += 1


class Bench:
    def __init__(self, keepers: int) -> None:
        self.keepers = [FakeKeeper() for _ in range(keepers)]
        self.held: list[int] = []
        self.released: dict[int, DropReason | None] = {}
        self.delays: list[float] = []
        self.keeping = Keeping(self.keepers, self._hold, self._release, self.delays.append)

    def _hold(self, stream: StreamId, seq: int) -> None:
        self.held.append(seq)

    def _release(self, stream: StreamId, seq: int, lost: DropReason | None) -> None:
        assert stream == STREAM and seq in self.held and seq not in self.released
        self.released[seq] = lost

    def publish(self, seq: int, *took: int) -> None:
        mark = self.keeping.mark()
        for keeper in took:
            self.keepers[keeper].taken += 1
        self.keeping.published(STREAM, seq, mark)


def test_without_keepers_nothing_waits() -> None:
    bench = Bench(0)
    assert not bench.keeping and bench.keeping.pending == 0


def test_only_what_was_taken_waits_and_all_keepers_that_took_it_must_have_kept_it() -> None:
    bench = Bench(2)
    bench.keepers[0].taken += 3  # best effort, before
    bench.publish(1, 0, 1)
    bench.publish(2)  # conversion failed: nobody took it
    bench.publish(3, 1)
    assert bench.held == [1, 3] and bench.keeping.pending == 2
    bench.keepers[1].told(1, {})
    assert bench.released == {}
    bench.keepers[0].told(4, {})
    assert bench.released == {1: None}
    bench.keepers[1].told(2, {2: DropReason.STORAGE})
    assert bench.released == {1: None, 3: DropReason.STORAGE} and bench.keeping.pending == 0
    bench.keeping.flush()
    assert [keeper.flushes for keeper in bench.keepers] == [1, 1]


def test_many_are_kept_together() -> None:
    bench = Bench(1)
    for seq in range(1, 4):
        bench.publish(seq, 0)
    assert len(bench.delays) == 1
    bench.keeping.keep_soon()
    assert bench.keepers[0].asked == 1
    bench.publish(4, 0)
    assert len(bench.delays) == 2
    bench.keepers[0].told(4, {})
    bench.keeping.keep_soon()  # nothing waits any more
    assert bench.keepers[0].asked == 1


def test_a_message_that_did_not_get_into_the_buffer_is_lost_before_those_ahead_of_it_are_kept() -> None:
    bench = Bench(1)
    bench.publish(1, 0)
    bench.publish(2, 0)
    bench.keepers[0].told(0, {2: DropReason.QUEUE_FULL})
    assert bench.released == {2: DropReason.QUEUE_FULL}
    bench.keepers[0].told(2, {})
    assert bench.released == {2: DropReason.QUEUE_FULL, 1: None}


@given(
    took=st.lists(st.sets(st.integers(0, 1)), max_size=20),
    steps=st.lists(st.tuples(st.integers(0, 1), st.integers(0, 25), st.sets(st.integers(1, 25))), max_size=10),
)
def test_each_message_is_let_go_once_however_it_is_kept(
    took: list[set[int]], steps: list[tuple[int, int, set[int]]]
) -> None:
    bench = Bench(2)
    for seq, who in enumerate(took, start=1):
        bench.publish(seq, *who)
    reached = [0, 0]
    for keeper, upto, lost in steps:
        reached[keeper] = min(max(upto, reached[keeper]), bench.keepers[keeper].taken)
        why: Mapping[int, DropReason] = dict.fromkeys(lost, DropReason.STORAGE)
        bench.keepers[keeper].told(reached[keeper], why)
    for last in bench.keepers:
        last.told(last.taken, {})
    assert sorted(bench.released) == bench.held and bench.keeping.pending == 0
