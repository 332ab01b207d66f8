"""Machines whose clocks stand still: nobody gets a command too late, whoever was paused, for however long.

A clock that goes on in suspend (`sern_runtime.clock`) leaves what no clock of the machine itself shows: a virtual
machine that is paused from outside. Here its node does not run, its clock stands still, and what is sent to it waits.
"""

from collections import deque
from collections.abc import Iterator
from random import Random
from typing import Final, NamedTuple

import pytest

from sern_core.link.link import Link
from sern_core.relay.hub_port import HubPort
from sern_core.vocabulary.message import Message, StreamInfo, TopicInfo
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import DropReason, Encoding, PriorityClass, TopicName
from tests.world import Clock, SimClient, World, spec

LIFESPAN_S: Final = 0.3
STEP_S: Final = 0.002
BEFORE_S: Final = 2.5
AFTER_S: Final = 1.5
NODES: Final = ("op", "relay", "robot")


class Pause(NamedTuple):
    """`who` stands still for `for_s`; its path was gone for `away_s` before that, and what was sent waits."""

    who: str
    for_s: float
    away_s: float = 0.0
    phase_s: float = 0.0
    delay_s: float = 0.01
    lossless: bool = True
    offset_s: float = 0.0


class Way:
    """One direction of one connection: what is under way, in order."""

    def __init__(self) -> None:
        self.queue: deque[tuple[float, bytes]] = deque()


class Obeyed(NamedTuple):
    at_s: float
    given_s: float
    age_s: float


class Scene:
    """An operator that commands a robot at 20 Hz through a relay, and sees its pose at 50 Hz. True time is `t`."""

    def __init__(self, pause: Pause) -> None:
        self.pause = pause
        self.t = 0.0
        self.obeyed: list[Obeyed] = []
        world = World(lossless=pause.lossless)
        self.hub = world.relay.hub
        self.op = world._process("op", Clock(), SchedulerParams(), ["/robot/.*"])
        self.robot = world._process("robot", Clock(), SchedulerParams(), ["/op/.*"])
        self.robot.message = self._obey  # type: ignore[method-assign, assignment]
        self.ports = {"op": HubPort(self.hub, self.op.name), "robot": HubPort(self.hub, self.robot.name)}
        self.up = {name: Way() for name in self.ports}
        self.down = {name: Way() for name in self.ports}
        self.begins_s = BEFORE_S + pause.phase_s
        self.ends_s = self.begins_s + pause.for_s
        kind = spec(PriorityClass.CONTROL, lifespan_s=LIFESPAN_S)
        self.pose = self._publish(self.robot, "/robot/pose", kind)
        self.command = self._publish(self.op, "/op/cmd_vel", kind)
        for client in (self.op, self.robot):
            client.core.link.connected(now=self.local(client.name))

    def _publish(self, client: SimClient, name: str, kind: object) -> object:
        info = TopicInfo(TopicName(name), "a/b", Encoding.CDR)
        return client.core.publish(info, kind, now=self.local(client.name))  # type: ignore[arg-type]

    def _obey(self, _stream: StreamInfo, message: Message, *, now: float) -> None:
        self.obeyed.append(Obeyed(self.t, float(message.body), now - message.born_s))

    def local(self, name: str) -> float:
        """The clock of a node: another start for each, and it stands still in the node's pause."""
        start_s = self.pause.offset_s * (1 + NODES.index(name))
        if name != self.pause.who or self.t < self.begins_s:
            return start_s + self.t
        return start_s + (self.begins_s if self.t < self.ends_s else self.t - self.pause.for_s)

    def runs(self, name: str) -> bool:
        return name != self.pause.who or not self.begins_s <= self.t < self.ends_s

    def _read(self, way: Way, reader: str, link: Link | HubPort) -> None:
        """All that has arrived, before anything is said; nothing arrives while the path of who is paused is gone."""
        away = self.begins_s - self.pause.away_s <= self.t < self.ends_s
        while self.runs(reader) and not (away and self.pause.away_s) and way.queue and way.queue[0][0] <= self.t:
            link.receive(way.queue.popleft()[1], now=self.local(reader))

    def _say(self, port: Link | HubPort, speaker: str, way: Way) -> None:
        if not self.runs(speaker):
            return
        now = self.local(speaker)
        deadline_s = port.next_deadline()
        if deadline_s is not None and now >= deadline_s:
            port.handle_timeout(now=now)
        while (datagram := port.next_datagram(now=now)) is not None:
            way.queue.append((self.t + self.pause.delay_s, datagram))

    def turn(self, number: int) -> None:
        if number % 10 == 0 and self.runs("robot"):
            self.robot.core.send(self.pose, b"p", 0, now=self.local("robot"))  # type: ignore[arg-type]
        if number % 25 == 3 and self.runs("op"):
            self.op.core.send(self.command, b"%.4f" % self.t, 0, now=self.local("op"))  # type: ignore[arg-type]
        for client in (self.op, self.robot):
            name = str(client.name)
            self._read(self.up[name], "relay", self.ports[name])
            self._read(self.down[name], name, client.core.link)
            self._say(client.core.link, name, self.up[name])
        for name, port in self.ports.items():
            self._say(port, "relay", self.down[name])

    def play(self) -> "Scene":
        number = 0
        end_s = self.ends_s + AFTER_S
        while self.t < end_s:
            number += 1
            # A long pause is looked through in steps of a tick of the others.
            coarse = self.begins_s + 1.0 < self.t < self.ends_s - 0.3
            self.t += min(0.5, self.ends_s - 0.2 - self.t) if coarse else STEP_S
            self.turn(number * 100 + 3 if coarse else number)
        return self

    def check(self) -> None:
        late = [each for each in self.obeyed if each.at_s - each.given_s > LIFESPAN_S + STEP_S]
        assert not late, f"{self.pause}: {late[:3]}"
        assert [each for each in self.obeyed if each.at_s < self.begins_s - self.pause.away_s], "it obeyed before"
        assert [each for each in self.obeyed if each.at_s > self.ends_s + 1.0], "it obeys again"


def cases() -> Iterator[Pause]:
    random = Random(7)
    for who in NODES:
        for for_s in (0.1, 0.2, 0.35, 0.6, 1.0, 3.0, 60.0):
            # What the last receiver loses within half a second of silence nobody can tell it.
            away_s = 0.0 if who == "robot" and for_s < 0.6 else random.choice((0.0, 0.25, 1.0))
            delay_s, lossless = random.choice((0.002, 0.01, 0.04)), random.random() < 0.5
            yield Pause(who, for_s, away_s, random.random() / 10, delay_s, lossless, random.choice((0.0, 5000.0)))


@pytest.mark.parametrize("pause", tuple(cases()), ids=lambda pause: f"{pause.who}-{pause.for_s:g}-{pause.away_s:g}")
def test_no_command_is_obeyed_too_late_whoever_was_paused(pause: Pause) -> None:
    Scene(pause).play().check()


@pytest.mark.parametrize("who", NODES)
def test_nor_after_an_hour(who: str) -> None:
    Scene(Pause(who, 3600.0, 1.0, 0.02)).play().check()


def test_a_command_that_becomes_too_old_in_the_last_turn_is_not_obeyed() -> None:
    """The loop may be busy between the turn in which it arrives and the one in which it is handed on."""
    world = World()
    robot = world.client("robot", patterns=["/op/.*"])
    channel = world.client("op").publish("/op/cmd", spec(PriorityClass.CONTROL, lifespan_s=LIFESPAN_S))
    world.run(2.0)
    assert channel.wanted
    link, now = robot.core.link, robot.now
    stream = next(iter(link.taking.incoming.values()))
    for seq, age_s in ((1, 0.1), (2, LIFESPAN_S - 0.01)):
        link.taking._deliver(stream, Message(channel.stream.id, seq, b"go", 0, now - age_s))
    link.next_datagram(now=now + 0.02)
    assert [got.seq for got in robot.on("/op/cmd")] == [1]
    assert robot.core.received.topics[TopicName("/op/cmd")].by_reason[DropReason.LIFESPAN] == 1
