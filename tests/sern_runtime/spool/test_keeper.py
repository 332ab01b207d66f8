"""The thread that keeps messages: a slow or full disk costs what should have been kept, is said once, and passes."""

import asyncio
import errno
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from sern_runtime.spool import keeper as module
from sern_runtime.spool.files import Kept
from sern_runtime.spool.keeper import SpoolKeeper
from sern_runtime.spool.store import Answer, Store
from tests.sern_runtime.spool.kept import message, stream
from tests.support import until

TOPIC = stream().id.topic


class Disk(Store):
    """A store whose disk can be made slow or full."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory, "spool", max_bytes=2**24)
        self.full = False
        self.gate = threading.Event()
        self.gate.set()

    def add(self, kept: Kept) -> list[Kept]:
        self.gate.wait()
        if self.full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().add(kept)


def started(directory: Path, on_kept: Callable[[Sequence[Kept], bool], None] | None = None) -> tuple[SpoolKeeper, Disk]:
    disk = Disk(directory)
    keeper = SpoolKeeper(disk, call_soon=asyncio.get_running_loop().call_soon_threadsafe, on_kept=on_kept)
    keeper.start()
    return keeper, disk


async def test_what_is_put_is_safe_soon_and_can_be_read(tmp_path: Path) -> None:
    told: list[tuple[int, bool]] = []
    keeper, _disk = started(tmp_path, lambda kept, safe: told.extend((each.seq, safe) for each in kept))
    for seq in range(1, 11):
        assert keeper.put(message(seq))
    await until(lambda: told == [(seq, True) for seq in range(1, 11)], "all is safe")
    assert keeper.written == 10 and keeper.topics[TOPIC][0].last == 10
    answers: list[Answer] = []
    assert keeper.read(TOPIC, 5, ((2, 3),), (0, 2**62), 10**6, answers.append)
    await until(lambda: answers, "it is read")
    assert [kept.seq for kept in answers[0].messages] == [2, 3]
    keeper.close()
    assert not keeper.put(message(11)) and keeper.failed == 1


async def test_a_slow_disk_holds_up_nobody_and_what_there_is_no_room_for_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "BUFFER_BYTES", 10_000)
    keeper, disk = started(tmp_path)
    disk.gate.clear()
    taken = sum(keeper.put(message(seq, 744)) for seq in range(1, 101))
    assert taken in (10, 11), "one may be in the hands of the thread"
    assert keeper.overflowed == 100 - taken
    assert caplog.text.count("the disk is slower than the messages") == 1
    disk.gate.set()
    await until(lambda: keeper.written == taken, "what was taken is safe")
    keeper.close()


async def test_a_full_disk_is_said_once_and_what_comes_when_there_is_room_again_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "RETRY_S", 0.01)
    monkeypatch.setattr(module, "FLUSH_S", 0.01)
    told: list[tuple[int, bool]] = []
    keeper, disk = started(tmp_path, lambda kept, safe: told.extend((each.seq, safe) for each in kept))
    disk.full = True
    for seq in range(1, 6):
        keeper.put(message(seq))
    await until(lambda: keeper.problem is not None and len(told) == 5, "it is said")
    assert keeper.failed == 5 and caplog.text.count("nothing is kept there now") == 1
    assert "make room, or mend it" in caplog.text
    disk.full = False
    numbers = iter(range(6, 100_000))

    def kept_again() -> bool:
        keeper.put(message(next(numbers)))
        return keeper.problem is None

    await until(kept_again, "it is kept again")
    keeper.close()
    await until(lambda: len(told) == keeper.written + keeper.failed, "each has a fate")
    assert [seq for seq, _safe in told] == list(range(1, len(told) + 1))


async def test_a_disk_that_is_full_at_the_start_costs_the_spool_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(_self: Store) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Store, "open", full)
    keeper, _disk = started(tmp_path)
    assert keeper.problem == f"{tmp_path}: No space left on device"
    assert "make room and start it again" in caplog.text
    assert not keeper.put(message(1)) and keeper.failed == 1
    assert not keeper.read(TOPIC, 5, ((1, 1),), (0, 1), 1, lambda _answer: None)
    keeper.close()


async def test_another_program_fills_the_disk_and_ours_goes_on_with_less(tmp_path: Path) -> None:
    """The oldest file makes room for what is new."""
    keeper, disk = started(tmp_path)
    store: Store = disk
    store.__dict__["_file_bytes"] = 2000
    for seq in range(1, 41):
        keeper.put(message(seq, 500))
    keeper.flush()
    await until(lambda: keeper.written == 40, "some files are there")
    real, refusals = Store.add, iter([True, True])

    def once(self: Store, kept: Kept) -> list[Kept]:
        if next(refusals, False):
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(self, kept)

    disk.add = once.__get__(disk)  # type: ignore[method-assign]
    keeper.put(message(41, 500))
    keeper.flush()
    await until(lambda: keeper.written == 41, "the new one is kept")
    assert keeper.problem is None and disk.deleted_files == 2
    assert keeper.topics[TOPIC][0].first > 1
    keeper.close()
