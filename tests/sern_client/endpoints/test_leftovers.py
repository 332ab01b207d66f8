"""What a killed process leaves of a recording: everything that was flushed is read back, wherever the file is cut."""

import asyncio
import os
import signal
import sys
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from sern_client.endpoints import bag_files
from sern_client.endpoints.bag import BagEndpoint, BagOptions
from sern_client.endpoints.bag_files import BagFile, McapFile, RecordFile
from sern_client.endpoints.leftovers import finish, in_use, lock
from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import DropReason, Encoding
from sern_runtime.ros_types import topic_info
from tests.support import until

KINDS = {Encoding.ROS1: ".bag", Encoding.CDR: ".mcap"}
START_NS = 1_700_000_000_000_000_000
ENCODINGS = pytest.mark.parametrize("encoding", list(KINDS))
NAMES = ("/chat", "/map")


def read(path: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([path]) as reader:
        return [(connection.topic, stamp_ns, bytes(body)) for connection, stamp_ns, body in reader.messages()]


def growing(active: Path) -> Path:
    return next(active.glob("*.mcap")) if active.is_dir() else active


async def interrupted(folder: Path, encoding: Encoding, parts: int = 3) -> tuple[Path, list[int]]:
    """A recording as a killed process leaves it, flushed `parts` times with four messages each, and its sizes then."""
    recorder = RecordEndpoint(RecordOptions(folder / "live"))
    await recorder.start(None)  # type: ignore[arg-type]
    publishers = [recorder.advertise(topic_info(name, "std_msgs/msg/String", encoding)) for name in NAMES]
    kept = 0

    def told(upto: int, lost: object) -> None:
        nonlocal kept
        kept = upto

    recorder.watch_kept(told)
    active = folder / f"live{KINDS[encoding]}.active"
    sizes = []
    for part in range(parts):
        for i in range(4):
            publishers[i % 2].publish(bytes([part, i]) * 300, START_NS + 4 * part + i)
        recorder.flush()
        await until(lambda part=part: kept == 4 * (part + 1))  # type: ignore[misc]
        sizes.append(growing(active).stat().st_size)
    left = folder / f"run{KINDS[encoding]}.active"
    if active.is_dir():
        left.mkdir()
        (left / f"{left.name}.mcap").write_bytes(growing(active).read_bytes())
    else:
        left.write_bytes(active.read_bytes())
    await recorder.stop()
    return left, sizes


@ENCODINGS
async def test_everything_that_was_flushed_is_read_back(encoding: Encoding, tmp_path: Path) -> None:
    """Also where the file is cut anywhere behind it: whole chunks are kept, and a file is always readable."""
    left, sizes = await interrupted(tmp_path, encoding)
    raw = growing(left).read_bytes()
    expected = [(NAMES[i % 2], START_NS + 4 * part + i, bytes([part, i]) * 300) for part in range(3) for i in range(4)]
    assert sizes[-1] == len(raw)
    near = {size + by for size in sizes for by in (-1, 0, 1)} - {sizes[-1] + 1}
    for cut in sorted({*near, *range(sizes[0], sizes[-1], 97)}):
        growing(left).write_bytes(raw[:cut])
        done = finish(left)
        assert done.path == tmp_path / f"run{KINDS[encoding]}" and not left.exists()
        safe = 4 * sum(size <= cut for size in sizes)
        got = read(done.path)
        assert got == expected[: len(got)] and safe <= len(got) == done.messages
        with AnyReader([done.path]) as reader:
            assert {c.topic: c.msgtype for c in reader.connections} == dict.fromkeys(NAMES, "std_msgs/msg/String")
        # Put it back for the next cut.
        if encoding is Encoding.CDR:
            left.mkdir()
            done.path.replace(left / f"{left.name}.mcap")
        else:
            done.path.replace(left)


@ENCODINGS
async def test_a_finished_file_is_finished_again_without_change(encoding: Encoding, tmp_path: Path) -> None:
    """Killed between the end of the file and its name."""
    left, _ = await interrupted(tmp_path, encoding)
    done = finish(left)
    whole = done.path.read_bytes()
    if encoding is Encoding.CDR:
        left.mkdir()
        done.path.replace(left / f"{left.name}.mcap")
    else:
        done.path.replace(left)
    again = finish(left)
    assert again == done and again.path.read_bytes() == whole and again.messages == 12


@ENCODINGS
async def test_damage_in_the_middle_and_what_others_wrote_is_kept_as_it_is(encoding: Encoding, tmp_path: Path) -> None:
    """A file is cut only where it ends: more behind the damage would be lost."""
    left, _ = await interrupted(tmp_path, encoding)
    raw = bytearray(growing(left).read_bytes())
    at = raw.index(bytes([1, 0]) * 20)
    raw[at - 60 : at - 10] = b"\xff" * 50
    raw += b"\x05" * 9000
    growing(left).write_bytes(raw)
    done = finish(left)
    assert done.messages is None and done.path.name.endswith(".broken") and "damaged at byte" in done.problem
    assert growing(done.path).read_bytes() == raw
    other = tmp_path / "other.bag.active"
    header = bytes(raw[: 13 + 4096]) if encoding is Encoding.ROS1 else b"#ROSBAG V2.0\n" + b"\0" * 4096
    other.write_bytes(header + b"\x05" * 9000)
    assert finish(other).messages is None and (tmp_path / "other.bag.broken").stat().st_size == 4109 + 9000


@ENCODINGS
@pytest.mark.parametrize("content", [b"", b"precious", b"#ROSBAG V2.0\nno", b"\x89MCAP0\r\n"])
async def test_what_cannot_be_read_is_moved_aside(
    encoding: Encoding, content: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    active = tmp_path / f"run{KINDS[encoding]}.active"
    if encoding is Encoding.CDR:
        active.mkdir()
        (active / f"{active.name}.mcap").write_bytes(content)
    else:
        active.write_bytes(content)
    recorder = RecordEndpoint(RecordOptions(tmp_path / f"run{KINDS[encoding]}"))
    await recorder.start(None)  # type: ignore[arg-type]
    recorder.advertise(topic_info("/chat", "std_msgs/msg/String", encoding)).publish(b"\x01", START_NS)
    await recorder.stop()
    assert read(tmp_path / f"run{KINDS[encoding]}") == [("/chat", START_NS, b"\x01")]
    (aside,) = [path for path in tmp_path.iterdir() if path.name != f"run{KINDS[encoding]}"]
    assert aside.name == f"run{KINDS[encoding]}.broken"
    assert (growing(aside) if aside.is_dir() else aside).read_bytes() == content
    assert "nothing of it can be read" in caplog.text and str(aside) in caplog.text


@ENCODINGS
@pytest.mark.parametrize("overwrite", [False, True])
async def test_a_leftover_is_finished_by_the_next_recording(
    encoding: Encoding, overwrite: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Never deleted, never in the way, whatever `overwrite` says."""
    left, _ = await interrupted(tmp_path, encoding)
    target = tmp_path / f"run{KINDS[encoding]}"
    recorder = RecordEndpoint(RecordOptions(target, overwrite=overwrite))
    await recorder.start(None)  # type: ignore[arg-type]
    recorder.advertise(topic_info("/chat", "std_msgs/msg/String", encoding)).publish(b"\x01", START_NS)
    await recorder.stop()
    assert read(target) == [("/chat", START_NS, b"\x01")]
    assert len(read(tmp_path / f"run.1{KINDS[encoding]}")) == 12 and not left.exists()
    assert "its 12 messages are in" in caplog.text


async def test_leftovers_of_other_days_are_finished_in_a_folder(tmp_path: Path) -> None:
    left, _ = await interrupted(tmp_path, Encoding.ROS1)
    folder = tmp_path / "bags"
    folder.mkdir()
    left.replace(folder / "sern_2026-01-02-03-04-05.bag.active")
    recorder = RecordEndpoint(RecordOptions(folder))
    await recorder.start(None)  # type: ignore[arg-type]
    await recorder.stop()
    assert [path.name for path in folder.iterdir()] == ["sern_2026-01-02-03-04-05.bag"]


async def test_a_living_recording_is_left_alone(tmp_path: Path) -> None:
    first = RecordEndpoint(RecordOptions(tmp_path / "run.bag"))
    await first.start(None)  # type: ignore[arg-type]
    publisher = first.advertise(topic_info("/chat", "std_msgs/msg/String", Encoding.ROS1))
    active = tmp_path / "run.bag.active"
    await until(active.exists)
    await until(lambda: in_use(active))
    with pytest.raises(ConfigError, match="another process is recording there"):
        await RecordEndpoint(RecordOptions(tmp_path / "run.bag")).start(None)  # type: ignore[arg-type]
    publisher.publish(b"\x01", START_NS)
    await first.stop()
    assert len(read(tmp_path / "run.bag")) == 1


async def test_when_the_disk_refuses_the_leftover_waits_under_another_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    await interrupted(tmp_path, Encoding.ROS1)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sern_client.endpoints.record.finish", full)
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run.bag"))
    await recorder.start(None)  # type: ignore[arg-type]
    await recorder.stop()
    aside = tmp_path / "run.1.bag.active"
    assert "No space left on device" in caplog.text and f"sern recover {aside}" in caplog.text
    assert finish(aside).messages == 12 and len(read(tmp_path / "run.1.bag")) == 12


async def test_a_lock_is_seen_by_others(tmp_path: Path) -> None:
    (tmp_path / "x.bag.active").write_bytes(b"")
    assert not in_use(tmp_path / "x.bag.active") and not in_use(tmp_path / "none.bag.active")
    handle = lock(tmp_path / "x.bag.active")
    assert in_use(tmp_path / "x.bag.active")
    os.close(handle)
    assert not in_use(tmp_path / "x.bag.active")


def test_who_only_looks_is_in_nobodys_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording takes its lock a little after it has made its file: in between, another process may look."""
    active = tmp_path / "x.bag.active"
    active.write_bytes(b"")
    taken: list[int] = []
    close = os.close

    def while_it_looks(handle: int) -> None:
        monkeypatch.undo()
        taken.append(lock(active))
        close(handle)

    monkeypatch.setattr(os, "close", while_it_looks)
    assert not in_use(active)
    (handle,) = taken
    assert in_use(active)
    with pytest.raises(BlockingIOError):
        lock(active)
    os.close(handle)
    assert not in_use(active)


def test_who_may_only_read_a_recording_sees_that_it_is_in_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    active = tmp_path / "x.bag.active"
    active.write_bytes(b"")
    handle = lock(active)
    opened: list[int] = []
    really_open = os.open

    def reading(path: Path, flags: int) -> int:
        opened.append(flags & os.O_ACCMODE)
        return really_open(path, flags)

    monkeypatch.setattr(os, "open", reading)
    assert in_use(active) and opened == [os.O_RDONLY]
    os.close(handle)


async def test_kept_is_said_by_time_and_by_size(tmp_path: Path) -> None:
    """A message alone is flushed after `flush_s`; a megabyte at once."""
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run.bag", flush_s=0.05))
    said: list[tuple[int, dict[int, DropReason]]] = []
    recorder.watch_kept(lambda upto, lost: said.append((upto, dict(lost))))
    await recorder.start(None)  # type: ignore[arg-type]
    publisher = recorder.advertise(topic_info("/chat", "std_msgs/msg/String", Encoding.ROS1))
    publisher.publish(b"\x01", START_NS)
    await until(lambda: said == [(1, {})])
    publisher.publish(b"\x01", -1)  # a time that no bag holds
    await until(lambda: said[-1] == (1, {2: DropReason.STORAGE}))
    await recorder.stop()
    assert recorder.taken == 2 and recorder.drops[DropReason.STORAGE] == 1


async def test_a_file_that_is_deleted_while_it_grows_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run.bag", flush_s=60))
    said: list[tuple[int, dict[int, DropReason]]] = []
    recorder.watch_kept(lambda upto, lost: said.append((upto, dict(lost))))
    await recorder.start(None)  # type: ignore[arg-type]
    publisher = recorder.advertise(topic_info("/chat", "std_msgs/msg/String", Encoding.ROS1))
    publisher.publish(b"\x01", START_NS)
    recorder.flush()
    await until(lambda: said == [(1, {})])
    (tmp_path / "run.bag.active").unlink()
    publisher.publish(b"\x01", START_NS)
    recorder.flush()
    await until(lambda: len(said) == 2)
    assert said[1] == (2, {2: DropReason.STORAGE})
    publisher.publish(b"\x01", START_NS)
    await recorder.stop()
    assert recorder.counters.dropped == 3 and recorder.counters.written == 0 and recorder.counters.errors == 1
    assert "it was deleted while it was being written" in caplog.text


async def test_a_folder_that_cannot_be_written_is_refused_at_start() -> None:
    """Not even the administrator may make a file there."""
    with pytest.raises(ConfigError, match="nothing can be written in") as caught:
        await RecordEndpoint(RecordOptions(Path("/proc/self/run.bag"))).start(None)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value) and "choose another path" in str(caught.value)


KILLED = """
import asyncio, sys
from pathlib import Path
from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_runtime.ros_types import topic_info
from sern_core.vocabulary.types import Encoding

async def main():
    recorder = RecordEndpoint(RecordOptions(Path(sys.argv[1]), flush_s=0.02))
    recorder.watch_kept(lambda upto, lost: print(upto, flush=True))
    await recorder.start(None)
    publisher = recorder.advertise(topic_info("/blob", "std_msgs/msg/String", Encoding(sys.argv[2])))
    number = 0
    while True:
        for _ in range(20):
            publisher.publish(bytes(500), number)
            number += 1
        await asyncio.sleep(0.001)

asyncio.run(main())
"""


@ENCODINGS
async def test_a_killed_process_leaves_all_it_said_to_be_kept(encoding: Encoding, tmp_path: Path) -> None:
    path = tmp_path / f"run{KINDS[encoding]}"
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", KILLED, str(path), str(encoding), stdout=asyncio.subprocess.PIPE
    )
    assert process.stdout is not None
    said = 0
    async with asyncio.timeout(60):
        while said < 1000:
            said = int(await process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        said = max([said, *(int(line) for line in (await process.stdout.read()).splitlines(keepends=False))])
        await process.wait()
    done = finish(path.with_name(path.name + ".active"))
    assert done.messages is not None and done.messages >= said
    assert [row[1] for row in read(done.path)] == list(range(done.messages))


@ENCODINGS
async def test_an_unfinished_recording_says_what_it_is_when_played(encoding: Encoding, tmp_path: Path) -> None:
    left, _ = await interrupted(tmp_path, encoding)
    with pytest.raises(ConfigError, match="sern recover") as caught:
        await BagEndpoint(BagOptions(left, rate=0)).start(None)  # type: ignore[arg-type]
    assert "was not finished" in str(caught.value) and "\n" not in str(caught.value)


@ENCODINGS
async def test_who_looks_for_leftovers_never_sees_a_recording_that_begins(
    encoding: Encoding, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process looks at the worst moment: the file is there and its lock is not."""
    path = tmp_path / f"run{KINDS[encoding]}"
    looked: list[list[Path]] = []

    def late(growing: Path) -> int:
        free = [active for active in tmp_path.glob("*.active") if not in_use(active)]
        looked.append([finish(active).path for active in free])
        return lock(growing)

    monkeypatch.setattr(bag_files, "lock", late)
    recorder = RecordEndpoint(RecordOptions(path))
    await recorder.start(None)  # type: ignore[arg-type]
    recorder.advertise(topic_info("/chat", "std_msgs/msg/String", encoding)).publish(b"\x01", START_NS)
    await until(lambda: bool(looked))
    active = path.with_name(f"{path.name}.active")
    await until(lambda: list(tmp_path.iterdir()) == [active])  # where it was made is removed a moment later
    assert in_use(active)
    await recorder.stop()
    assert looked == [[]] and recorder.problem is None
    assert read(path) == [("/chat", START_NS, b"\x01")] and list(tmp_path.iterdir()) == [path]


@ENCODINGS
async def test_a_recording_does_not_take_the_place_of_one_that_began_before_it(
    encoding: Encoding, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two that begin at once: one has the name, the other says that it cannot be written and leaves nothing."""
    path = tmp_path / f"run{KINDS[encoding]}"
    kind = McapFile if encoding is Encoding.CDR else BagFile
    other: list[RecordFile] = []

    def slow(growing: Path) -> int:
        monkeypatch.setattr(bag_files, "lock", lock)
        other.append(kind(path))
        return lock(growing)

    monkeypatch.setattr(bag_files, "lock", slow)
    with pytest.raises(OSError, match="exists"):
        kind(path)
    (first,) = other
    assert [found.name for found in tmp_path.iterdir()] == [first.active.name] and in_use(first.active)
    first.finish()
    assert list(tmp_path.iterdir()) == [path]
