"""What takes long once is done before anybody is there to wait for it."""

import subprocess
import sys
from pathlib import Path

from tests.daemons import Lab

SCRIPT = """
import asyncio, sys
from pathlib import Path
from {package}.daemon import {daemon}
from sern_runtime.config.{role} import load_{role}
from sern_runtime.ros_types import typestore


async def main() -> None:
    daemon = {daemon}(load_{role}(Path(sys.argv[1])))
    try:
        await daemon.start()
        print(typestore.cache_info().currsize)
    finally:
        await daemon.stop()


asyncio.run(main())
"""


def loaded(file: Path, role: str, daemon: str) -> str:
    script = SCRIPT.format(package=f"sern_{role}", daemon=daemon, role=role)
    done = subprocess.run([sys.executable, "-c", script, file], capture_output=True, text=True, check=True)
    return done.stdout.strip()


async def test_daemons_know_the_ros_types_when_they_have_started(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        assert loaded(lab.relay_file(), "relay", "RelayDaemon") == "2"
        robot = lab.client_file("robot1", {"kind": "record", "path": "robot"})
        assert loaded(robot, "client", "ClientDaemon") == "2"
