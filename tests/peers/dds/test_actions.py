"""Actions of ROS 2 over DDS across the link: three services and two topics below `NAME/_action`.

Server and client are Fast DDS with the messages that rmw_cyclonedds would send, each in the domain of its site. Client
and server are told what to write by the test, byte by byte: header of the call, id of the goal, and what is in it.
"""

import asyncio
import struct
from pathlib import Path
from typing import Any, Final

import pytest

from sern_client.daemon import ClientDaemon
from sern_client.endpoints.dds.endpoint import DdsEndpoint
from tests.daemons import Lab, endpoint_of
from tests.peers.dds.conftest import MakePeer
from tests.peers.dds.peer import LEASE_S, Peer
from tests.support import DEADLINE_S, until

HEAD: Final = b"\0\1\0\0"
UUID: Final = bytes(range(100, 116))
OTHER: Final = bytes(range(16))
SERVER_ID, CLIENT_ID = "userdata=serviceid=1.2.3;", "userdata=clientid=7.8;"
FIBONACCI: Final = "example_interfaces::action::dds_::Fibonacci"
SERVICES: Final = {
    "send_goal": f"{FIBONACCI}_SendGoal",
    "cancel_goal": "action_msgs::srv::dds_::CancelGoal",
    "get_result": f"{FIBONACCI}_GetResult",
}
FEEDBACK: Final = f"{FIBONACCI}_FeedbackMessage_"
STATUS: Final = "action_msgs::msg::dds_::GoalStatusArray_"
ACCEPTED: Final = struct.pack("<?3xiI", True, 5, 6)
REFUSED: Final = bytes(12)
RESULT: Final = struct.pack("<b3xI3i", 4, 3, 1, 1, 2)
CANCELLING: Final = struct.pack("<b3xI16siI", 0, 1, UUID, 5, 6)
HALF: Final = UUID + struct.pack("<I2i", 2, 1, 1)
EXECUTING: Final = struct.pack("<I16siIb", 1, UUID, 5, 6, 2)


class Side:
    """A peer as server or client of the action. `ids` of its readers and writers are the names of the parts."""

    def __init__(self, peer: Peer, action: str, *, serves: bool) -> None:
        self.peer = peer
        self._action = action
        self._serves = serves

    async def open(self) -> None:
        ident = SERVER_ID if self._serves else CLIENT_ID
        for part, kind in SERVICES.items():
            name = f"{self._action}/_action/{part}"
            there, back = ("sub", "pub") if self._serves else ("pub", "sub")
            await self.peer.do(f"{there} {part}-request rq/{name}Request {kind}_Request_ reliable {ident}")
            await self.peer.do(f"{back} {part}-reply rr/{name}Reply {kind}_Response_ reliable {ident}")
        topics = "pub" if self._serves else "sub"
        await self.peer.do(f"{topics} feedback rt/{self._action}/_action/feedback {FEEDBACK} reliable")
        latched = "reliable transient_local depth=1"
        await self.peer.do(f"{topics} status rt/{self._action}/_action/status {STATUS} {latched}")

    async def matched(self) -> None:
        """Until the other side's endpoint, which speaks for the far side, has found all of it."""
        for part in SERVICES:
            await self.peer.line(f"matched {part}-request 1")
            await self.peer.line(f"matched {part}-reply 1")

    async def call(self, part: str, number: int, body: bytes) -> None:
        await self.peer.do(f"write {part}-request {(HEAD + struct.pack('<Qq', 99, number) + body).hex()}")

    async def answer(self, part: str, request: bytes, body: bytes) -> None:
        """To a request as it came, whose header says to whom. Its reader may be found after its writer."""
        await self.peer.line(f"matched {part}-reply 1")
        await self.peer.do(f"write {part}-reply {(HEAD + request[4:20] + body).hex()}")

    async def got(self, what: str, number: int = 0) -> bytes:
        """The message of that number, once it is there."""
        return bytes.fromhex((await self.peer.line(f"got {what} ", number))[2])

    async def reply(self, part: str, call: int, number: int = 0) -> bytes:
        """The answer to one of our calls, without header."""
        body = await self.got(f"{part}-reply", number)
        assert struct.unpack_from("<Qq", body, 4) == (99, call)
        return body[20:]


def _dds(domain: int) -> dict[str, Any]:
    return {"kind": "dds", "domain": domain, "localhost_only": True, "lease_s": LEASE_S}


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls that are answered at once may take long on a busy machine, too."""
    monkeypatch.setattr("sern_runtime.config.client.SERVICE_TIMEOUT_S", DEADLINE_S)


async def _sites(lab: Lab, domain: int, other_domain: int, timeout_s: float) -> ClientDaemon:
    """The robot's client in `domain`, the site's in the other one; the site's is returned."""
    manual = {"mode": "manual"}
    offer = {"offer": [{"match": "/fibonacci", "timeout_s": timeout_s}]}
    await lab.connected(lab.client_file("robot1", _dds(domain), discovery=manual, actions=offer))
    use = {"use": [{"match": "/robot1/fibonacci", "timeout_s": timeout_s}]}
    return await lab.connected(
        lab.client_file("site", _dds(other_domain), client={"namespace": "/"}, discovery=manual, actions=use)
    )


async def _heard(site: ClientDaemon) -> None:
    """Until the site's endpoint has found the client: a request that comes before is lost, and not repeated, and so is
    an answer."""
    servers = endpoint_of(site, DdsEndpoint).services._servers
    await until(lambda: all(side is not None and side.matched == 1 for s in servers for side in (s.reader, s.writer)))


async def test_a_goal_from_the_site_to_the_robot_and_what_comes_back(
    tmp_path: Path, domain: int, other_domain: int, make_peer: MakePeer
) -> None:
    server = Side(await make_peer(domain), "fibonacci", serves=True)
    client = Side(await make_peer(other_domain), "robot1/fibonacci", serves=False)
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.process(lab.relay_file()).ready()
        site = await _sites(lab, domain, other_domain, 60)
        await server.open()
        await client.open()
        await client.matched()
        await _heard(site)
        for what in ("feedback", "status"):
            await client.peer.line(f"matched {what} 1")

        await client.call("send_goal", 1, UUID + struct.pack("<i", 7))
        request = await server.got("send_goal-request")
        assert request[20:] == UUID + struct.pack("<i", 7)
        await server.answer("send_goal", request, ACCEPTED)
        assert await client.reply("send_goal", 1) == ACCEPTED

        await client.call("get_result", 2, UUID)
        asked = await server.got("get_result-request")
        assert asked[20:] == UUID
        await server.peer.do(f"write status {(HEAD + EXECUTING).hex()}")
        assert (await client.got("status"))[4:][: len(EXECUTING)] == EXECUTING

        async def heard() -> bytes:
            while not client.peer.got("feedback"):
                await server.peer.do(f"write feedback {(HEAD + HALF).hex()}")
                await asyncio.sleep(0.01)
            return client.peer.got("feedback")[0]

        assert (await asyncio.wait_for(heard(), DEADLINE_S))[4:] == HALF
        await client.call("cancel_goal", 3, UUID + bytes(8))
        cancel = await server.got("cancel_goal-request")
        assert cancel[20:] == UUID + bytes(8)
        await server.answer("cancel_goal", cancel, CANCELLING)
        assert await client.reply("cancel_goal", 3) == CANCELLING
        await server.answer("get_result", asked, RESULT)
        assert await client.reply("get_result", 2) == RESULT


async def test_without_a_link_a_goal_is_refused_and_a_result_unknown(
    tmp_path: Path, domain: int, other_domain: int, make_peer: MakePeer
) -> None:
    server = Side(await make_peer(domain), "fibonacci", serves=True)
    client = Side(await make_peer(other_domain), "robot1/fibonacci", serves=False)
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = lab.process(lab.relay_file())
        await relay.ready()
        site = await _sites(lab, domain, other_domain, 8.0)
        await server.open()
        await client.open()
        await client.matched()
        await _heard(site)

        # Accepted, but its client hears nothing of it: the goal must not be executed behind its back.
        await client.call("send_goal", 1, UUID + struct.pack("<i", 7))
        await server.got("send_goal-request")
        relay.kill()
        await until(lambda: site.core.link.lane.stalled, "the link is lost")
        assert await client.reply("send_goal", 1) == REFUSED
        await client.call("send_goal", 2, OTHER + struct.pack("<i", 8))
        await client.call("get_result", 3, UUID)
        await client.call("cancel_goal", 4, UUID + bytes(8))
        assert await client.reply("send_goal", 2, 1) == REFUSED
        assert await client.reply("get_result", 3) == bytes(8)  # STATUS_UNKNOWN, nothing in it
        assert (await client.reply("cancel_goal", 4))[:8] == b"\1" + bytes(7)  # ERROR_REJECTED
        await lab.process(relay.config).ready()

        def cancelled() -> set[bytes]:
            return {body[20:36] for body in server.peer.got("cancel_goal-request")}

        await until(lambda: UUID in cancelled(), "the goal that may be under way is cancelled")
        assert len(server.peer.got("send_goal-request")) == 1
