"""A folder of kept messages: what goes first, what is found again, and what is in the way."""

import errno
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.spool.store import FILES, FullError, Store
from tests.sern_runtime.spool.kept import START_NS, message, stream

MAX_BYTES = 2**20
TOPIC = stream().id.topic
EVER = (-(2**63), 2**63 - 1)


def opened(directory: Path, *, max_bytes: int = MAX_BYTES, keeps_all: bool = False) -> Store:
    store = Store(directory, "spool", max_bytes=max_bytes, keeps_all=keeps_all)
    store.open()
    return store


def fill(store: Store, first: int, last: int, size_bytes: int = 1000) -> None:
    for seq in range(first, last + 1):
        store.add(message(seq, size_bytes))
    store.flush()


def seqs(store: Store, *runs: tuple[int, int], boot: int = 5) -> list[int]:
    """All of it, in as many answers as it takes."""
    found: list[int] = []
    rest: tuple[tuple[int, int], ...] = runs
    while rest:
        answer = store.read(TOPIC, boot, rest, *EVER, max_bytes=10_000)
        found += [kept.seq for kept in answer.messages]
        assert answer.rest != rest
        rest = answer.rest
    return found


def test_of_too_much_the_oldest_file_goes_first_and_is_counted(tmp_path: Path) -> None:
    store = opened(tmp_path)
    fill(store, 1, 3000)
    (span,) = store.topics()[TOPIC]
    assert span.last == 3000 and span.first > 1900
    assert store.kept_bytes <= MAX_BYTES
    assert sum(path.stat().st_size for path in tmp_path.glob("*.mcap")) == store.kept_bytes
    assert store.deleted_messages == span.first - 1 and store.deleted_files > FILES
    assert seqs(store, (1, 3000)) == list(range(span.first, 3001))
    store.close()


def test_what_an_earlier_process_left_is_there_and_goes_on(tmp_path: Path) -> None:
    store = opened(tmp_path)
    fill(store, 1, 100)
    assert store.close() == []
    fill(again := opened(tmp_path), 101, 120)
    assert seqs(again, (50, 110)) == list(range(50, 111))
    assert [span.last for span in again.topics()[TOPIC]] == [120]
    again.close()


def test_what_was_not_flushed_is_lost_and_nothing_else_when_the_process_is_killed(tmp_path: Path) -> None:
    store = opened(tmp_path)
    fill(store, 1, 50)
    newest = max(tmp_path.glob("*.mcap"))
    left = newest.read_bytes() + b"\x05torn"
    store.close()
    newest.write_bytes(left)
    again = opened(tmp_path)
    assert seqs(again, (1, 100)) == list(range(1, 51))
    assert again.damaged_files == 0
    again.close()


def test_files_that_cannot_be_read_are_left_and_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "spool-00000007.mcap").write_bytes(b"nothing of ours")
    (tmp_path / "spool-x.mcap").write_bytes(b"nor this")
    (tmp_path / "holiday.jpg").write_bytes(b"nor this")
    store = opened(tmp_path)
    assert store.damaged_files == 1 and "nothing of it can be read" in caplog.text
    fill(store, 1, 3)
    assert (tmp_path / "spool-00000008.mcap").exists() and (tmp_path / "spool-00000007.mcap").exists()
    store.close()


def test_a_file_that_is_damaged_later_costs_what_is_in_it(tmp_path: Path) -> None:
    store = opened(tmp_path)
    fill(store, 1, 300)
    first = min(tmp_path.glob("*.mcap"))
    whole = first.read_bytes()
    first.write_bytes(whole[:20_000] + bytes([255] * 3000) + whole[23_000:])
    found = seqs(store, (1, 300))
    assert store.damaged_files == 1
    assert found[-1] == 300 and len(found) > 200 and found == sorted(set(found))
    store.close()


def test_a_message_that_is_not_as_it_was_written_costs_only_itself(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = opened(tmp_path)
    fill(store, 1, 20)
    path = next(tmp_path.glob("*.mcap"))
    damaged = bytearray(path.read_bytes())
    for seq in (7, 9):
        damaged[damaged.index(seq.to_bytes(8, "big") + bytes(900)) + 500] ^= 1
    path.write_bytes(damaged)
    assert seqs(store, (1, 20)) == [seq for seq in range(1, 21) if seq not in (7, 9)]
    assert (store.damaged_messages, store.damaged_files, store.damaged) == (2, 0, 2)
    assert caplog.text.count("is damaged") == 1 and "message 7 is damaged" in caplog.text
    store.close()


def test_a_file_that_somebody_deletes_costs_what_is_in_it(tmp_path: Path) -> None:
    store = opened(tmp_path)
    fill(store, 1, 300)
    min(tmp_path.glob("*.mcap")).unlink()
    found = seqs(store, (1, 300))
    assert found == list(range(found[0], 301)) and 1 < found[0] < 100
    store.close()


def test_of_the_messages_only_those_of_the_stamps(tmp_path: Path) -> None:
    store = opened(tmp_path)
    fill(store, 1, 100)
    answer = store.read(TOPIC, 5, ((1, 100),), START_NS + 10 * 10**9, START_NS + 12 * 10**9, max_bytes=10**6)
    assert [kept.seq for kept in answer.messages] == [10, 11, 12] and not answer.rest
    assert store.read(TOPIC, 6, ((1, 100),), *EVER, max_bytes=10**6).messages == ()
    store.close()


def test_a_site_keeps_all_and_takes_no_more_when_it_is_full(tmp_path: Path) -> None:
    store = opened(tmp_path, keeps_all=True)
    with pytest.raises(FullError):
        fill(store, 1, 3000)
    assert store.deleted_files == 0 and seqs(store, (1, 10)) == list(range(1, 11))
    store.close()


def test_two_processes_never_keep_in_one_place(tmp_path: Path) -> None:
    store = opened(tmp_path)
    with pytest.raises(ConfigError, match="another process keeps messages there; give each client its own"):
        opened(tmp_path)
    store.close()
    opened(tmp_path).close()


def test_a_place_that_cannot_be_used_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"cannot be written .*name another directory"):
        opened(tmp_path / "file" / "below")


def test_a_full_disk_is_no_mistake_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_args: object, **_more: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "mkdir", full)
    with pytest.raises(OSError, match="No space left"):
        opened(tmp_path / "new")
