"""Whatever address a relay has and a client knows it by: a session, its datagrams, and an end when it is revoked."""

from functools import partial
from pathlib import Path

import pytest

from sern_client.daemon import ClientDaemon
from sern_core.path.lanes import LANE_UDP
from sern_core.vocabulary.types import ClientName
from sern_relay.daemon import RelayDaemon
from sern_runtime.seal import offered_ciphers
from sern_tools.ports import free_ports
from tests.daemons import Lab
from tests.loopback.test_udp_client import SIX
from tests.support import until

DEAD_ENDS = {"kind": "synthetic", "role": "robot", "topics": 1}


async def datagrams_at(port: int, robot: ClientDaemon, relay: RelayDaemon) -> None:
    """Wait until the robot and the relay use datagrams, which go to `port` there."""
    name = ClientName(robot.loaded.model.client.name)
    link, lanes = relay.hub.links[name], relay.transports.lanes
    assert lanes is not None
    await until(lambda: name in lanes._lanes, f"{name} is offered a lane")
    session, _ = lanes._lanes[name]
    assert session.parameters.port == port
    both = (link, robot.core.link)
    await until(lambda: all(one.lane.id == LANE_UDP for one in both), f"{name} and the relay use datagrams")


def refused(robot: ClientDaemon) -> bool:
    return not robot.core.link.established and "refused our key" in robot.news.reason


@pytest.mark.parametrize(
    ("listen", "reached"),
    [
        pytest.param(["tcp://127.0.0.1:{0}"], ["tcp://127.0.0.1:{0}"], id="one address"),
        pytest.param(
            ["tcp://127.0.0.1:{0}", "tcp://0.0.0.0:{1}"],
            ["tcp://127.0.0.1:{1}", "tcp://127.0.0.1:{0}"],
            id="two ports",
        ),
        pytest.param(
            ["tcp://[::]:{0}"],
            ["tcp://127.0.0.1:{0}", "tcp://[::1]:{0}"],
            id="both families",
            marks=SIX,
        ),
        pytest.param(["tcp://*:{0}"], ["tcp://127.0.0.1:{0}"], id="every address"),
        pytest.param(["tcp://127.0.0.1:{0}"], ["tcp://localhost:{0}"], id="a name"),
        pytest.param(
            ["ipc://{path}/relay", "tcp://127.0.0.1:{0}"],
            ["ipc://{path}/relay", "tcp://127.0.0.1:{0}"],
            id="beside ipc",
        ),
        pytest.param(
            ["tcp://*:{0}"],
            ["tcp://[::1]:{0}"],
            id="every address, over IPv6",
            marks=SIX,
        ),
    ],
)
async def test_a_client_has_its_lanes_where_it_reaches_the_relay(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, listen: list[str], reached: list[str]
) -> None:
    """`listen` is the relay's; a client comes to each address of `reached`. Who comes by TCP is revoked."""
    caplog.set_level("INFO")
    ports = free_ports(2)
    endpoints = {f"robot{index}": address.format(*ports, path=tmp_path) for index, address in enumerate(reached)}
    async with Lab(tmp_path, *endpoints) as lab:
        there = [address.format(*ports, path=tmp_path) for address in listen]
        relay = await lab.relay(lab.relay_file(relay={"listen": there}))
        assert relay.transports.server is not None and relay.transports.lanes is not None
        revoked, stay = {}, {}
        for name, endpoint in endpoints.items():
            robot = await lab.connected(lab.client_file(name, DEAD_ENDS, relay={"endpoint": endpoint}))
            if endpoint.startswith("ipc://"):
                stay[name] = robot
                continue
            await datagrams_at(int(endpoint.rpartition(":")[2]), robot, relay)
            revoked[name] = robot
            home = "::1" if "[::1]" in endpoint else "127.0.0.1"
            assert f"{name} is reached over UDP at {home}" in caplog.messages
            connected = relay.transports.server.connections.handles_of(name)
            assert {(handle.local[0], handle.peer[0]) for handle in connected} == {(home, home)}
        assert relay.hub.links.keys() == endpoints.keys()
        assert relay.transports.lanes._lanes.keys() == revoked.keys()
        for name in revoked:
            (lab.clients_dir / f"{name}.pub").unlink()
        relay.reload()
        assert relay.hub.links.keys() == stay.keys() and not relay.transports.lanes._lanes
        for name, robot in revoked.items():
            await until(partial(refused, robot), f"{name} has no session, and knows why")
        for robot in stay.values():
            assert robot.core.link.established and LANE_UDP not in robot.core.link.lanes.by_id
        assert "::ffff:" not in caplog.text, "an IPv4 client is one in the logs"
        for robot in (*revoked.values(), *stay.values()):
            await lab.end(robot)
        await lab.end(relay)


async def test_a_lane_that_is_renewed_while_tcp_is_lost_keeps_its_port(tmp_path: Path) -> None:
    ports = free_ports(2)
    listen = [f"tcp://127.0.0.1:{port}" for port in ports]
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay(lab.relay_file(relay={"listen": listen}))
        robot = await lab.connected(lab.client_file("robot1", DEAD_ENDS, relay={"endpoint": listen[1]}))
        await datagrams_at(ports[1], robot, relay)
        name, lanes, server = ClientName("robot1"), relay.transports.lanes, relay.transports.server
        assert lanes is not None and server is not None
        session, _ = lanes._lanes[name]
        assert server.local_port(name) == ports[1]
        assert server.cut_client(name) == 1
        assert server.local_port(name) is None
        lanes._used_up(name, session)
        renewed, _ = lanes._lanes[name]
        assert renewed is not session and renewed.parameters.port == ports[1]
        for daemon in (robot, relay):
            await lab.end(daemon)


async def test_over_ipc_there_is_no_datagram_lane(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    endpoint = f"ipc://{tmp_path}/relay"
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay(lab.relay_file(relay={"listen": [endpoint]}))
        robot = await lab.connected(lab.client_file("robot1", DEAD_ENDS, relay={"endpoint": endpoint}))
        name, lanes = ClientName("robot1"), relay.transports.lanes
        assert lanes is not None and not lanes.server.ports
        assert robot.connection.lane is None, "it asks for none"
        lanes.asked(name, offered_ciphers())
        assert "robot1 gets no datagram lane: it has no TCP connection to this relay" in caplog.text
        for link in (relay.hub.links[name], robot.core.link):
            assert link.established and LANE_UDP not in link.lanes.by_id
        for daemon in (robot, relay):
            await lab.end(daemon)
