"""The keeper: group commit, acknowledged only what is on disk, a disk that fails and comes back."""

import asyncio
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, TopicName
from sern_runtime import clock
from sern_runtime.durable.keeper import SLOW_S, Keeper
from sern_runtime.durable.store import ROW_BYTES, Change, Described, Put, Row, Store, StoreError
from tests.support import DEADLINE_S, until

STREAM = StreamId(ClientName("robot1"), 7, TopicName("/robot1/log"))
OTHER = StreamId(ClientName("robot2"), 7, TopicName("/robot2/log"))


class Gate(Store):
    """A store that takes nothing while it is `full`, and writes down its batches."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.full = False
        self.batches: list[int] = []

    def apply(self, changes: Sequence[Change]) -> None:
        if self.full:
            raise StoreError("the disk is full")
        super().apply(changes)
        self.batches.append(sum(isinstance(change, Put) for change in changes))


class Stopped(Gate):
    """A store whose first write stands still until `go`."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.begun, self.go = threading.Event(), threading.Event()

    def apply(self, changes: Sequence[Change]) -> None:
        self.begun.set()
        assert self.go.wait(DEADLINE_S)
        super().apply(changes)


class Broken(Store):
    """A store with an error in it."""

    def apply(self, changes: Sequence[Change]) -> None:
        raise ZeroDivisionError


def make(store: Store, got: list[int], *, max_bytes: int = 2**20, shared: bool = False) -> Keeper:
    store.open(new_boot=7)

    def stored(puts: Sequence[Put]) -> None:
        got.extend(change.row.seq for change in puts)

    call_soon = asyncio.get_running_loop().call_soon_threadsafe
    keeper = Keeper(store, call_soon=call_soon, stored=stored, max_bytes=max_bytes, shared=shared)
    for stream in (STREAM, OTHER):
        keeper.change(Described(stream, {}, "", (), 0))
    return keeper


def put(seq: int, size: int = 10) -> Put:
    return Put(STREAM, Row(seq, seq, seq, bytes(size)))


async def test_many_messages_share_a_commit_and_each_is_acknowledged_in_order(tmp_path: Path) -> None:
    got: list[int] = []
    store = Gate(tmp_path)
    keeper = make(store, got)
    for seq in range(1, 501):
        keeper.put(put(seq))
    keeper.start()
    await until(lambda: len(got) == 500, "all are acknowledged")
    keeper.close()
    assert got == list(range(1, 501)) and keeper.messages == 500
    assert store.batches[0] == 500
    assert len(Store(tmp_path).open(new_boot=1).streams[STREAM].rows) == 500


async def test_a_full_disk_is_said_once_and_nothing_is_acknowledged_until_it_takes_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    got: list[int] = []
    store = Gate(tmp_path)
    keeper = make(store, got)
    store.full = True
    keeper.start()
    keeper.put(put(1))
    await until(lambda: keeper.failures > 1, "it was tried again")
    assert keeper.problem == "the disk is full" and not got
    keeper.put(put(2))
    store.full = False
    await until(lambda: got == [1, 2], "both are acknowledged")
    keeper.close()
    assert not keeper.problem
    lines = [record.getMessage() for record in caplog.records]
    assert lines == [
        "durable topics wait for the disk: the disk is full; make room, or mend it: it is tried again",
        "durable topics are kept again",
    ]


async def test_closing_writes_what_waits(tmp_path: Path) -> None:
    keeper = make(Store(tmp_path), [])
    keeper.start()
    for seq in range(1, 4):
        keeper.put(put(seq))
    keeper.trim(STREAM, 1)
    keeper.close()
    assert [row.seq for row in Store(tmp_path).open(new_boot=1).streams[STREAM].rows] == [2, 3]


async def test_closing_with_a_full_disk_says_what_is_not_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    got: list[int] = []
    store = Gate(tmp_path)
    keeper = make(store, got)
    store.full = True
    keeper.start()
    keeper.put(put(1))
    keeper.put(put(2))
    await until(lambda: keeper.problem is not None, "the disk has refused")
    keeper.close()
    assert "2 durable messages could not be kept, and are lost if nobody got them: the disk is full" in caplog.text
    assert not got


async def test_room_is_counted(tmp_path: Path) -> None:
    keeper = make(Store(tmp_path), [], max_bytes=2 * (100 + ROW_BYTES))
    keeper.start()
    assert keeper.has_room(STREAM.origin, 100)
    keeper.put(put(1, 100))
    keeper.put(put(2, 100))
    assert not keeper.has_room(STREAM.origin, 0) and keeper.kept_bytes == 2 * (100 + ROW_BYTES)
    keeper.trim(STREAM, 1)
    assert keeper.has_room(STREAM.origin, 100) and not keeper.has_room(STREAM.origin, 101)
    keeper.close()


async def test_a_stream_that_is_forgotten_frees_its_room(tmp_path: Path) -> None:
    got: list[int] = []
    keeper = make(Store(tmp_path), got, max_bytes=2 * (10 + ROW_BYTES))
    keeper.start()
    keeper.put(put(1))
    keeper.put(put(2))
    assert not keeper.has_room(STREAM.origin, 10)
    keeper.forget(STREAM)
    assert keeper.has_room(STREAM.origin, 10) and keeper.kept_bytes == 0
    keeper.close()
    assert STREAM not in Store(tmp_path).open(new_boot=1).streams


async def test_an_origin_leaves_as_much_free_as_it_has(tmp_path: Path) -> None:
    """One that fills its share, and several, leave room for those that come later."""
    size = 1000 - ROW_BYTES
    keeper = make(Store(tmp_path), [], max_bytes=12_000, shared=True)
    keeper.start()

    def fill(stream: StreamId) -> int:
        count = 0
        while keeper.has_room(stream.origin, size):
            count += 1
            keeper.put(Put(stream, Row(count, 0, 0, bytes(size))))
        return count

    assert (fill(STREAM), fill(OTHER)) == (6, 3)
    assert not keeper.has_room(STREAM.origin, size)
    keeper.forget(STREAM)
    assert keeper.has_room(OTHER.origin, size)
    keeper.close()


def moves(keeper: Keeper, *, now: float) -> bool:
    """What a watchdog takes for progress: two looks, one after the other, that differ."""
    return keeper.progress(now=now) != keeper.progress(now=now)


async def test_a_write_that_does_not_end_is_seen_by_the_watchdog_and_a_disk_that_refuses_is_not(tmp_path: Path) -> None:
    got: list[int] = []
    store = Stopped(tmp_path)
    keeper = make(store, got)
    assert not moves(keeper, now=clock.now()), "it has no thread yet"
    keeper.start()
    await until(store.begun.is_set, "the first batch is on its way to the disk")
    assert moves(keeper, now=clock.now()), "slow is not stuck"
    assert not moves(keeper, now=clock.now() + SLOW_S)
    store.go.set()
    await until(lambda: moves(keeper, now=clock.now() + SLOW_S), "it has nothing to do, for however long")
    store.full = True
    keeper.put(put(1))
    await until(lambda: keeper.failures > 1, "it was tried again")
    assert moves(keeper, now=clock.now())
    store.full = False
    await until(lambda: got == [1], "kept")
    keeper.close()
    assert not moves(keeper, now=clock.now()), "its thread has ended"


async def test_a_thread_that_ended_by_an_error_is_seen_by_the_watchdog(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended: list[object] = []
    monkeypatch.setattr(threading, "excepthook", ended.append)
    store = Broken(tmp_path)
    keeper = make(store, [])
    keeper.start()
    await until(lambda: ended, "the thread has ended")
    await until(lambda: not moves(keeper, now=clock.now()), "which is no progress")
    keeper.close()
