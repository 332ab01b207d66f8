"""Class control on connections of its own, between daemons: used without UDP, lost and made again, switched off."""

from pathlib import Path

import pytest

from sern_client.daemon import ClientDaemon
from sern_core.vocabulary.params import Redundancy
from sern_core.vocabulary.types import ClientName
from sern_relay.daemon import RelayDaemon
from sern_runtime.monitor import TcpHandle, TcpInfo
from sern_runtime.priority_paths import CONNECTIONS, MIN_SEGMENTS, PriorityPaths
from sern_runtime.zmq_socket import SendResult
from tests.daemons import Lab, bodies, delivered, under, write_bag
from tests.support import until

ROBOT = ClientName("robot1")
COMMANDS = [{"match": ".*", "class": "control", "reliability": "reliable"}]
STREAM = {"udp": False}
COUNT = 1000


def player(lab: Lab, bag: Path, **relay: object) -> Path:
    return lab.player_file("robot1", bag, play={"rate": 1}, topics=COMMANDS, relay={**STREAM, **relay})


def uses_priority_lane(robot: ClientDaemon, relay: RelayDaemon) -> bool:
    link = relay.hub.links.get(ROBOT)
    near = robot.core.link.lanes.priority_lane
    return near is not None and link is not None and link.lanes.priority_lane is not None


def joined(relay: RelayDaemon, client: str = ROBOT) -> list[int]:
    """File descriptors of the client's connections for class control."""
    assert relay.transports.server is not None
    return [each.fd for each in relay.transports.server.priority_lanes.joined if each.client == client]


@pytest.mark.parametrize("secure", [True, False], ids=["keys", "insecure"])
async def test_commands_arrive_over_it_whatever_becomes_of_its_connections(tmp_path: Path, secure: bool) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/go": COUNT})
    async with Lab(tmp_path, "robot1", "site", secure=secure) as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/.*", relay=STREAM))
        robot = await lab.client(player(lab, bag))
        await until(lambda: uses_priority_lane(robot, relay) and delivered(site) > 100, "class control goes there")
        assert len(joined(relay)) == CONNECTIONS
        server = relay.transports.server
        assert server is not None
        for fd in joined(relay):
            connection = server.connections.by_fd(fd)
            assert connection is not None and connection.handle is not None and connection.user == ROBOT
            connection.handle.cut()
        lanes = robot.core.link.lanes
        await until(lambda: joined(relay) == [] or lanes.priority_lane is None, "the connections are lost")
        await until(lambda: uses_priority_lane(robot, relay) and len(joined(relay)) == CONNECTIONS, "they come back")
        await until(lambda: delivered(site) == COUNT, "every command arrives")
        assert robot.core.link.established
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    assert bodies(tmp_path / "site.bag") == under("robot1", bodies(bag))


async def test_it_is_joined_again_after_a_restart_of_the_relay(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/go": COUNT})
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/.*", relay=STREAM))
        robot = await lab.client(player(lab, bag))
        await until(lambda: uses_priority_lane(robot, relay) and delivered(site) > 100)
        await lab.end(relay)
        relay = await lab.relay(tmp_path / "relay.yaml")
        await until(lambda: uses_priority_lane(robot, relay), "it joins the new session")
        await until(lambda: delivered(site) == COUNT, "every command arrives")
        for daemon in (robot, site, relay):
            await lab.end(daemon)
    assert bodies(tmp_path / "site.bag") == under("robot1", bodies(bag))


async def test_it_can_be_switched_off(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/go": 100})
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/.*", relay=STREAM))
        robot = await lab.client(player(lab, bag, priority_connections=False))
        await until(lambda: delivered(site) == 100 and joined(relay, "site"))
        assert joined(relay) == []
        for daemon in (robot, site, relay):
            await lab.end(daemon)


# --- the connections of one end --------------------------------------------------------------------------------------


class Counters(TcpHandle):
    """A connection of which the kernel has counted this."""

    sent = 0
    again = 0

    def info(self) -> TcpInfo:
        return TcpInfo(0.05, 0.0, 0.05, 0, 0, self.again, self.sent, 10, 0, 0)


class Paths:
    """Two connections that take everything unless told otherwise."""

    def __init__(self, redundancy: Redundancy) -> None:
        self.handles = {name: Counters(-1, 0, ("", 0), ("", 0)) for name in "ab"}
        self.answers = dict.fromkeys("ab", SendResult.OK)
        self.sent: list[str] = []
        self.spare = True
        self.paths: PriorityPaths[str] = PriorityPaths(redundancy, lambda nbytes: nbytes == 1 and self.spare)
        for name, handle in self.handles.items():
            self.paths.add(name, lambda _data, name=name: self._send(name), handle)  # type: ignore[misc]

    def _send(self, name: str) -> SendResult:
        if self.answers[name]:
            self.sent.append(name)
        return self.answers[name]

    def send(self) -> str:
        """Which of them took a datagram."""
        self.sent.clear()
        assert self.paths.send(b"x") is (SendResult.OK if self.sent else SendResult.FULL)
        return "".join(self.sent)


def test_one_carries_until_tcp_loses_then_both() -> None:
    paths = Paths(Redundancy.AUTO)
    assert paths.send() == "a"
    paths.handles["a"].sent = int(MIN_SEGMENTS) - 1
    paths.handles["a"].again = 1
    paths.paths.look()
    assert paths.send() == "a"  # too few to tell
    paths.handles["b"].sent = 200
    paths.handles["b"].again = 4
    paths.paths.look()
    assert paths.send() == "ab"
    for _ in range(40):
        for handle in paths.handles.values():
            handle.sent += 100
        paths.paths.look()
    assert paths.send() == "a"  # nothing was lost for long


@pytest.mark.parametrize(("redundancy", "taken"), [(Redundancy.ALWAYS, "ab"), (Redundancy.OFF, "a")])
def test_configuration_decides_about_copies(redundancy: Redundancy, taken: str) -> None:
    paths = Paths(redundancy)
    paths.handles["a"].sent, paths.handles["a"].again = 100, 50 if redundancy is Redundancy.OFF else 0
    paths.paths.look()
    assert paths.send() == taken


def test_a_full_link_has_no_room_for_copies() -> None:
    paths = Paths(Redundancy.ALWAYS)
    paths.spare = False
    assert paths.send() == "a"
    paths.answers["a"] = SendResult.FULL
    assert paths.send() == "b"  # which is no copy
    paths.spare = True
    paths.answers["a"] = SendResult.OK
    assert paths.send() == "ab"


def test_the_other_takes_what_the_first_does_not() -> None:
    paths = Paths(Redundancy.AUTO)
    paths.answers["a"] = SendResult.FULL
    assert paths.send() == "b"
    paths.answers["b"] = SendResult.GONE
    assert paths.send() == ""
    paths.paths.discard("a")
    paths.answers["b"] = SendResult.OK
    assert paths.send() == "b"
