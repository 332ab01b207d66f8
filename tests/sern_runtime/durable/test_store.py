"""The store of durable topics: what was applied is there, whatever happens to process, power and disk."""

import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import apsw
import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, TopicName
from sern_runtime.durable.names import DURABLE_FILE
from sern_runtime.durable.store import Change, Described, Forget, Place, Put, Row, Store, StoreError, Trim
from tests.sern_runtime.durable.cutting import Op, Recorder, left

BOOT = 77
STREAM = StreamId(ClientName("robot1"), BOOT, TopicName("/robot1/log"))
OTHER = StreamId(ClientName("robot1"), BOOT, TopicName("/robot1/events"))
SITE = ClientName("site")


def described(stream: StreamId = STREAM, last: int = 0) -> Described:
    return Described(stream, {"topic": stream.topic}, "string data", ("site",), last)


def body(seq: int, size: int = 200) -> bytes:
    return random.Random(seq).randbytes(size)


def puts(first: int, last: int, stream: StreamId = STREAM, *, size: int = 200) -> list[Change]:
    return [Put(stream, Row(seq, 10**18 + seq, seq, body(seq, size))) for seq in range(first, last + 1)]


def opened(directory: Path, vfs: str | None = None) -> Store:
    store = Store(directory, vfs=vfs)
    store.open(new_boot=BOOT)
    return store


def test_what_was_applied_is_there_when_it_is_opened_again(tmp_path: Path) -> None:
    store = opened(tmp_path)
    store.apply([described(), *puts(1, 30), described(OTHER), Place(STREAM, SITE, 7)])
    store.apply([Trim(STREAM, 10), Put(OTHER, Row(1, 5, 6, b"", codec=2, marker=3))])
    store.close()
    contents = Store(tmp_path).open(new_boot=1)
    kept = contents.streams[STREAM]
    assert contents.boot == BOOT and not contents.damage
    assert [row.seq for row in kept.rows] == list(range(11, 31))
    assert all(row.body == body(row.seq) and row.stamp_ns == row.seq for row in kept.rows)
    assert (kept.last, kept.places, kept.required, kept.definition) == (30, {SITE: 7}, ("site",), "string data")
    assert contents.streams[OTHER].rows == [Row(1, 5, 6, b"", codec=2, marker=3)]


def test_the_last_number_outlives_its_messages(tmp_path: Path) -> None:
    store = opened(tmp_path)
    store.apply([described(), *puts(1, 5)])
    store.apply([*puts(6, 8), Trim(STREAM, 8)])  # delivered before it was written
    store.close()
    kept = Store(tmp_path).open(new_boot=1).streams[STREAM]
    assert (kept.rows, kept.last) == ([], 8)


def test_a_stream_that_is_forgotten_leaves_nothing(tmp_path: Path) -> None:
    store = opened(tmp_path)
    store.apply([described(), *puts(1, 5), Place(STREAM, SITE, 2)])
    store.apply([*puts(6, 7), Forget(STREAM), described(OTHER), *puts(1, 2, OTHER)])
    store.close()
    contents = Store(tmp_path).open(new_boot=1)
    assert list(contents.streams) == [OTHER] and [row.seq for row in contents.streams[OTHER].rows] == [1, 2]


def test_room_is_used_again(tmp_path: Path) -> None:
    """Messages that come and go for ever take no more of the disk than those that are there at a time."""
    store = opened(tmp_path)
    store.apply([described()])
    sizes = []
    for start in range(1, 3001, 50):
        store.apply([*puts(start, start + 49, size=2000), Trim(STREAM, start - 1)])
        sizes.append((tmp_path / DURABLE_FILE).stat().st_size)
    store.close()
    assert sizes[-1] <= 1.1 * sizes[5]


# --- power cuts ---------------------------------------------------------------------------------------------------


@pytest.fixture
def recorder() -> Iterator[Recorder]:
    vfs = Recorder("recorder")
    yield vfs
    vfs.unregister()


def test_no_power_cut_takes_what_was_acknowledged(tmp_path: Path, recorder: Recorder) -> None:
    """The power is cut after every single thing that was asked of the disk; each time the disk has kept another part of
    what was not synced."""
    directory = tmp_path / "written"
    store = opened(directory, vfs="recorder")
    history: list[tuple[int, int, int]] = [(len(recorder.ops), 0, 0)]  # ops so far, stored up to, trimmed up to
    rng = random.Random(4)
    last = trimmed = 0
    for _ in range(12):
        more = rng.choice((1, 3, 40))
        done = rng.randint(trimmed, last)
        store.apply(
            [described(last=last), *puts(last + 1, last + more, size=rng.choice((10, 3000))), Trim(STREAM, done)]
        )
        last, trimmed = last + more, done
        history.append((len(recorder.ops), last, trimmed))
    store.close()
    cuts = 0
    for cut in range(history[0][0], len(recorder.ops) + 1):
        stored, gone = next((last, trimmed) for ops, last, trimmed in reversed(history) if ops <= cut)
        for survives in (0.0, 0.5, 1.0):
            where = tmp_path / f"cut{cut}-{survives}"
            where.mkdir()
            for name, content in left(recorder.ops[:cut], random.Random(cut), survives=survives).items():
                (where / name).write_bytes(content)
            store = Store(where)
            contents = store.open(new_boot=1)
            store.close()
            assert not contents.damage and contents.boot == BOOT, (cut, survives, contents.damage)
            rows = contents.streams[STREAM].rows if stored else []
            seqs = [row.seq for row in rows]
            assert set(range(max(gone, seqs[0] - 1 if seqs else gone) + 1, stored + 1)) <= set(seqs), (cut, survives)
            assert seqs == list(range(seqs[0], seqs[-1] + 1)) if seqs else stored == gone or not stored
            cuts += 1
    assert cuts > 300


# --- damage -------------------------------------------------------------------------------------------------------


def test_a_flipped_bit_anywhere_costs_little_and_is_said(tmp_path: Path) -> None:
    """Wherever a bit flips, every message that is still there is as it was; if any is missing, that is said, and the
    damaged file is put aside."""
    store = opened(tmp_path / "whole")
    store.apply([described(), *puts(1, 60), described(OTHER), *puts(1, 60, OTHER, size=3000)])
    store.close()
    whole = (tmp_path / "whole" / DURABLE_FILE).read_bytes()
    rng = random.Random(1)
    seen = lost = 0
    for number in range(150):
        where = tmp_path / str(number)
        where.mkdir()
        data = bytearray(whole)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        (where / DURABLE_FILE).write_bytes(data)
        store = Store(where)
        contents = store.open(new_boot=5)
        store.close()
        left_rows = 0
        for stream, size in ((STREAM, 200), (OTHER, 3000)):
            rows = contents.streams[stream].rows if stream in contents.streams else []
            assert all(row.body == body(row.seq, size) and row.stamp_ns == row.seq for row in rows), number
            left_rows += len(rows)
        aside = list(where.glob("*.damaged-1"))
        assert bool(contents.damage) == bool(aside)
        if left_rows < 120:
            assert contents.damage, number
            lost += 120 - left_rows
        seen += bool(contents.damage)
        again = Store(where)
        assert not again.open(new_boot=6).damage
        again.close()
    assert seen > 50 and lost < 150 * 40


@pytest.mark.parametrize("content", [b"", b"no database at all", b"SQLite format 3\0" + bytes(4000)])
def test_a_file_that_is_no_store_is_put_aside(tmp_path: Path, content: bytes) -> None:
    (tmp_path / DURABLE_FILE).write_bytes(content)
    store = Store(tmp_path)
    contents = store.open(new_boot=9)
    store.apply([described(), *puts(1, 1)])
    store.close()
    assert contents.boot == 9 and not contents.streams
    assert bool(contents.damage) == bool(content)


# --- the disk -----------------------------------------------------------------------------------------------------


def test_a_disk_that_takes_nothing_more_keeps_what_it_has(tmp_path: Path) -> None:
    """Each write in turn fails, as on a full disk: nothing of that batch is there, all before it is, and it goes on."""
    failing: list[bool] = [False]
    countdown = [0]

    def before(op: Op) -> None:
        if failing[0] and op.what == "write":
            countdown[0] -= 1
            if countdown[0] < 0:
                raise apsw.FullError("database or disk is full")

    vfs = Recorder("failing", before=before)
    try:
        said: list[str] = []
        for after in range(12):
            directory = tmp_path / str(after)
            store = opened(directory, vfs="failing")
            store.apply([described(), *puts(1, 20)])
            failing[0], countdown[0] = True, after
            try:
                store.apply(puts(21, 40, size=3000))
            except StoreError as error:
                said.append(str(error))
                failing[0] = False
                store.apply(puts(21, 40, size=3000))
            failing[0] = False
            store.close()
            kept = Store(directory).open(new_boot=1).streams[STREAM]
            assert [row.seq for row in kept.rows] == list(range(1, 41))
        assert len(said) > 5 and all("full" in line for line in said)
    finally:
        vfs.unregister()


def test_a_second_process_is_refused_in_one_line(tmp_path: Path) -> None:
    store = opened(tmp_path)
    code = (
        "import sys; from pathlib import Path; from sern_runtime.durable.store import Store\n"
        "from sern_core.vocabulary.errors import ConfigError\n"
        "try: Store(Path(sys.argv[1])).open(new_boot=1)\n"
        "except ConfigError as error: print(error)"
    )
    said = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    store.close()
    assert (
        said.stdout == f"{tmp_path / DURABLE_FILE}: another process has it; give each client a directory of its own\n"
    )


def test_a_directory_that_cannot_be_made_is_an_error_to_act_on(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"file/kept: cannot be made: Not a directory; it is for durable topics"):
        Store(tmp_path / "file" / "kept").open(new_boot=1)


def test_a_store_of_a_later_version_is_left_alone(tmp_path: Path) -> None:
    opened(tmp_path).close()
    db = apsw.Connection(str(tmp_path / DURABLE_FILE))
    db.execute("update meta set value = 2 where name = 'version'")
    db.close()
    with pytest.raises(ConfigError, match="is of version 2; this SERN reads version 1"):
        Store(tmp_path).open(new_boot=1)
    assert not list(tmp_path.glob("*damaged*"))
