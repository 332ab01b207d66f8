"""Goals of ROS 2 over DDS for a server of ROS 1 at the robot: its clients speak as rmw_cyclonedds does."""

import struct
from pathlib import Path

from sern_client.action_conversion.bodies import ros2_statuses, split_statuses
from tests.daemons import HOST, Lab
from tests.peers.dds.conftest import MakePeer
from tests.peers.dds.test_actions import OTHER, REFUSED, UUID, Side, _dds, _heard
from tests.peers.ros1.lab import RosLab, need
from tests.peers.ros1.test_action_conversion import ACTIONLIB, SERVER
from tests.support import DEADLINE_S, until

SEQUENCE = struct.pack("<I7i", 7, 0, 1, 1, 2, 3, 5, 8)


async def test_a_goal_its_result_and_its_cancelling(tmp_path: Path, domain: int, make_peer: MakePeer) -> None:
    """The type is known here, so nobody has to name its files."""
    need(ACTIONLIB)
    manual = {"mode": "manual"}
    client = Side(await make_peer(domain), "robot1/fibonacci", serves=False)
    async with RosLab(tmp_path, "robot_ros") as ros, Lab(tmp_path, "robot1", "site") as lab:
        await lab.process(lab.relay_file()).ready()
        ros1 = {"kind": "ros1", "master_uri": ros.uri, "host": HOST}
        offer = {"offer": [{"match": "/fibonacci", "timeout_s": DEADLINE_S}]}
        await lab.connected(lab.client_file("robot1", ros1, discovery=manual, actions=offer))
        use = {"use": [{"match": "/robot1/fibonacci", "timeout_s": DEADLINE_S}]}
        site = await lab.connected(
            lab.client_file("site", _dds(domain), client={"namespace": "/"}, discovery=manual, actions=use)
        )
        await client.open()
        ros.python("server", SERVER.replace("test_msgs", "example_interfaces"))
        await client.matched()
        await _heard(site)
        for what in ("feedback", "status"):
            await client.peer.line(f"matched {what} 1")

        await client.call("send_goal", 1, UUID + struct.pack("<i", 5))
        assert (await client.reply("send_goal", 1))[0] == 1
        await client.call("get_result", 2, UUID)
        assert (await client.reply("get_result", 2)) == struct.pack("<b3x", 4) + SEQUENCE
        await client.call("send_goal", 3, OTHER + struct.pack("<i", -2))
        assert await client.reply("send_goal", 3, 1) == REFUSED

        await client.call("send_goal", 4, OTHER + struct.pack("<i", 100))
        assert (await client.reply("send_goal", 4, 2))[0] == 1
        await client.call("get_result", 5, OTHER)
        await client.call("cancel_goal", 6, OTHER + bytes(8))
        assert (await client.reply("cancel_goal", 6))[:24] == struct.pack("<b3xI", 0, 1) + OTHER
        assert await client.reply("get_result", 5, 1) == struct.pack("<b3x", 5) + SEQUENCE
        assert ["cancelled", 100] in ros.lines("server")

        def statuses() -> dict[bytes, int]:
            return dict(split_statuses((client.peer.got("status") or [ros2_statuses([])])[-1]))

        await until(lambda: statuses() == {UUID: 4, OTHER: 5}, "the status says how both have ended")
