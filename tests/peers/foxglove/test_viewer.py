"""A viewer that is not ours (npm's @foxglove/ws-protocol, what Lichtblick speaks with) at the endpoint."""

import asyncio
import json
import os
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("foxglove", reason="the foxglove endpoint needs foxglove-sdk: pip install foxglove-sdk")
pytest.importorskip("websockets", reason="viewers of the tests need websockets: pip install websockets")

from sern_client.endpoints.base import ServiceInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from tests.support import LASTING, until
from tests.viewers import bridge, start_runtime

HERE = Path(__file__).resolve().parent
PLACE = Path(os.environ.get("SERN_FOXGLOVE_PEER") or HERE.parents[2] / ".venv-foxglove")
CHAT = ros_types.topic_info("/chat", "std_msgs/msg/String", Encoding.CDR)
TWIST = "geometry_msgs/msg/Twist"


@pytest.fixture(scope="module", autouse=True)
def peer(nothing_left_behind: None) -> None:
    """Skip where there is no node, or no such viewer."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed: its viewer cannot be run")
    made = subprocess.run([HERE / "setup"], capture_output=True, text=True, check=False)
    if made.returncode:
        pytest.skip(made.stderr.strip())
    if not LASTING:
        start_runtime()


class Peer:
    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.told: list[dict[str, Any]] = []
        self._process = process
        self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            self.told.append(json.loads(line))

    def order(self, what: str, **more: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": what, **more}).encode() + b"\n")

    def found(self, event: str, **like: object) -> list[dict[str, Any]]:
        return [each for each in self.told if each["event"] == event and like.items() <= each.items()]

    async def of(self, event: str, **like: object) -> dict[str, Any]:
        """The first thing that it was told like this, once it was."""
        await until(lambda: self.found(event, **like), f"{event} {like}")
        return self.found(event, **like)[0]

    async def end(self) -> None:
        self.order("end")
        assert await self._process.wait() == 0
        await self._reading


@asynccontextmanager
async def viewer(port: int) -> AsyncIterator[Peer]:
    process = await asyncio.create_subprocess_exec(
        "node", str(HERE / "viewer.cjs"), f"ws://127.0.0.1:{port}/",
        env=os.environ | {"NODE_PATH": str(PLACE / "node_modules")},
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    peer = Peer(process)
    try:
        yield peer
        await peer.end()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def test_it_looks_publishes_and_calls() -> None:
    async def handler(request: bytes) -> bytes:
        return request[::-1]

    async with bridge(publish=True) as run, viewer(run.port) as peer:
        assert "clientPublish" in (await peer.of("info"))["capabilities"]
        run.endpoint.topic_offered(CHAT)
        channel = await peer.of("channel", topic="/chat")
        assert (channel["encoding"], channel["schemaName"], channel["schema"]) == (
            "cdr", "std_msgs/msg/String", CHAT.definition,
        )  # fmt: skip
        peer.order("subscribe", topic="/chat")
        await until(lambda: run.viewed.wants == [("/chat", True)])
        run.endpoint.advertise(CHAT).publish(b"\x00\x01text", 1)
        assert (await peer.of("message", topic="/chat"))["body"] == b"\x00\x01text".hex()

        peer.order("advertise", topic="/cmd_vel", type=TWIST)
        number = (await peer.of("advertised"))["channel"]
        await until(lambda: TopicName("/cmd_vel") in run.events.infos)
        got: list[bytes] = []

        def sink(body: bytes, stamp_ns: int) -> bool:
            got.append(body)
            return True

        run.endpoint.subscribe(TopicName("/cmd_vel"), sink)
        peer.order("publish", channel=number, body=b'{"linear": {"x": 0.25}}'.hex())
        await until(lambda: got)
        assert ros_types.deserialise(got[0], TWIST, Encoding.CDR).linear.x == 0.25

        info = ServiceInfo(TopicName("/lights"), "std_srvs/srv/SetBool", Encoding.CDR, "")
        run.endpoint.serve(info, handler)
        service = (await peer.of("service", name="/lights"))["id"]
        peer.order("call", service=service, call=5, encoding="cdr", body="0102")
        assert (await peer.of("answer", call=5))["body"] == "0201"

        peer.order("advertise", topic="/own", type="own_msgs/Thing")
        await until(lambda: len(peer.found("advertised")) == 2)
        assert not peer.found("status", id="sern/publish/own"), "viewers announce what nobody uses yet"
        peer.order("publish", channel=peer.found("advertised")[1]["channel"], body=b"{}".hex())
        told = await peer.of("status", id="sern/publish/own")
        assert told["level"] == 2 and "is unknown here" in told["text"]
        assert not peer.found("error")
