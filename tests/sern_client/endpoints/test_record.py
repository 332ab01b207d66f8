"""Recording: what is read back is what was given, byte for byte, and a bad disk does not stop the daemon."""

import asyncio
import errno
import resource
import shutil
import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag1, ConnectionExtRosbag2, QosDurability
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from sern_client.endpoints import bag_files
from sern_client.endpoints.bag import BagEndpoint, BagOptions
from sern_client.endpoints.bag_files import BagFile, McapFile, RecordFile, active_path
from sern_client.endpoints.leftovers import finish
from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_client.sections import make_section
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.config import endpoints as sections
from sern_runtime.ros_types import topic_info

Make = Callable[..., Path]
Until = Callable[[Callable[[], bool]], Awaitable[None]]
START_NS = 1_700_000_000_000_000_000


def read(path: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([path]) as reader:
        return [(connection.topic, stamp_ns, bytes(body)) for connection, stamp_ns, body in reader.messages()]


async def copy(source: Path, target: Path, events: Any, until: Until) -> RecordEndpoint:
    """Play a bag straight into a recording."""
    player = BagEndpoint(BagOptions(source, rate=0, stamps="bag"))
    recorder = RecordEndpoint(RecordOptions(target))
    await recorder.start(events)
    await player.start(events)
    for name, info in events.infos.items():
        publisher = recorder.advertise(info)

        def sink(body: bytes, stamp_ns: int, publish: Callable[[bytes, int], None] = publisher.publish) -> bool:
            publish(body, stamp_ns)
            return True

        player.subscribe(name, sink)
    await until(lambda: player.exhausted)
    await player.stop()
    await recorder.stop()
    return recorder


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
async def test_round_trip_is_byte_identical(
    kind: str, make_bag: Make, tmp_path: Path, events: Any, until: Until
) -> None:
    source = make_bag(kind, 200)
    target = tmp_path / ("copy.bag" if kind == "bag" else "copy.mcap")
    recorder = await copy(source, target, events, until)
    assert sorted(read(target)) == sorted(read(source))
    assert recorder.counters.written == 402 and recorder.counters.dropped == 0 and recorder.problem is None
    assert sorted(p.name for p in tmp_path.iterdir() if "active" in p.name) == []
    with AnyReader([source]) as before, AnyReader([target]) as after:
        for old in before.connections:
            (new,) = [c for c in after.connections if c.topic == old.topic]
            assert (new.msgtype, new.msgdef) == (old.msgtype, old.msgdef)
            if kind == "bag":
                assert new.digest == old.digest
                assert isinstance(new.ext, ConnectionExtRosbag1) and isinstance(old.ext, ConnectionExtRosbag1)
                assert bool(new.ext.latching) == bool(old.ext.latching)
            else:
                assert isinstance(new.ext, ConnectionExtRosbag2) and isinstance(old.ext, ConnectionExtRosbag2)
                ours, theirs = new.ext.offered_qos_profiles[0], old.ext.offered_qos_profiles[0]
                assert (ours.durability, ours.reliability) == (theirs.durability, theirs.reliability)
    events.infos.clear()
    again = BagEndpoint(BagOptions(target, rate=0))
    await again.start(events)
    assert {i.name: (i.latched, i.reliable, i.type_hash) for i in events.infos.values()}.keys() >= {"/chat", "/map"}
    assert events.infos["/map"].latched and not events.infos["/chat"].latched
    await again.stop()


@pytest.mark.parametrize("name", ["husky_gps_imu_odom.bag", "jackal_imu_odom.bag"])
async def test_real_bags_round_trip(
    name: str, data: Callable[[str], Path], tmp_path: Path, events: Any, until: Until
) -> None:
    await copy(data(name), tmp_path / "copy.bag", events, until)
    assert sorted(read(tmp_path / "copy.bag")) == sorted(read(data(name)))


UNKNOWN = "uint8 WALK=1\nuint8 mode\nfloat64[2] legs\n"


def unknown(encoding: Encoding, name: str = "/gait") -> TopicInfo:
    type_name = "recorder_test_msgs/msg/Gait"
    type_hash = ros_types.hash_of(type_name, UNKNOWN, encoding)
    return TopicInfo(TopicName(name), type_name, encoding, type_hash, UNKNOWN, latched=True)


async def test_unknown_types_and_both_encodings_at_once(tmp_path: Path, events: Any) -> None:
    recorder = RecordEndpoint(RecordOptions(tmp_path / "deeper" / "mixed"))
    await recorder.start(events)
    sent = {}
    for encoding, topic in ((Encoding.ROS1, "/one"), (Encoding.CDR, "/two")):
        publisher = recorder.advertise(unknown(encoding, topic))
        body = bytes(range(17)) if encoding is Encoding.ROS1 else b"\x00\x01\x00\x00" + bytes(24)
        publisher.publish(body, START_NS)
        publisher.close()
        publisher.publish(body, START_NS + 1)  # closed: goes nowhere
        # The same connection again, and the same topic said another way.
        recorder.advertise(unknown(encoding, topic)).publish(body, START_NS + 2)
        sent[encoding] = [(topic, START_NS, body), (topic, START_NS + 2, body)]
    await recorder.stop()
    assert read(tmp_path / "deeper" / "mixed.bag") == sent[Encoding.ROS1]
    assert read(tmp_path / "deeper" / "mixed.mcap") == sent[Encoding.CDR]
    assert recorder.paths[Encoding.ROS1] == tmp_path / "deeper" / "mixed.bag"
    with AnyReader([tmp_path / "deeper" / "mixed.mcap"]) as reader:
        (connection,) = reader.connections
        assert isinstance(connection.ext, ConnectionExtRosbag2)
        assert connection.ext.offered_qos_profiles[0].durability is QosDurability.TRANSIENT_LOCAL
        assert connection.msgdef.data == UNKNOWN


async def test_a_folder_gets_files_named_by_date(tmp_path: Path, events: Any) -> None:
    recorder = RecordEndpoint(RecordOptions(tmp_path))
    await recorder.start(events)
    recorder.advertise(unknown(Encoding.ROS1)).publish(bytes(17), START_NS)
    await recorder.stop()
    (path,) = tmp_path.iterdir()
    assert path.name.startswith("sern_") and path.suffix == ".bag" and len(read(path)) == 1


@pytest.mark.parametrize("written", ["out/", "deeper/out/"])
async def test_a_path_that_ends_in_a_slash_is_a_folder_to_be_made(tmp_path: Path, events: Any, written: str) -> None:
    recorder = make_record(tmp_path, written)
    await recorder.start(events)
    recorder.advertise(unknown(Encoding.ROS1)).publish(bytes(17), START_NS)
    await recorder.stop()
    (path,) = (tmp_path / written).iterdir()
    assert path.name.startswith("sern_") and len(read(path)) == 1


def make_record(folder: Path, path: str) -> RecordEndpoint:
    """The endpoint as the configuration names it."""
    section = sections.RecordEndpoint(kind="record", path=path)
    endpoint = make_section(section, lambda name: folder / name)
    assert isinstance(endpoint, RecordEndpoint)
    return endpoint


async def test_an_empty_recording_leaves_no_file(tmp_path: Path, events: Any) -> None:
    recorder = RecordEndpoint(RecordOptions(tmp_path / "x.bag"))
    await recorder.start(events)
    await recorder.stop()
    await recorder.stop()  # again is harmless
    assert list(tmp_path.iterdir()) == [] and recorder.exhausted


async def test_refuses_what_it_could_not_read_back(tmp_path: Path, events: Any) -> None:
    recorder = RecordEndpoint(RecordOptions(tmp_path / "x"))
    with pytest.raises(UsageError):
        recorder.advertise(unknown(Encoding.ROS1))
    await recorder.start(events)
    name = TopicName("/gait")
    for info, said in [
        (TopicInfo(name, "std_msgs/msg/String", Encoding.RAW), "raw bodies"),
        (TopicInfo(name, "no_msgs/msg/Such", Encoding.CDR), "no definition"),
        (TopicInfo(name, "no_msgs/msg/Such", Encoding.ROS1, "", "not { a definition"), "cannot be parsed"),
        (TopicInfo(name, "no_msgs/msg/Such", Encoding.ROS1, "", "int8 x  # \ud800"), "no UTF-8"),
        (TopicInfo(name, "no_msgs/msg/Such", Encoding.CDR, "", "int8 x  # \ud800"), "no UTF-8"),
        (TopicInfo(name, "std_msgs/msg/String", Encoding.ROS1, "0" * 32), "0{32}.*992ce8a1687cec8c8bd883ec73ca41d1"),
    ]:
        with pytest.raises(ConfigError, match=said):
            recorder.advertise(info)
    with pytest.raises(UsageError):
        recorder.subscribe(name, lambda body, stamp_ns: True)
    # Without definition or hash, a known type is completed from the typestore.
    recorder.advertise(TopicInfo(TopicName("/s"), "std_msgs/String", Encoding.ROS1)).publish(b"\x01\x00\x00\x00a", 5)
    await recorder.stop()
    assert read(tmp_path / "x.bag") == [("/s", 5, b"\x01\x00\x00\x00a")]


def connections(path: Path) -> dict[str, set[tuple[str, str]]]:
    """Definitions and hashes by topic, as the file has them; the readers know nothing of ours."""
    reader = Reader1(path) if path.suffix == ".bag" else Reader2(path)
    with reader:
        found: dict[str, set[tuple[str, str]]] = {}
        for connection in reader.connections:
            found.setdefault(connection.topic, set()).add((connection.msgtype, connection.msgdef.data))
        return found


def bodies(path: Path) -> dict[str, list[tuple[str, bytes]]]:
    """What each topic holds, each body with the definition it is to be read with."""
    found: dict[str, list[tuple[str, bytes]]] = {}
    reader = Reader1(path) if path.suffix == ".bag" else Reader2(path)
    with reader:
        for connection, _, body in reader.messages():
            found.setdefault(connection.topic, []).append((connection.msgdef.data, bytes(body)))
    return found


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
@pytest.mark.parametrize("killed", [False, True])
async def test_a_false_definition_of_a_type_costs_others_nothing(
    encoding: Encoding, killed: bool, tmp_path: Path, events: Any, until: Until
) -> None:
    """Each topic keeps its own, also two on one topic, and also in what a killed process leaves."""
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run"))
    kept = []
    recorder.watch_kept(lambda upto, lost: kept.append(upto))
    await recorder.start(events)
    true, false = unknown(encoding, "/true"), replace(unknown(encoding, "/evil"), definition="uint8 x\n", type_hash="")
    recorder.advertise(false).publish(b"\0\1\0\0" + b"f", START_NS)
    recorder.advertise(true).publish(b"\0\1\0\0" + b"t", START_NS + 1)
    recorder.advertise(replace(true, name=false.name)).publish(b"\0\1\0\0" + b"u", START_NS + 2)
    recorder.flush()
    await until(lambda: kept[-1:] == [3])
    path = tmp_path / f"run{'.bag' if encoding is Encoding.ROS1 else '.mcap'}"
    if killed:
        left = path.with_name(f"left{path.suffix}.active")
        active = active_path(path)
        (shutil.copytree if active.is_dir() else shutil.copy)(active, left)
        await recorder.stop()
        assert finish(left).messages == 3
        path = path.with_name(f"left{path.suffix}")
    else:
        await recorder.stop()
    assert recorder.counters.errors == recorder.counters.dropped == 0
    assert bodies(path) == {
        "/evil": [("uint8 x\n", b"\0\1\0\0f"), (UNKNOWN, b"\0\1\0\0u")],
        "/true": [(UNKNOWN, b"\0\1\0\0t")],
    }
    kind = "recorder_test_msgs/msg/Gait"
    assert connections(path) == {"/evil": {(kind, "uint8 x\n"), (kind, UNKNOWN)}, "/true": {(kind, UNKNOWN)}}


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
async def test_fresh_definitions_of_one_topic_are_bounded(
    encoding: Encoding, tmp_path: Path, events: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """What comes beyond the bound is counted as dropped and said once; other topics go on."""
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run"))
    await recorder.start(events)
    count = bag_files.MAX_TOPIC_CONNECTIONS + 5
    for number in range(count):
        info = replace(unknown(encoding, "/evil"), definition=f"uint8 f{number}\n", type_hash="")
        publisher = recorder.advertise(info)
        publisher.publish(bytes(5), START_NS + number)
        publisher.close()
    first = replace(unknown(encoding, "/evil"), definition="uint8 f0\n", type_hash="")
    recorder.advertise(first).publish(bytes(6), START_NS + count)
    recorder.advertise(unknown(encoding, "/true")).publish(bytes(7), START_NS + count)
    await recorder.stop()
    (path,) = recorder.paths.values()
    found = bodies(path)
    assert len(found["/evil"]) == bag_files.MAX_TOPIC_CONNECTIONS + 1 and found["/evil"][-1][0] == "uint8 f0\n"
    assert found["/true"] == [(UNKNOWN, bytes(7))]
    assert recorder.drops[DropReason.STORAGE] == recorder.counters.dropped == 5
    said = [record.getMessage() for record in caplog.records if "/evil is not recorded" in record.getMessage()]
    assert len(said) == 1 and "32 definitions" in said[0]


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
async def test_definitions_of_one_file_are_bounded(
    encoding: Encoding, tmp_path: Path, events: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A definition that the file has costs nothing more."""
    monkeypatch.setattr(bag_files, "MAX_DEFINITION_BYTES", 200)
    monkeypatch.setattr(bag_files, "MAX_CONNECTIONS", 4)
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run"))
    await recorder.start(events)
    long = f"uint8 {'x' * 90}\nuint8 {'y' * 90}\n"
    for number, (topic, definition) in enumerate(
        [("/a", UNKNOWN), ("/b", long), ("/c", "uint8 x\n"), ("/d", UNKNOWN), ("/e", UNKNOWN), ("/f", UNKNOWN)]
    ):
        info = replace(unknown(encoding, topic), definition=definition, type_hash="")
        recorder.advertise(info).publish(bytes(5), START_NS + number)
    await recorder.stop()
    (path,) = recorder.paths.values()
    assert {topic: definition for topic, [(definition, _)] in bodies(path).items()} == {
        "/a": UNKNOWN, "/c": "uint8 x\n", "/d": UNKNOWN, "/e": UNKNOWN
    }  # fmt: skip
    assert recorder.drops[DropReason.STORAGE] == 2


async def test_overwrites_only_when_asked(tmp_path: Path, events: Any) -> None:
    (tmp_path / "run.bag").write_text("precious")
    with pytest.raises(ConfigError, match="exists already") as caught:
        await RecordEndpoint(RecordOptions(tmp_path / "run.bag")).start(events)
    assert "run.bag" in str(caught.value)
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run.bag", overwrite=True))
    await recorder.start(events)
    recorder.advertise(unknown(Encoding.ROS1)).publish(bytes(17), START_NS)
    await recorder.stop()
    assert [p.name for p in tmp_path.iterdir()] == ["run.bag"] and len(read(tmp_path / "run.bag")) == 1


async def test_the_other_file_in_the_way_is_seen_at_advertise(tmp_path: Path, events: Any) -> None:
    (tmp_path / "run.mcap").write_text("precious")
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run.bag"))
    await recorder.start(events)
    with pytest.raises(ConfigError, match=r"run\.mcap: exists already"):
        recorder.advertise(unknown(Encoding.CDR))
    await recorder.stop()
    assert (tmp_path / "run.mcap").read_text() == "precious"


async def test_a_place_that_cannot_be_written(tmp_path: Path, events: Any) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be made") as caught:
        await RecordEndpoint(RecordOptions(tmp_path / "file" / "run.bag")).start(events)
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="not supported"):
        await RecordEndpoint(RecordOptions(tmp_path / "run.db3")).start(events)


async def test_a_place_that_went_away(tmp_path: Path, events: Any, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "usb"
    recorder = RecordEndpoint(RecordOptions(folder / "run.bag"))
    await recorder.start(events)
    folder.rmdir()
    publisher = recorder.advertise(unknown(Encoding.ROS1))
    for i in range(5):
        publisher.publish(bytes(17), START_NS + i)
    await recorder.stop()
    assert recorder.counters.dropped == 5 and recorder.counters.errors == 1 and recorder.counters.written == 0
    assert recorder.problem is not None and "cannot be written" in recorder.problem
    assert all(record.exc_info is None and "\n" not in record.getMessage() for record in caplog.records)


def descriptors(folder: Path) -> list[str]:
    """What this process has open in a folder, deleted files too; other threads open and close what is elsewhere."""
    found: list[str] = []
    for entry in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # closed meanwhile
            found.append(str(entry.readlink()))
    return [target for target in found if target.startswith(str(folder))]


@pytest.mark.parametrize("kind", [BagFile, McapFile])
def test_a_hidden_folder_that_stays_does_not_end_the_recording(
    kind: type[RecordFile], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Some file systems keep the old name of an open file for as long as it is open."""
    rmtree = shutil.rmtree

    def refuse(folder: Path) -> None:
        if folder.name.startswith("."):
            raise OSError(errno.ENOTEMPTY, "Directory not empty", str(folder))
        rmtree(folder)

    monkeypatch.setattr(shutil, "rmtree", refuse)
    file = kind(tmp_path / "run")
    assert file.active.exists() and caplog.text.count("cannot be removed") == 1
    assert descriptors(tmp_path) != []
    file.finish()
    assert (tmp_path / "run").is_file() and not file.active.exists()
    assert descriptors(tmp_path) == []
    (tmp_path / "again.active").mkdir()
    with pytest.raises(FileExistsError):  # what went wrong first is what is said
        kind(tmp_path / "again")
    assert descriptors(tmp_path) == []


@contextmanager
def disk_of(size_bytes: int) -> Iterator[None]:
    """No file of this process grows beyond this: writing fails as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
@pytest.mark.parametrize("size_bytes", [2_600_000, 3_300_000])
async def test_a_full_disk_leaves_a_readable_file(
    encoding: Encoding, size_bytes: int, tmp_path: Path, events: Any, until: Until
) -> None:
    """3.2 MB for a smaller disk: what was written before is readable, and every message is accounted for."""
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run"))
    with disk_of(size_bytes):
        await recorder.start(events)
        publisher = recorder.advertise(topic_info("/blob", "std_msgs/msg/String", encoding))
        for i in range(32):
            publisher.publish(bytes([i]) * 100_000, START_NS + i)
        await recorder.stop()
    counters = recorder.counters
    got = read(recorder.paths[encoding])
    assert [row[1] - START_NS for row in got] == list(range(len(got)))
    assert len(got) == counters.written > 10 and counters.written + counters.dropped == 32
    assert (counters.errors > 0) == (counters.dropped > 0) == (size_bytes < 3_200_000)


async def test_memory_is_bounded(tmp_path: Path, events: Any) -> None:
    """Messages beyond the buffer are dropped and counted, with one complaint for the episode."""
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run.bag", max_buffer_bytes=10_000))
    await recorder.start(events)
    publisher = recorder.advertise(topic_info("/blob", "std_msgs/msg/String", Encoding.ROS1))
    for i in range(50):
        publisher.publish(bytes(20_000), START_NS + i)
    publisher.publish(b"\x00\x00\x00\x00", START_NS)
    publisher.publish(b"\x00\x00\x00\x00", -1)  # no bag holds this time
    await recorder.stop()
    assert recorder.counters.dropped == 51 and recorder.counters.written == 1 and recorder.counters.errors == 1


async def test_a_cancelled_stop_still_finishes_the_file(tmp_path: Path, events: Any, until: Until) -> None:
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run.bag"))
    await recorder.start(events)
    publisher = recorder.advertise(topic_info("/blob", "std_msgs/msg/String", Encoding.ROS1))
    for i in range(100):
        publisher.publish(bytes(50_000), START_NS + i)
    stopping = asyncio.create_task(recorder.stop())
    await asyncio.sleep(0)
    stopping.cancel()
    with pytest.raises(asyncio.CancelledError):
        await stopping
    await until((tmp_path / "run.bag").exists)
    assert len(read(tmp_path / "run.bag")) == 100


async def test_the_index_of_written_chunks_is_not_kept(tmp_path: Path, events: Any) -> None:
    """Many chunks, several topics: counts in the index are right although the per-message index was let go."""
    recorder = RecordEndpoint(RecordOptions(tmp_path / "run.bag"))
    await recorder.start(events)
    publishers = [recorder.advertise(topic_info(f"/t{i}", "std_msgs/msg/String", Encoding.ROS1)) for i in range(3)]
    for i in range(300):
        publishers[i % 3].publish(bytes(20_000), START_NS + i)
    await recorder.stop()
    with AnyReader([tmp_path / "run.bag"]) as reader:
        assert reader.message_count == 300
        assert {name: topic.msgcount for name, topic in reader.topics.items()} == {"/t0": 100, "/t1": 100, "/t2": 100}
    assert [row[1] - START_NS for row in read(tmp_path / "run.bag")] == list(range(300))


INTERRUPTED = """
import asyncio, os, signal, sys
from pathlib import Path
from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_runtime.ros_types import topic_info
from sern_core.vocabulary.types import Encoding

async def main(stop):
    recorder = RecordEndpoint(RecordOptions(Path(sys.argv[1])))
    await recorder.start(None)
    publisher = recorder.advertise(topic_info("/blob", "std_msgs/msg/String", Encoding.ROS1))
    try:
        for i in range(200):
            publisher.publish(bytes(20_000), i)
        os.kill(os.getpid(), signal.SIGINT)
        await asyncio.sleep(60)
    finally:
        if stop:
            await recorder.stop()

asyncio.run(main(sys.argv[2] == "stop"))
"""


@pytest.mark.parametrize("ending", ["stop", "nothing"])
async def test_ctrl_c_leaves_a_whole_file(ending: str, tmp_path: Path) -> None:
    """Interrupted with the buffer full; also when nobody gets to call `stop`."""
    path = tmp_path / "run.bag"
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", INTERRUPTED, str(path), ending, stderr=asyncio.subprocess.DEVNULL
    )
    async with asyncio.timeout(60):
        assert await process.wait() != 0
    assert len(read(path)) == 200
