"""A recording over a scripted link, in virtual time, with the adaptation a client would run."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from sern_client.endpoints.clouds import CLOUD_TYPE, CloudSource
from sern_core.adaptation.adapter import SAMPLES, HopAdapter, Step
from sern_core.adaptation.report import step_json
from sern_core.bodies.codecs import Coder
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import RuleSet, TopicRule
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import Encoding, PriorityClass, TopicName
from sern_runtime import ros_types
from sern_runtime.config.adaptation import AdaptationSection
from sern_runtime.config.client import load_client
from sern_sim.profiles import LinkProfile
from sern_sim.replay import ReplayWorld

SETTLE_S: Final = 1.0
"""Before the first message: handshake and announcements."""
CONTROL_TYPES: Final = r".*/(Odometry|Imu|NavSatFix|JointState|TFMessage|Twist.*|Pose.*|Joy)"
STATE_TYPES: Final = r".*/(LaserScan|OccupancyGrid.*|Path|BatteryState|MarkerArray|DiagnosticArray)"
DEFAULT_RULES: Final = RuleSet(
    (
        TopicRule(compile_pattern(".*"), compile_pattern(CONTROL_TYPES), PriorityClass.CONTROL),
        TopicRule(compile_pattern(".*"), compile_pattern(STATE_TYPES), PriorityClass.STATE),
    )
)
"""Without a client's file: pose, motion and transforms are control, scans and maps state, all else bulk."""


@dataclass(frozen=True)
class Setup:
    """What a client's file says, or the defaults."""

    rules: RuleSet
    adaptation: AdaptationSection
    link: LinkParams
    scheduler: SchedulerParams

    @classmethod
    def of(cls, config: Path | None) -> "Setup":
        if config is None:
            return cls(DEFAULT_RULES, AdaptationSection(), LinkParams(), SchedulerParams())
        model = load_client(config).model
        section = model.adaptation or AdaptationSection()
        return cls(model.rules(), section, model.link.params(), model.scheduler.params())


@dataclass(frozen=True)
class Clouds:
    """Point clouds beside the recording."""

    files: tuple[Path, ...]
    rate_hz: float


@dataclass
class Replay:
    """What happened. `steps` are the intervals, `trace` why each topic's messages went or not."""

    steps: list[dict[str, Any]]
    trace: DecisionTrace
    topics: dict[str, dict[str, Any]]
    weights: dict[str, float]


@dataclass(frozen=True)
class _Recorded:
    at_s: float
    topic: str
    body: bytes


def _open(path: Path) -> Reader1 | Reader2:
    if not path.exists():
        raise ConfigError("no such file; give a .bag, a .mcap, a .db3 or a rosbag2 directory", file=str(path))
    try:
        reader: Reader1 | Reader2 = Reader1(path) if path.suffix == ".bag" else Reader2(path)
        reader.open()
    except Exception as error:  # a damaged file makes the readers raise almost anything
        raise ConfigError(f"cannot be read ({str(error).splitlines()[0]})", file=str(path)) from error
    return reader


def read_bag(path: Path, duration_s: float) -> tuple[dict[str, TopicInfo], list[_Recorded]]:
    """Topics and the messages of the first `duration_s`, times from the first message on."""
    reader = _open(path)
    try:
        ros1 = path.suffix == ".bag"
        infos: dict[str, TopicInfo] = {}
        for connection in reader.connections:
            name = "/" + connection.topic.lstrip("/")
            type_name = ros_types.canonical(connection.msgtype)
            infos[name] = TopicInfo(TopicName(name), type_name, Encoding.ROS1 if ros1 else Encoding.CDR)
        messages: list[_Recorded] = []
        first_ns: int | None = None
        for connection, time_ns, body in reader.messages():
            first_ns = time_ns if first_ns is None else first_ns
            at_s = (time_ns - first_ns) * 1e-9
            if at_s > duration_s:
                break
            messages.append(_Recorded(at_s, "/" + connection.topic.lstrip("/"), bytes(body)))
    finally:
        reader.close()
    if not messages:
        raise ConfigError("holds no message; nothing to replay", file=str(path))
    return infos, messages


def _with_clouds(messages: list[_Recorded], clouds: Clouds, duration_s: float) -> Iterator[_Recorded]:
    source = CloudSource(clouds.files, Encoding.ROS1)
    bodies = [source.next_body(0) for _ in clouds.files]
    times = np.arange(0.0, duration_s, 1.0 / clouds.rate_hz)
    added = [_Recorded(float(at_s), "/points", bodies[i % len(bodies)]) for i, at_s in enumerate(times)]
    yield from sorted([*messages, *added], key=lambda message: message.at_s)


def replay(
    bag: Path, profile: LinkProfile, setup: Setup, *, duration_s: float, clouds: Clouds | None, seed: int = 1
) -> Replay:
    """Run it. Raises ConfigError for a recording or a file that cannot be used."""
    infos, messages = read_bag(bag, duration_s)
    if clouds is not None:
        infos["/points"] = TopicInfo(TopicName("/points"), CLOUD_TYPE, Encoding.ROS1)
        messages = list(_with_clouds(messages, clouds, duration_s))
    trace = DecisionTrace()
    coder = Coder(max_bytes=setup.link.max_message_bytes, clock=time.perf_counter)
    world = ReplayWorld(profile, seed=seed, link=setup.link, scheduler=setup.scheduler, coder=coder, trace=trace)
    channels = {}
    for name, info in infos.items():
        spec: TopicSpec = setup.rules.resolve(info, local_name=info.name).spec
        channels[name] = world.publish(info, spec)
    params = setup.adaptation.params(encodes=True)
    policy = setup.adaptation.make_policy(encodes=True)()
    adapter = HopAdapter(world.robot.link, policy, params, coder=coder, now=world.network.now)
    steps: list[Step] = []
    world.every(params.interval_s / SAMPLES, lambda now: adapter.sample(now=now))
    world.every(params.interval_s, lambda now: steps.append(adapter.step(now=now)))
    world.feed((SETTLE_S + message.at_s, channels[message.topic], message.body) for message in messages)
    world.run(SETTLE_S + duration_s)
    start_s = world.network.start_s
    found = []
    for step in steps:
        told = step_json(step)
        told["at_s"] = round(step.now - start_s, 3)
        found.append(told)
    topics = {
        str(name): {
            "offered": counters.offered,
            "delivered": counters.delivered,
            "dropped": {str(reason): count for reason, count in counters.by_reason.items() if count},
        }
        for name, counters in world.robot.link.sender.ledger.topics.items()
    }
    if not steps:
        raise UsageError(f"--duration {duration_s:g} is shorter than one interval ({params.interval_s:g} s)")
    names = ("latency", "unreliability", "compute", "bandwidth")
    return Replay(found, trace, topics, dict(zip(names, params.weights, strict=True)))
