"""The bag endpoint: what it announces, when and in which order it gives, and what it says of a damaged file."""

import asyncio
import itertools
import logging
import re
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from sern_client.endpoints.bag import BagEndpoint, BagOptions
from sern_client.endpoints.bag_faults import why
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime.ros_types import hash_of, topic_info

Make = Callable[..., Path]
Until = Callable[[Callable[[], bool]], Awaitable[None]]
START_NS = 1_700_000_000_000_000_000
CHAT, SCAN = TopicName("/chat"), TopicName("/scan_text")


def appender(rows: list[bytes]) -> Callable[[bytes, int], bool]:
    def sink(body: bytes, stamp_ns: int) -> bool:
        rows.append(body)
        return True

    return sink


async def collect(endpoint: BagEndpoint, events: Any, until: Until) -> dict[str, list[tuple[bytes, int]]]:
    """Start, subscribe to everything, wait for the end, stop."""
    got: dict[str, list[tuple[bytes, int]]] = {}
    await endpoint.start(events)
    try:
        for name in events.infos:
            rows = got[name] = []

            def sink(body: bytes, stamp_ns: int, rows: list[tuple[bytes, int]] = rows) -> bool:
                rows.append((body, stamp_ns))
                return True

            endpoint.subscribe(name, sink)
        await until(lambda: endpoint.exhausted)
    finally:
        await endpoint.stop()
    return got


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
async def test_announces_and_gives_everything(kind: str, make_bag: Make, events: Any, until: Until) -> None:
    endpoint = BagEndpoint(BagOptions(make_bag(kind, 20), rate=0, stamps="bag"))
    got = await collect(endpoint, events, until)
    assert {name: len(rows) for name, rows in got.items()} == {
        "/chat": 20,
        "/scan_text": 20,
        "/tf_static": 1,
        "/map": 1,
    }
    assert [stamp for _, stamp in got["/chat"]] == [START_NS + i * 10_000_000 for i in range(20)]
    assert all(b"message %d" % i in body for i, (body, _) in enumerate(got["/chat"]))
    encoding = Encoding.ROS1 if kind == "bag" else Encoding.CDR
    for name, info in events.infos.items():
        type_name = "tf2_msgs/msg/TFMessage" if name == "/tf_static" else "std_msgs/msg/String"
        expected = topic_info(name, type_name, encoding)
        assert (info.type_name, info.encoding, info.type_hash) == (type_name, encoding, expected.type_hash)
        assert info.definition
        assert info.latched == (name in {"/tf_static", "/map"})
        assert info.reliable == (None if kind == "bag" else name != "/scan_text")
    assert endpoint.counters.accepted == 42 and endpoint.counters.passes == 1 and endpoint.problem is None


async def test_db3_file_without_its_folder(make_bag: Make, events: Any, until: Until) -> None:
    path = next(make_bag("db3").glob("*.db3"))
    got = await collect(BagEndpoint(BagOptions(path, rate=0)), events, until)
    assert len(got["/chat"]) == 10


async def test_namespaces_make_one_bag_several_robots(make_bag: Make, events: Any, until: Until) -> None:
    options = BagOptions(make_bag("bag"), rate=0, namespaces=("r1", "/fleet/r2/"), topics=(".*",), deny=("/[^c].*",))
    got = await collect(BagEndpoint(options), events, until)
    assert sorted(got) == ["/fleet/r2/chat", "/r1/chat"]
    assert [b for b, _ in got["/r1/chat"]] == [b for b, _ in got["/fleet/r2/chat"]]
    assert len(got["/r1/chat"]) == 10


async def test_plays_in_time_without_drift(make_bag: Make, events: Any, until: Until, clock: Any) -> None:
    """Each message leaves at its own deadline, at half speed, over three passes of the loop."""
    endpoint = BagEndpoint(BagOptions(make_bag("bag", 50), rate=0.5, loop=True, topics=("/chat",)), clock=clock)
    times: list[float] = []

    def sink(body: bytes, stamp_ns: int) -> bool:
        times.append(clock.now_s)
        clock.now_s += 0.001  # the sink takes its time; playback must not add it up
        return True

    await endpoint.start(events)
    endpoint.subscribe(CHAT, sink)
    await until(lambda: len(times) >= 150)
    await endpoint.stop()
    assert not endpoint.exhausted
    # 50 messages at 10 ms, the last /scan_text 5 ms after the last: a period of 495 ms and 1 ns, doubled.
    expected = [100.0 + 2 * ((i // 50) * (0.495 + 1e-9) + (i % 50) * 0.01) for i in range(150)]
    assert all(due - 1e-9 <= at <= due + 0.0025 for at, due in zip(times, expected, strict=False))


async def test_refused_waits_and_shifts_the_clock(make_bag: Make, events: Any, until: Until, clock: Any) -> None:
    """One second of refusals delays the rest by one second; nothing is lost or out of order."""
    endpoint = BagEndpoint(BagOptions(make_bag("bag", 30), rate=1.0, topics=("/chat", "/scan_text")), clock=clock)
    taken: list[tuple[bytes, float]] = []
    others: list[float] = []

    def stubborn(body: bytes, stamp_ns: int) -> bool:
        if len(taken) == 10 and clock.now_s < 101.1:
            return False
        taken.append((body, clock.now_s))
        return True

    def on_scan(body: bytes, stamp_ns: int) -> bool:
        others.append(clock.now_s)
        return True

    await endpoint.start(events)
    endpoint.subscribe(CHAT, stubborn)
    endpoint.subscribe(SCAN, on_scan)
    await until(lambda: endpoint.exhausted)
    await endpoint.stop()
    assert all(b"message %d" % i in body for i, (body, _) in enumerate(taken)) and len(taken) == 30
    assert len(others) == 30
    gaps = [b - a for (_, a), (_, b) in itertools.pairwise(taken)]
    assert 1.0 <= gaps[9] <= 1.1
    assert all(abs(gap - 0.01) < 1e-6 for i, gap in enumerate(gaps) if i != 9)
    assert abs(others[-1] - taken[-1][1] - 0.005) < 1e-6
    assert endpoint.counters.refused > 3 and endpoint.counters.dropped == 0


async def test_refused_is_dropped_and_counted(make_bag: Make, events: Any, until: Until) -> None:
    endpoint = BagEndpoint(BagOptions(make_bag("bag"), rate=0, on_refused="drop", topics=("/chat",)))
    await endpoint.start(events)
    offered: list[bytes] = []

    def every_other(body: bytes, stamp_ns: int) -> bool:
        offered.append(body)
        return len(offered) % 2 == 0

    endpoint.subscribe(CHAT, every_other)
    await until(lambda: endpoint.exhausted)
    await endpoint.stop()
    assert len(offered) == 10
    assert endpoint.counters.accepted == endpoint.counters.dropped == 5


async def test_waits_for_its_audience(make_bag: Make, events: Any, until: Until) -> None:
    endpoint = BagEndpoint(BagOptions(make_bag("bag"), rate=0, wait_for=("/chat", "/scan_text")))
    await endpoint.start(events)
    chat: list[bytes] = []
    endpoint.subscribe(CHAT, appender(chat))
    endpoint.subscribe(SCAN, lambda body, stamp_ns: True)
    endpoint.interest(CHAT, True)
    for _ in range(20):
        await asyncio.sleep(0)
    assert not chat  # the other one is not wanted yet
    endpoint.interest(SCAN, True)
    await until(lambda: endpoint.exhausted)
    await endpoint.stop()
    assert len(chat) == 10
    assert endpoint.counters.unwanted == 2  # the latched ones


async def test_latched_topic_reaches_a_late_subscriber(make_bag: Make, events: Any, until: Until) -> None:
    endpoint = BagEndpoint(BagOptions(make_bag("mcap"), rate=0))
    await endpoint.start(events)
    await until(lambda: endpoint.exhausted)
    got: list[bytes] = []

    def second_time_lucky(body: bytes, stamp_ns: int) -> bool:
        got.append(body)
        return len(got) > 1

    endpoint.subscribe(TopicName("/map"), second_time_lucky)
    assert not endpoint.exhausted
    await until(lambda: endpoint.exhausted)
    late: list[bytes] = []
    endpoint.subscribe(CHAT, appender(late))
    await asyncio.sleep(0)
    await endpoint.stop()
    assert len(got) == 2 and got[0] == got[1] and not late


async def test_a_closed_subscription_gets_nothing_more(make_bag: Make, events: Any, until: Until) -> None:
    """Also when it is closed while a message of its own is being refused."""
    endpoint = BagEndpoint(BagOptions(make_bag("bag"), rate=0, topics=("/chat",)))
    await endpoint.start(events)
    refusals: list[bytes] = []

    def refuse(body: bytes, stamp_ns: int) -> bool:
        refusals.append(body)
        return False

    subscription = endpoint.subscribe(CHAT, refuse)
    await until(lambda: len(refusals) >= 2)
    subscription.close()
    await until(lambda: endpoint.exhausted)
    await endpoint.stop()
    assert set(refusals) == {refusals[0]}
    assert endpoint.counters.unwanted == 9


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
@pytest.mark.parametrize("keep", [0.0, 0.02, 0.2, 0.5, 0.8, 0.98])
async def test_truncated_file(kind: str, keep: float, make_bag: Make, events: Any, until: Until) -> None:
    """Cut anywhere: one line that names the file and a cure, at start or when playback gets there."""
    path = make_bag(kind, 300)
    target = next(path.glob("*.db3")) if kind == "db3" else path
    raw = target.read_bytes()
    target.write_bytes(raw[: int(len(raw) * keep)])
    endpoint = BagEndpoint(BagOptions(path, rate=0))
    problem: str | None
    try:
        await collect(endpoint, events, until)
        problem = endpoint.problem
        assert endpoint.counters.errors == 1
    except ConfigError as error:
        problem = str(error)
    assert problem is not None and "\n" not in problem
    assert str(path) in problem and ("reindex" in problem or "recover" in problem)
    assert re.search("it is empty|cut off|not finished|it is not|end is missing|damaged|malformed|corrupt", problem), (
        problem
    )
    assert not re.search(r"\b[A-Z]\w*(Error|Exception)\b", problem), problem  # a class of ours is no reason


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("x.bag", b"", "it is empty"),
        ("x.bag", b"hello", "it is not a ROS 1 bag"),
        ("x.bag", b"#ROSBAG V2.0\nhello", "its header is damaged"),
        ("x.mcap", b"hello", "it is not an MCAP file"),
        ("x.mcap", b"\x89MCAP0\r\nhello", "its end is missing"),
        ("x.db3", b"hello", "it is not an SQLite database"),
    ],
)
async def test_a_broken_file_says_why(name: str, content: bytes, said: str, tmp_path: Path, events: Any) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        await BagEndpoint(BagOptions(path, rate=0)).start(events)
    text = str(caught.value)
    assert said in text and str(path) in text and "; try `" in text and "\n" not in text


def test_an_error_without_words_is_damage() -> None:
    assert why(Path(__file__), AssertionError()) == "its bytes are damaged"
    assert why(Path(__file__), KeyError(3)) == "its bytes are damaged: 3"


async def test_damage_found_while_playing(
    make_bag: Make, events: Any, until: Until, caplog: pytest.LogCaptureFixture
) -> None:
    """A sound index over a damaged chunk: what comes before it is played, then one line, and playback has ended."""
    path = make_bag("bag", 200)
    raw = bytearray(path.read_bytes())
    middle = raw.index(b"message 150") - 60
    raw[middle : middle + 50] = b"\xff" * 50
    path.write_bytes(raw)
    endpoint = BagEndpoint(BagOptions(path, rate=0, topics=("/chat",), loop=True))
    with caplog.at_level(logging.ERROR):
        got = await collect(endpoint, events, until)
    assert 0 < len(got["/chat"]) <= 150
    assert endpoint.counters.errors == 1 and endpoint.exhausted
    (record,) = caplog.records
    assert record.exc_info is None and "\n" not in record.getMessage() and str(path) in record.getMessage()


async def test_constants_as_they_are_spelt(tmp_path: Path, events: Any, until: Until) -> None:
    """A type whose constants a parser would respell keeps its true md5 and plays."""
    from rosbags.rosbag1 import Writer

    definition = "uint8 MASK=0x0F\nfloat32 EPS=1e-3\nuint8 value\n"
    path = tmp_path / "constants.bag"
    with Writer(path) as writer:
        connection = writer.add_connection(
            "/mask",
            "my_msgs/msg/Mask",
            msgdef=definition,
            md5sum=hash_of("my_msgs/msg/Mask", definition, Encoding.ROS1),
        )
        writer.write(connection, START_NS, b"\x05")
    got = await collect(BagEndpoint(BagOptions(path, rate=0)), events, until)
    assert got["/mask"][0][0] == b"\x05"
    assert events.infos["/mask"].definition == definition


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (BagOptions(Path("nowhere.bag")), "no such file"),
        (BagOptions(Path(__file__)), "unknown kind of file"),
        (BagOptions(Path(__file__).parent), "reindex"),
    ],
)
async def test_not_a_bag(options: BagOptions, said: str, events: Any) -> None:
    endpoint = BagEndpoint(options)
    with pytest.raises(ConfigError, match=said) as caught:
        await endpoint.start(events)
    assert str(options.path) in str(caught.value) and "\n" not in str(caught.value)
    await endpoint.stop()


async def test_nothing_to_play(make_bag: Make, events: Any) -> None:
    path = make_bag("bag")
    for options, said in [
        (BagOptions(path, topics=("/nothing",)), "no topic matches"),
        (BagOptions(path, wait_for=("/nothing",)), "wait_for names /nothing"),
    ]:
        endpoint = BagEndpoint(options)
        with pytest.raises(ConfigError, match=said):
            await endpoint.start(events)
        await endpoint.stop()


def test_bad_options(tmp_path: Path) -> None:
    path = tmp_path / "x.bag"
    for options in [
        BagOptions(path, rate=-1),
        BagOptions(path, namespaces=("no good",)),
        BagOptions(path, topics=("/(",)),
    ]:
        with pytest.raises(ConfigError):
            BagEndpoint(options)


async def test_misuse(make_bag: Make, events: Any) -> None:
    endpoint = BagEndpoint(BagOptions(make_bag("bag"), wait_for=("/chat",)))
    await endpoint.start(events)
    with pytest.raises(UsageError, match="/unknown"):
        endpoint.subscribe(TopicName("/unknown"), lambda body, stamp_ns: True)
    with pytest.raises(ConfigError, match="takes no messages"):
        endpoint.advertise(topic_info("/cmd_vel", "geometry_msgs/msg/Twist", Encoding.ROS1))
    await endpoint.stop()


@pytest.mark.parametrize(("name", "count"), [("husky_gps_imu_odom.bag", 16806), ("jackal_imu_odom.bag", 6121)])
async def test_real_bags(name: str, count: int, data: Callable[[str], Path], events: Any, until: Until) -> None:
    got = await collect(BagEndpoint(BagOptions(data(name), rate=0)), events, until)
    assert sum(len(rows) for rows in got.values()) == count
    for topic, info in events.infos.items():
        assert info.type_hash == topic_info(topic, info.type_name, Encoding.ROS1).type_hash
        assert "#" in info.definition  # as recorded, comments and all
