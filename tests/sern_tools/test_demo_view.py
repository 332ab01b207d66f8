"""`sern demo --view` keeps running for a viewer, says what comes because of it, and ends with Ctrl-C."""

import re
import signal
from pathlib import Path

import pytest

pytest.importorskip("foxglove", reason="the foxglove endpoint needs foxglove-sdk: pip install foxglove-sdk")
pytest.importorskip("websockets", reason="viewers of the tests need websockets: pip install websockets")

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_tools.demo import EXIT_ERROR, EXIT_INTERRUPTED
from tests.sern_tools.test_demo_run import Started
from tests.viewers import viewer

ODOM, TWIN = "/robot/odometry/filtered", "/twin/robot/odom"


async def test_a_viewer_sees_robot_and_twin_until_ctrl_c(tmp_path: Path) -> None:
    demo = Started(tmp_path)
    try:
        await demo.start("--profile", "quick", "--view", "foxglove", "--out", "result")
        process = await demo.reaches("comes to the site: nothing, for nobody looks", processes=4)
        address = re.search(r"Foxglove WebSocket, ws://127\.0\.0\.1:(\d+)", demo.output)
        assert address is not None, demo.output
        async with viewer(int(address[1])) as person:
            await person.look(ODOM, TWIN)
            for topic in (ODOM, TWIN):
                (body, *_) = await person.got_of(topic, 3)
                assert ros_types.deserialise(body, "nav_msgs/msg/Odometry", Encoding.CDR).header.frame_id
            await demo.reaches(f"comes to the site: {ODOM}")
        process.send_signal(signal.SIGINT)
        assert await demo.ended() == EXIT_INTERRUPTED
        demo.assert_nothing_left()
    finally:
        await demo.clean_up()
    assert "Traceback" not in demo.output


async def test_another_view_is_one_line(tmp_path: Path) -> None:
    demo = Started(tmp_path)
    await demo.start("--profile", "quick", "--view", "hologram")
    assert await demo.ended() == EXIT_ERROR
    assert demo.output.strip() == "sern demo: --view hologram: there is a view for foxglove"
    demo.assert_nothing_left()
