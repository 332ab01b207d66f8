"""The baseline over real sockets: what is offered on one side arrives on the other, logged like SERN's."""

import asyncio
from pathlib import Path

import pytest

from sern_client.endpoints.base import Difference, Held, Publisher, Sink, Subscription, TopicEvents
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime.config.client import load_client
from sern_runtime.profiles import load_profile
from sern_tools.baseline import Baseline
from sern_tools.demo_scenario import COMMAND_TOPIC, POSE_TOPIC, ROBOT, SITE, Ports, Scenario, write_files
from sern_tools.harness.processes import Children, python
from sern_tools.message_log import MessageLog, read_logs
from sern_tools.ports import free_ports
from tests.support import DEADLINE_S, until

HOST = "127.0.0.1"


class Source:
    """An endpoint that gives what the test hands it."""

    def __init__(self, *topics: str) -> None:
        self.topics = topics
        self.sinks: dict[str, Sink] = {}
        self.running = False

    async def start(self, events: TopicEvents) -> None:
        self.running = True
        for name in self.topics:
            events.topic_added(TopicInfo(TopicName(name), "geometry_msgs/msg/Twist", Encoding.CDR))

    async def stop(self) -> None:
        self.running = False

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        self.sinks[name] = sink
        return _Closing(self.sinks, name)

    def validate(self, held: Held) -> list[Difference]:
        del held
        return []

    def interest(self, name: TopicName, wanted: bool) -> None:
        assert wanted and name in self.sinks

    def advertise(self, info: TopicInfo) -> Publisher:
        raise UsageError("publishes nothing")

    @property
    def encoding(self) -> None:
        return None

    @property
    def exhausted(self) -> bool:
        return False


class _Closing:
    def __init__(self, sinks: dict[str, Sink], name: str) -> None:
        self._sinks = sinks
        self._name = name

    def close(self) -> None:
        self._sinks.pop(self._name, None)


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    return write_files(tmp_path / "run", Scenario(load_profile("demo"), 10), Ports(*free_ports(4)))


async def test_both_directions_are_carried_and_logged(files: dict[str, Path], tmp_path: Path) -> None:
    robot_source, site_source = Source("/odometry/filtered", "/cmd_vel"), Source(COMMAND_TOPIC, "/not_listed")
    logs = {name: tmp_path / f"{name}.csv" for name in (ROBOT, SITE)}
    robot = Baseline(load_client(files[ROBOT]).model, robot_source, MessageLog(logs[ROBOT]))
    site = Baseline(load_client(files[SITE]).model, site_source, MessageLog(logs[SITE]))
    up, down = free_ports(2)
    try:
        site.open(f"bind:tcp://{HOST}:{down}", f"bind:tcp://{HOST}:{up}")
        robot.open(f"tcp://{HOST}:{up}", f"tcp://{HOST}:{down}")
        await until(lambda: robot.idle_latency_s() is not None and site.idle_latency_s() is not None)
        for side in (robot, site):
            await side.go()
        # A topic that comes in here does not go out, and one without a rule is not discovered at the site.
        assert robot_source.sinks.keys() == {"/odometry/filtered"}
        assert site_source.sinks.keys() == {COMMAND_TOPIC}
        for number in range(20):
            assert robot_source.sinks["/odometry/filtered"](b"pose %d" % number, 0)
        assert site_source.sinks[COMMAND_TOPIC](b"drive", 0)
        robot_source_sink = robot_source.sinks["/odometry/filtered"]
        await until(lambda: site.counts().get(POSE_TOPIC, {}).get("delivered") == 20)
        await until(lambda: robot.counts().get(COMMAND_TOPIC, {}).get("delivered") == 1)
        assert robot.counts()[POSE_TOPIC]["offered"] == 20
        await robot.quiet()
        assert not robot_source.running
        assert robot_source.sinks == {}
        assert robot_source_sink is not None
    finally:
        await robot.close()
        await site.close()
    merged = read_logs(logs.items())
    assert merged.keys() == {POSE_TOPIC, COMMAND_TOPIC}
    pose = merged[POSE_TOPIC]
    assert (pose.priority, pose.origin, pose.offered) == ("control", ROBOT, 20)
    assert [d.seq for d in pose.deliveries] == list(range(1, 21))
    assert all(d.crc32 == pose.offers[d.seq].crc32 and d.latency_s >= 0 for d in pose.deliveries)
    assert merged[COMMAND_TOPIC].origin == SITE


async def test_the_process_answers_words_and_ends_with_its_input(files: dict[str, Path], tmp_path: Path) -> None:
    up, down = free_ports(2)
    command = python("-m", "sern_tools.baseline", "--config", str(files[SITE]))
    command += ["--publish", f"bind:tcp://{HOST}:{down}", "--subscribe", f"bind:tcp://{HOST}:{up}"]
    async with Children(tmp_path) as children:
        process = await children.start("baseline", command, talks=True)
        async with asyncio.timeout(DEADLINE_S):
            assert await process.read_object() == {"ready": True}
            answers = [await process.ask(word) for word in ("floor", "go", "dance")]
            assert answers == [{"floor_s": None}, {"done": "go"}, {"error": "unknown word 'dance'"}]
            assert set((await process.ask("count"))["topics"]) <= {COMMAND_TOPIC}
            assert await process.ask("quiet") == {"done": "quiet"}
            await children.end(process, number=None)


@pytest.mark.parametrize(("arguments", "words"), [(["--config", "/nowhere.yaml"], "nowhere.yaml")])
async def test_a_file_that_is_wrong_is_one_line(tmp_path: Path, arguments: list[str], words: str) -> None:
    addresses = ["--publish", "bind:tcp://127.0.0.1:1", "--subscribe", "bind:tcp://127.0.0.1:1"]
    async with Children(tmp_path) as children:
        process = await children.start("baseline", python("-m", "sern_tools.baseline", *arguments, *addresses))
        assert await process.process.wait() == 2
    text = process.log.read_text()
    assert len(text.splitlines()) == 1
    assert words in text
