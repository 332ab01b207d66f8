"""What streams from elsewhere become here: what is published, when a stop command is, and what one fault may cost."""

import logging
from math import inf
from types import SimpleNamespace
from typing import Any

import pytest

from sern_client import commands, inbound
from sern_client.endpoints.base import Difference
from sern_client.inbound import Inbound
from sern_client.site import Site
from sern_client.tables import Tables
from sern_core.site.services import call_name
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import Direction, Lease, LossAction, Ramp, RuleSet, TopicRule
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.ledger import OTHER_TOPIC
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, PriorityClass, TopicName
from sern_runtime import clock, ros_types
from tests.bridges import FakeEndpoint, FakePublisher, Shell, bridge_of
from tests.support import until
from tests.world import spec

TEXT = "std_msgs/msg/String"
TWIST = "geometry_msgs/msg/Twist"
STOP = ros_types.zero_message(TWIST, Encoding.CDR)
POSE = TopicName("/robot/pose")
COMMANDS = TopicName("/cmd_vel")
FOR_EVER_S = 3600.0


def stream(name: str, type_name: str = TEXT, kind: TopicSpec | None = None) -> StreamInfo:
    info = ros_types.topic_info(name, type_name, Encoding.CDR)
    return StreamInfo(StreamId(ClientName("robot"), 1, info.name), info, kind or spec(), {})


def ramped(after_s: float = FOR_EVER_S, decelerate: float = 100.0) -> TopicRule:
    lease = Lease(LossAction.RAMP, after_s, Ramp(0.125, decelerate, decelerate))
    return TopicRule(compile_pattern(COMMANDS), priority=PriorityClass.CONTROL, lease=lease)


def drive(forward_mps: float) -> bytes:
    linear = ros_types.new("geometry_msgs/msg/Vector3", Encoding.CDR, x=forward_mps, y=0.0, z=0.0)
    still = ros_types.new("geometry_msgs/msg/Vector3", Encoding.CDR, x=0.0, y=0.0, z=0.0)
    return ros_types.serialise(ros_types.new(TWIST, Encoding.CDR, linear=linear, angular=still), TWIST, Encoding.CDR)


def speeds(publisher: FakePublisher) -> list[float]:
    return [ros_types.deserialise(body, TWIST, Encoding.CDR).linear.x for body in publisher.bodies]


def leased(after_s: float = FOR_EVER_S, match: str = COMMANDS) -> TopicRule:
    lease = Lease(LossAction.ZERO, after_s)
    return TopicRule(compile_pattern(match), priority=PriorityClass.CONTROL, lease=lease)


class FakeGuard:
    """Keeps what a guard is told; `endpoint` to see what was published before."""

    def __init__(self, endpoint: FakeEndpoint) -> None:
        self.told: list[tuple[object, ...]] = []
        self.commands: list[bytes | None] = []
        self.slowing: list[bool] = []
        self._endpoint = endpoint

    def _published(self) -> int:
        return sum(len(publisher.bodies) for publisher in self._endpoint.publishers)

    def opened(self, info: Any, stop: bytes, _ramp: Ramp | None = None) -> int:
        assert stop == STOP
        self.told.append(("opened", info.name))
        return 1

    def commanded(self, key: int, due_s: float | None, command: bytes | None) -> None:
        assert key == 1
        self.commands.append(command)
        self.told.append(("lease", due_s is not None, self._published()))

    def lease(self, key: int, due_s: float | None, *, since_s: float | None = None) -> None:
        assert key == 1
        self.slowing.append(since_s is not None)
        self.told.append(("lease", due_s is not None, self._published()))

    def closed(self, key: int) -> None:
        assert key == 1
        self.told.append(("closed", self._published()))


class Here:
    """A site whose bridge hears of streams."""

    def __init__(self, *rules: TopicRule, **options: Any) -> None:
        self.endpoint = FakeEndpoint()
        self.shell = Shell()
        self.guard = FakeGuard(self.endpoint)
        self.bridge = bridge_of(self.endpoint, rules, shell=self.shell, guard=self.guard, **options)
        self.inbound = self.bridge.inbound
        self.seq = 0

    def opened(self, name: str, type_name: str = TEXT, kind: TopicSpec | None = None) -> StreamInfo:
        opened = stream(name, type_name, kind)
        self.bridge.stream_opened(opened)
        return opened

    @property
    def publisher(self) -> FakePublisher:
        """The last one."""
        return self.endpoint.publishers[-1]

    def message(self, of: StreamInfo, body: bytes, *, age_s: float = 0.0) -> None:
        self.seq += 1
        now = clock.now()
        self.bridge.message(of, Message(of.id, self.seq, body, 1, now - age_s), now=now)


async def test_a_stream_is_published_under_its_local_name_until_it_ends() -> None:
    here = Here(namespace="/site")
    for name, local in (("/robot/pose", "/robot/pose"), ("/site/cmd", "/cmd")):
        opened = here.opened(name)
        assert here.publisher.info.name == local and here.inbound.held[TopicName(local)] == 1
        here.message(opened, b"one")
        here.bridge.stream_closed(opened)
        here.message(opened, b"two")  # of nothing that is known
        here.bridge.stream_closed(opened)
        assert here.publisher.bodies == [b"one"] and here.publisher.closed and not here.inbound.streams
    assert here.shell.faults == []


async def test_how_long_a_message_is_young_enough_goes_with_it() -> None:
    here = Here()
    for kind, left_s in ((spec(lifespan_s=10.0), 4.0), (spec(lifespan_s=5.0), 0.0), (spec(), inf)):
        opened = here.opened(POSE, kind=kind)
        here.message(opened, b"x", age_s=6.0)
        assert here.publisher.left_s == [pytest.approx(left_s)]
        here.bridge.stream_closed(opened)


async def test_what_is_only_sent_from_here_is_refused_and_said_once(caplog: pytest.LogCaptureFixture) -> None:
    here = Here(TopicRule(compile_pattern(POSE), direction=Direction.SEND))
    for _ in range(3):
        with pytest.raises(ConfigError, match="only sent from here"):
            here.opened(POSE)
    assert not here.inbound.streams and here.endpoint.publishers == []
    assert caplog.text.count("is not received") == 1


async def test_another_reason_is_said_as_well(caplog: pytest.LogCaptureFixture) -> None:
    here = Here()
    for problem in ("unknown type", "unknown type", "another type is there", "unknown type"):
        here.endpoint.refusals[POSE] = ConfigError(problem)
        with pytest.raises(ConfigError, match=problem):
            here.opened(POSE)
    said = [record.getMessage().partition("received: ")[2] for record in caplog.records]
    assert said == ["unknown type", "another type is there", "unknown type"] and here.inbound.publish_failures == 0


async def test_an_endpoint_that_breaks_costs_one_stream(caplog: pytest.LogCaptureFixture) -> None:
    here = Here()
    here.endpoint.refusals[POSE] = RuntimeError("broken")
    with pytest.raises(ConfigError, match=r"/robot/pose: cannot be published here: .*broken"):
        here.opened(POSE)
    assert here.inbound.publish_failures == 1 and "Traceback" in caplog.text
    here.opened("/robot/odom")
    assert [stream.topic for stream in here.inbound.streams] == ["/robot/odom"]


async def test_a_stream_of_a_service_is_none_of_its_business() -> None:
    here = Here()
    with pytest.raises(ConfigError, match="nothing in `services` here"):
        here.opened(call_name(TopicName("/robot/lamp"), ClientName("site")))
    assert here.endpoint.publishers == []


class RefusingCore:
    """A core that keeps what could not be published, and counts how often it is to try again."""

    def __init__(self) -> None:
        self.subscription = SimpleNamespace(patterns=())
        self.refused = {stream(POSE).id}
        self.opened: set[StreamId] = set()
        self.again = 0

    def reconsider(self, *, now: float) -> None:
        self.again += 1
        self.refused.clear()

    def hold(self, identity: StreamId, seq: int) -> None: ...

    def release(self, identity: StreamId, seq: int, *, lost: DropReason | None = None, now: float) -> None: ...

    def subscribe(self, patterns: tuple[str, ...], *, now: float) -> None: ...


def of_core(core: Any, endpoint: FakeEndpoint, shell: Shell) -> Inbound:
    return Inbound(Site(endpoint, RuleSet(()), "/", kick=shell.kick), core)


async def test_what_could_not_be_published_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inbound, "AGAIN_S", (0.01, 60.0))
    endpoint, core, shell = FakeEndpoint(), RefusingCore(), Shell()
    endpoint.refusals[POSE] = ConfigError("another type is there")
    taken = of_core(core, endpoint, shell)
    with pytest.raises(ConfigError):
        taken.stream_opened(stream(POSE))
    await until(lambda: core.again == 1)
    assert shell.kicks == 1
    taken.close()


async def test_it_is_tried_at_once_when_another_stream_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inbound, "AGAIN_S", (FOR_EVER_S, FOR_EVER_S))
    endpoint, core = FakeEndpoint(), RefusingCore()
    taken = of_core(core, endpoint, Shell())
    taken.stream_opened(stream("/robot/odom"))
    taken.stream_closed(stream("/robot/odom"))
    await until(lambda: core.again == 1)
    taken.close()


async def test_messages_that_cannot_be_published_are_counted_and_end_nothing(caplog: pytest.LogCaptureFixture) -> None:
    here = Here()
    opened = here.opened(POSE)
    here.publisher.error = RuntimeError("its thread has ended")
    here.message(opened, b"one")
    here.message(opened, b"two")
    assert here.publisher.bodies == [b"two"] and here.inbound.publish_failures == 1
    assert "/robot/pose could not be published here" in caplog.text
    here.publisher.error = RuntimeError("it cannot be closed either")
    here.bridge.stream_closed(opened)
    assert not here.inbound.streams and here.inbound.publish_failures == 2
    assert here.shell.faults == []


async def test_parts_that_fail_cost_no_message() -> None:
    class BrokenLog:
        def delivered(self, *_: object) -> None:
            raise OSError("no space")

    log: Any = BrokenLog()
    here = Here(log=log)
    opened = here.opened(POSE)
    broken: Any = SimpleNamespace(observe=None)
    here.inbound.ages = broken
    here.message(opened, b"one")
    assert here.publisher.bodies == [b"one"]
    assert here.bridge.site.parts.failures == {"metrics": 1, "message_log": 1}


async def test_frame_ids_are_our_own_again() -> None:
    here = Here(frame_prefix="site/")
    name = "std_msgs/msg/Header"
    opened = here.opened("/robot/head", name)
    header = ros_types.header(1, "site/map", Encoding.CDR, 0)
    here.message(opened, ros_types.serialise(header, name, Encoding.CDR))
    assert here.publisher.bodies == [ros_types.serialise(ros_types.header(1, "map", Encoding.CDR, 0), name,
                                                         Encoding.CDR)]  # fmt: skip


# Leases ---------------------------------------------------------------------------------------------------------------


async def test_a_command_stream_that_ends_stops_the_robot() -> None:
    here = Here(leased())
    opened = here.opened(COMMANDS, TWIST)
    here.message(opened, b"go")
    here.bridge.stream_closed(opened)
    assert here.publisher.bodies == [b"go", STOP] and here.publisher.closed
    assert here.guard.told == [("opened", COMMANDS), ("lease", True, 0), ("closed", 2)]
    assert here.inbound.commands.leases_fired == 0


async def test_a_robot_that_was_not_commanded_is_not_spoken_to() -> None:
    here = Here(leased())
    opened = here.opened(COMMANDS, TWIST)
    here.bridge.stream_closed(opened)
    assert here.publisher.bodies == [] and here.publisher.closed
    assert here.guard.told == [("opened", COMMANDS), ("closed", 0)]


async def test_the_end_of_the_client_stops_every_robot() -> None:
    here = Here(leased(match="/r[12]/cmd_vel"))
    for name in ("/r1/cmd_vel", "/r2/cmd_vel"):
        here.message(here.opened(name, TWIST), b"go")
    here.opened(POSE)
    assert here.inbound.commands.due_s is not None
    here.bridge.close()
    assert [publisher.bodies for publisher in here.endpoint.publishers] == [[b"go", STOP], [b"go", STOP], []]
    assert all(publisher.closed for publisher in here.endpoint.publishers) and here.inbound.commands.due_s is None


async def test_a_stop_that_cannot_be_published_does_not_keep_the_next_robot_going() -> None:
    here = Here(leased(match="/r[12]/cmd_vel"))
    for name in ("/r1/cmd_vel", "/r2/cmd_vel"):
        here.message(here.opened(name, TWIST), b"go")
    first, second = here.endpoint.publishers
    first.error = RuntimeError("broken")
    here.bridge.close()
    assert second.bodies == [b"go", STOP] and first.closed and second.closed
    assert here.inbound.publish_failures == 1


async def test_without_fresh_commands_the_robot_is_stopped(caplog: pytest.LogCaptureFixture) -> None:
    here = Here(leased(0.001))
    opened = here.opened(COMMANDS, TWIST)
    here.message(opened, b"go")
    assert here.inbound.commands.due_s is not None
    await until(lambda: len(here.publisher.bodies) > 1, "the first stop command")
    assert here.publisher.bodies[:2] == [b"go", STOP] and here.inbound.commands.leases_fired == 1
    assert here.guard.told[:3] == [("opened", COMMANDS), ("lease", True, 0), ("lease", True, 2)]
    await until(lambda: len(here.publisher.bodies) > 2, "it is repeated")
    assert set(here.publisher.bodies[1:]) == {STOP}
    assert (
        here.inbound.commands.leases_fired == 1
        and caplog.text.count("no fresh command; publishing the stop command") == 1
    )
    here.bridge.close()


async def test_with_a_ramp_the_robot_is_slowed_down_and_told_zero_once(caplog: pytest.LogCaptureFixture) -> None:
    here = Here(ramped(0.001, decelerate=5.0))
    opened = here.opened(COMMANDS, TWIST)
    here.message(opened, drive(1.0))
    await until(lambda: here.inbound.commands.due_s is None, "the robot stands")
    said = speeds(here.publisher)
    assert said[0] == 1.0 and said[-1] == 0.0 and said.count(0.0) == 1
    assert said == sorted(said, reverse=True) and len(said) >= 2
    assert here.guard.commands == [drive(1.0)] and all(here.guard.slowing)
    assert caplog.text.count("no fresh command; slowing the robot down") == 1
    assert here.inbound.commands.leases_fired == 1
    here.bridge.close()
    assert speeds(here.publisher) == said, "it stands: there is nothing left to say"


async def test_a_robot_whose_operator_leaves_is_slowed_down_as_well() -> None:
    here = Here(ramped(0.001, decelerate=5.0))
    opened = here.opened(COMMANDS, TWIST)
    here.message(opened, drive(1.0))
    here.bridge.stream_closed(opened)
    publisher = here.publisher
    assert not publisher.closed and here.inbound.held[COMMANDS] == 1
    await until(lambda: publisher.closed, "it stands, and the topic is ended")
    assert speeds(publisher)[-1] == 0.0 and speeds(publisher).count(0.0) == 1
    assert here.guard.told[-1][0] == "closed" and here.inbound.held[COMMANDS] == 0


async def test_the_next_operator_ends_the_ramp_of_the_last_one() -> None:
    here = Here(ramped())
    first = here.opened(COMMANDS, TWIST)
    here.message(first, drive(1.0))
    here.bridge.stream_closed(first)
    before = here.publisher
    closed = [before.closed]  # its last command still holds
    second = here.opened(COMMANDS, TWIST)
    closed.append(before.closed)
    here.message(second, drive(0.5))
    assert [*closed, before.closed] == [False, False, True]
    assert speeds(before) == [1.0] and speeds(here.publisher) == [0.5]
    here.bridge.close()
    assert speeds(here.publisher) == [0.5, 0.0] and here.publisher.closed


async def test_many_streams_that_end_are_not_kept_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "MAX_ENDING", 0)
    here = Here(ramped())
    opened = here.opened(COMMANDS, TWIST)
    here.message(opened, drive(1.0))
    here.bridge.stream_closed(opened)
    assert speeds(here.publisher) == [1.0, 0.0] and here.publisher.closed


async def test_a_command_that_cannot_be_read_is_answered_with_the_stop_command() -> None:
    here = Here(ramped(0.001))
    here.message(here.opened(COMMANDS, TWIST), b"go")
    await until(lambda: here.inbound.commands.due_s is None)
    assert here.publisher.bodies == [b"go", STOP] and here.guard.commands == [None]
    here.bridge.close()


async def test_a_type_that_has_no_stop_command_has_no_lease(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros_types, "zero_message", lambda _type, _encoding: None)
    here = Here(leased())
    here.message(here.opened(COMMANDS, TWIST), b"go")
    assert here.inbound.commands.due_s is None and here.guard.told == []
    assert "on_link_loss cannot stop it; no lease" in caplog.text and here.publisher.bodies == [b"go"]


# What is counted and said ---------------------------------------------------------------------------------------------


async def test_missed_deadlines_are_counted_by_topic_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inbound, "MAX_TOPICS", 1)
    here = Here()
    kind = TopicSpec(deadline_s=0.5)
    first, second = here.opened(POSE, kind=kind), here.opened("/robot/odom", kind=kind)
    for now in (1.0, 1.5, 2.1, 3.0):
        for each in (first, second):
            here.bridge.message(each, Message(each.id, 1, b"x", 1, now), now=now)
    assert here.inbound.deadlines_missed == {POSE: 2, OTHER_TOPIC: 2}
    here.bridge.stream_closed(first)
    first = here.opened(POSE, kind=kind)
    here.bridge.message(first, Message(first.id, 1, b"x", 1, 9.0), now=9.0)
    assert here.inbound.deadlines_missed[POSE] == 2, "between the end of a stream and its return there is no deadline"


async def test_a_refused_subscription_is_said_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inbound, "MAX_PROBLEMS", 2)
    here = Here()
    for text in ("/a is not yours", "/b is not yours", "/a is not yours", "/b is not yours", "/c is not yours"):
        here.bridge.subscription_refused("forbidden", text)
    assert here.inbound.subscription_problems == {"/a is not yours": "forbidden", "/b is not yours": "forbidden"}
    assert len(caplog.records) == 3


async def test_what_was_lost_on_its_way_here_is_said(caplog: pytest.LogCaptureFixture) -> None:
    here = Here()
    opened = here.opened(POSE)
    here.bridge.expired(opened, 3, DropReason.LIFESPAN)
    here.bridge.skipped(opened, 5)
    here.bridge.undecodable(opened, "no zstd")
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == [
        "/robot/pose: reliable message 3 was dropped on its way: lifespan",
        "/robot/pose: 5 reliable messages were given up while we were away",
        "/robot/pose from robot cannot be decoded and is dropped: no zstd",
    ]


# Consistency ----------------------------------------------------------------------------------------------------------


async def test_what_the_core_does_not_have_open_shows() -> None:
    here = Here()
    here.opened(POSE)
    tables = Tables(here.bridge)
    assert tables.validate() == [Difference(POSE, "a stream of robot is open in the bridge only")]
    assert dict(here.endpoint.held.publishers) == {POSE: 1}
    here.endpoint.differences = [Difference(TopicName(""), "the master does not answer")]
    assert len(tables.validate()) == 2


async def test_a_publisher_is_opened_anew_and_one_that_cannot_be_hinders_no_other(
    caplog: pytest.LogCaptureFixture,
) -> None:
    here = Here()
    opened = [here.opened(POSE), here.opened("/robot/odom")]
    before = list(here.endpoint.publishers)
    here.endpoint.refusals[POSE] = ConfigError("its type has changed")
    Tables(here.bridge).repair([Difference(each.id.topic, "is not open there", "publisher") for each in opened])
    assert all(publisher.closed for publisher in before) and here.publisher.info.name == "/robot/odom"
    here.message(opened[1], b"again")
    assert here.publisher.bodies == [b"again"]
    assert "/robot/pose cannot be published again: its type has changed" in caplog.text


# The link -------------------------------------------------------------------------------------------------------------


async def test_the_daemon_is_told_of_the_link(caplog: pytest.LogCaptureFixture) -> None:
    here = Here()
    caplog.set_level(logging.INFO)
    here.bridge.lane_offered({"t": "lane"})
    here.bridge.lane_closed()
    for _ in range(2):
        here.bridge.rejected("unknown_client", "no such client")
    reasons = [here.bridge.rejected_reason]
    assert caplog.text.count("the relay refuses us") == 1
    here.bridge.link_up(resumed=True)
    here.bridge.link_down("it was lost")
    reasons.append(here.bridge.rejected_reason)
    assert reasons == ["no such client", None] and "connected to relay again" in caplog.text
    assert here.shell.said == ["lane offered: lane", "lane closed", "up", "down: it was lost"]
