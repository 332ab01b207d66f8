"""Actions of ROS 2 across the link over zenoh: three services and two hidden topics below `NAME/_action`.

Server and client are nodes of their own, each in the zenoh network of its site, that speak as rmw_zenoh does. Bodies
pass as they are, with the names and hashes of types that nobody on the way has a definition of.
"""

import asyncio
from pathlib import Path
from typing import Any, Final

import pytest

from sern_client.endpoints.base import ServiceInfo
from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from tests.daemons import Lab
from tests.peers.test_zenoh import Router
from tests.support import DEADLINE_S, Events, until

pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install eclipse-zenoh")

DOMAIN: Final = 9
TYPE: Final = "example_interfaces/action/Fibonacci"
PARTS: Final = {
    "send_goal": f"{TYPE}_SendGoal",
    "cancel_goal": "action_msgs/srv/CancelGoal",
    "get_result": f"{TYPE}_GetResult",
    "feedback": f"{TYPE}_FeedbackMessage",
    "status": "action_msgs/msg/GoalStatusArray",
}
HASHES: Final = {part: f"RIHS01_{number:064x}" for number, part in enumerate(PARTS, start=1)}
SERVICES: Final = ("send_goal", "cancel_goal", "get_result")


def name(action: str, part: str) -> TopicName:
    return TopicName(f"{action}/_action/{part}")


def topic(action: str, part: str) -> TopicInfo:
    latched = part == "status"
    return TopicInfo(name(action, part), PARTS[part], Encoding.CDR, HASHES[part], "", latched, True)


class Server:
    """A node that has the action `/fibonacci`. A goal ends with `release`, or when it is cancelled."""

    def __init__(self, router: Router) -> None:
        self.node = ZenohEndpoint(ZenohOptions(router.options, DOMAIN, "server", accept_bridged=True, enclave="/"))
        self.goals: list[bytes] = []
        self.cancelled: list[bytes] = []
        self.release = asyncio.Event()
        self.asked = asyncio.Event()

    async def start(self) -> None:
        await self.node.start(Events())
        for part, handler in zip(SERVICES, (self.send_goal, self.cancel_goal, self.get_result), strict=True):
            info = ServiceInfo(name("/fibonacci", part), PARTS[part], Encoding.CDR, HASHES[part])
            self.node.serve(info, handler)
        self.feedback = self.node.advertise(topic("/fibonacci", "feedback"))
        self.status = self.node.advertise(topic("/fibonacci", "status"))
        self.status.publish(b"\0\1\0\0none", 1)

    async def send_goal(self, request: bytes) -> bytes:
        self.goals.append(request)
        self.status.publish(b"\0\1\0\0executing", 2)
        return b"\0\1\0\0accepted"

    async def cancel_goal(self, request: bytes) -> bytes:
        self.cancelled.append(request)
        self.release.set()
        return b"\0\1\0\0cancelling"

    async def get_result(self, request: bytes) -> bytes:
        self.asked.set()
        await self.release.wait()
        return b"\0\1\0\0result of " + request[4:]


async def test_an_action_of_ros_2_across_the_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sern_runtime.config.client.SERVICE_TIMEOUT_S", DEADLINE_S)
    routers = [Router(), Router()]
    for router in routers:
        router.start()
    server = Server(routers[0])
    client, events = (
        ZenohEndpoint(ZenohOptions(routers[1].options, DOMAIN, "client", accept_bridged=True, enclave="/")),
        Events(),
    )
    client.watch_services(events)
    try:
        async with Lab(tmp_path, "robot1", "site") as lab:
            relay = lab.process(lab.relay_file())
            await relay.ready()
            manual = {"mode": "manual"}
            match = [{"match": "/fibonacci"}]
            robot = await lab.connected(
                lab.client_file("robot1", _section(routers[0]), discovery=manual, actions={"offer": match})
            )
            match = [{"match": "/robot1/fibonacci"}]
            site = await lab.connected(
                lab.client_file("site", _section(routers[1]), discovery=manual, actions={"use": match})
            )
            await server.start()
            await client.start(events)
            action = "/robot1/fibonacci"
            await until(lambda: set(events.services) == {name(action, part) for part in SERVICES}, "services")
            hidden = {name(action, part) for part in ("feedback", "status")}
            await until(lambda: hidden <= set(events.infos), "topics")
            for part in SERVICES:
                info = events.services[name(action, part)]
                assert (info.type_name, info.type_hash) == (PARTS[part], HASHES[part])
            for part in ("feedback", "status"):
                found = events.infos[name(action, part)]
                assert (found.type_name, found.type_hash) == (PARTS[part], HASHES[part])
            assert events.infos[name(action, "status")].latched

            got: dict[str, list[bytes]] = {"feedback": [], "status": []}
            for part, bodies in got.items():

                def take(body: bytes, _stamp_ns: int, bodies: list[bytes] = bodies) -> bool:
                    bodies.append(body)
                    return True

                client.subscribe(name(action, part), take)
            await until(lambda: got["status"], "who comes late gets the last status")
            answer = await client.call(name(action, "send_goal"), b"\0\1\0\0goal", timeout_s=DEADLINE_S)
            assert (answer, server.goals) == (b"\0\1\0\0accepted", [b"\0\1\0\0goal"])
            await until(lambda: got["status"][-1] == b"\0\1\0\0executing", "the status follows")

            async def heard() -> None:
                while not got["feedback"]:
                    server.feedback.publish(b"\0\1\0\0half", 3)
                    await asyncio.sleep(0.01)

            await asyncio.wait_for(heard(), DEADLINE_S)

            # The result is asked for, and the relay is replaced by another process before it is there.
            result = asyncio.ensure_future(client.call(name(action, "get_result"), b"\0\1\0\0goal", timeout_s=60))
            await asyncio.wait_for(server.asked.wait(), DEADLINE_S)
            relay.kill()
            await until(lambda: site.core.link.lane.stalled, "the link is lost")
            await lab.process(relay.config).ready()
            await until(lambda: robot.core.link.established and site.core.link.established, "both are back")
            answer = await client.call(name(action, "cancel_goal"), b"\0\1\0\0goal", timeout_s=DEADLINE_S)
            assert (answer, server.cancelled) == (b"\0\1\0\0cancelling", [b"\0\1\0\0goal"])
            assert await asyncio.wait_for(result, DEADLINE_S) == b"\0\1\0\0result of goal"
            assert len(server.goals) == 1
    finally:
        await client.stop()
        await server.node.stop()
        for router in routers:
            router.stop()


def _section(router: Router) -> dict[str, Any]:
    return {"kind": "zenoh", "connect": [router.locator], "listen": ["tcp/127.0.0.1:0"], "domain": DOMAIN}
