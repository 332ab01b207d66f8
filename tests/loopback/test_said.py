"""What the daemons say to their operator: in the log, in /readyz and in the status, and that it is so."""

import signal
import socket
from pathlib import Path
from typing import Any

import pytest
import zmq

from sern_client import relay_name
from sern_client.link_news import SILENT
from sern_client.relay_name import UnresolvedError
from sern_core.link.handshake import NEW_SESSION
from sern_core.path.lanes import LANE_UDP
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock
from sern_runtime.transport_watch import WAITING
from sern_runtime.zmq_setup import make_client
from tests.daemons import Lab, topics_out, write_bag
from tests.loopback.test_http_api import get
from tests.support import until

ROBOT = {"kind": "synthetic", "role": "robot", "topics": 1}
CHAT = ({"match": "/chat", "class": "state", "reliability": "reliable"},)


async def test_a_topic_that_no_rule_names_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    bag = write_bag(tmp_path / "a.bag", {"/chat": 3, "/chta": 3, "/denied": 3})
    discovery = {"mode": "manual", "deny": ["/denied"]}
    async with Lab(tmp_path, "robot1") as lab:
        await lab.relay()
        play = {"loop": True, "wait_for": []}
        robot = await lab.connected(lab.player_file("robot1", bag, play=play, topics=list(CHAT), discovery=discovery))
        again = TopicInfo(TopicName("/chta"), "std_msgs/msg/String", Encoding.ROS1)
        robot.bridge.outbound.topic_removed(again.name)  # a node that comes and goes is no news
        robot.bridge.outbound.topic_added(again)
        said = [message for message in caplog.messages if "stays here" in message]
        assert said == ["/chta (std_msgs/msg/String) stays here: no rule in `topics` names it (discovery.mode: manual)"]


async def test_a_relay_that_does_not_resolve_is_said_at_once_and_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(relay_name, "ASK_AGAIN_S", 0.0)
    monkeypatch.setattr(relay_name, "SAY_AGAIN_S", (0.0, 0.0))

    async def unknown(_host: str, _port: int) -> str:
        raise UnresolvedError("name or service not known")

    monkeypatch.setattr(relay_name, "resolve", unknown)
    async with Lab(tmp_path, "robot1") as lab:
        config = lab.client_file("robot1", ROBOT, relay={"endpoint": f"tcp://relay.example:{lab.port}"})
        robot = await lab.client(config)
        await until(lambda: sum("does not resolve" in message for message in caplog.messages) >= 3, "says it again")
        first, second = [message for message in caplog.messages if "does not resolve" in message][:2]
        text = "the relay's name relay.example does not resolve: "
        assert first.startswith(f"tcp://relay.example:{lab.port}: {text}")
        assert first.endswith("; trying again until it does")
        assert " s now" in second
        assert robot.readiness().reason.startswith(text)
        assert robot.connection.name is not None

        async def resolves(_host: str, _port: int) -> str:
            return "192.0.2.1"

        monkeypatch.setattr(relay_name, "resolve", resolves)
        again = "relay.example resolves again, to 192.0.2.1, after"
        await until(lambda: any(again in message for message in caplog.messages))
        assert robot.readiness().reason.endswith(" (relay.example is 192.0.2.1)")


async def test_why_a_name_does_not_resolve() -> None:
    assert await relay_name.resolve("localhost", 5555) == "127.0.0.1"
    for name in ("::1", "no..host"):  # no IPv4 address, and no name: nobody else is asked
        with pytest.raises(UnresolvedError) as why:
            await relay_name.resolve(name, 5555)
        assert str(why.value) and "\n" not in str(why.value)


def test_only_names_are_looked_up() -> None:
    assert relay_name.name_in("tcp://relay.example:5555") == ("relay.example", 5555)
    for endpoint in ("tcp://127.0.0.1:5555", "tcp://[::1]:5555", "ipc:///run/sern"):
        assert relay_name.name_in(endpoint) is None


async def test_two_processes_with_one_name_are_told_of_each_other(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay()
        first = await lab.connected(lab.client_file("robot1", ROBOT))
        second = await lab.connected(lab.client_file("robot1", ROBOT))
        said = "another process connected as robot1 from 127.0.0.1:"
        for daemon in (first, second):
            await until(lambda daemon=daemon: daemon.readiness().reason.startswith(said), "is displaced, and says so")  # type: ignore[misc]
            assert daemon.why() == daemon.readiness().reason
        # One line for each time that it is displaced, and one at the relay.
        await lab.end(second)
        await until(lambda: first.readiness().ok, "goes on alone")
        await until(lambda: len(relay.hub.relayed) == len(topics_out(first)) > 0, "has its topics again")
        assert first.bridge.outbound.refusals == 0
        own = [record for record in caplog.records if said in record.getMessage()]
        assert {record.name for record in own} == {"sern_client.link_news", "sern_relay.comings"}
        at_relay = [record for record in own if record.name == "sern_relay.comings"]
        assert relay.news.refusals["displaced"] == len(at_relay) >= 2
        assert at_relay[0].getMessage().endswith(" has no session any more")
        assert not any(record.levelname == "ERROR" for record in caplog.records)


async def test_a_recovery_is_said_like_the_loss(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay()
        robot = await lab.connected(lab.client_file("robot1", ROBOT, relay={"udp": False}))
        assert not [record for record in caplog.records if "again" in record.getMessage()]
        assert relay.transports.server is not None
        relay.transports.server.cut_client("robot1")
        await until(lambda: any("the link is there again, after " in message for message in caplog.messages))
        await until(lambda: any("robot1 connected again, after " in message for message in caplog.messages))
        lines = {record.getMessage().partition(", after")[0]: record.levelname for record in caplog.records}
        assert lines[f"{lab.endpoint}: the connection to the relay was lost; trying again until it works"] == "WARNING"
        assert lines[f"{lab.endpoint}: the link is there again"] == "WARNING"
        await lab.end(robot)


async def test_an_outage_that_began_with_silence_is_counted_from_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A relay that hangs: first no answer in a session that waits, and then the connection is given up."""
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay()
        robot = await lab.connected(lab.client_file("robot1", ROBOT, relay={"udp": False}))
        assert relay.transports.server is not None
        monkeypatch.setattr(robot.news, "look", lambda: None)  # would find that the relay answers, until it is cut off
        robot.news.outages.look("relay", lost=True, gone="silent", back="back", now=clock.now() - 100.0)
        relay.transports.server.cut_client("robot1")
        said = f"{lab.endpoint}: the link is there again, after "
        await until(lambda: any(message.startswith(said) for message in caplog.messages))
        (text,) = [message for message in caplog.messages if message.startswith(said)]
        assert int(text.removeprefix(said).removesuffix(" s")) >= 100


async def test_a_relay_that_goes_on_with_no_session_is_said_in_words(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        await lab.relay()
        robot = await lab.connected(lab.client_file("robot1", ROBOT))
        robot.link_down(NEW_SESSION)
        assert caplog.messages[-1] == f"{lab.endpoint}: the session could not go on, and another begins"


async def test_a_relay_that_hangs_is_not_said_to_be_there(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        robot = await lab.process(lab.client_file("robot1", ROBOT)).ready()
        await robot.until(lambda: robot.json("/api/link")[0]["lane"] == "udp", "uses datagrams")
        relay.signal(signal.SIGSTOP)
        await robot.until(lambda: robot.get("/readyz") == (503, f"{SILENT}\n"), "says that it does not answer")
        await robot.said("WARNING", f"{lab.endpoint}: {SILENT}")
        relay.signal(signal.SIGCONT)
        await robot.until(lambda: robot.get("/readyz")[0] == 200, "has it again")
        ends = ("the relay answers again, after ", "the link is there again, after ")  # if the session did not last
        await robot.until(lambda: any(end in line for line in robot.lines for end in ends), "says that it is back")
        assert not any("no datagram gets through" in line for line in robot.lines), robot.text  # nothing got through


async def test_a_session_that_outlives_its_connection_says_that_there_is_another(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay()
        robot = await lab.connected(lab.client_file("robot1", ROBOT))
        await until(lambda: robot.core.link.lane.id == LANE_UDP, "data goes over UDP")
        assert relay.transports.server is not None
        assert relay.transports.server.connections.cut_user("robot1") >= 1
        await until(lambda: any("the connection is there again, after " in message for message in caplog.messages))
        assert not any("the link is there again" in message for message in caplog.messages)  # it was never gone
        assert robot.news.said == set()


async def test_a_reload_that_fails_twice_says_what_is_wrong_now_until_one_works(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay()
        good = relay.loaded.path.read_text()
        for number, bad in enumerate((good.replace('"access"', '"acces"'), good.replace('"clients"', '"nobody"')), 1):
            relay.loaded.path.write_text(bad)
            relay.reload()
            assert relay.reloads.failures == number
        assert relay._status().endswith(f"relay.clients_dir: {tmp_path}/nobody: no such directory")
        assert "acces:" not in relay._status()
        assert "\nsern_relay_reload_failed 1.0\n" in (await get(relay, "/metrics"))[1]
        status, line = await get(relay, "/readyz")
        assert status == 200 and line.startswith("listening; reload failed, the old configuration stays: ")
        failed = [record for record in caplog.records if "reload failed, the old configuration stays" in record.message]
        assert [record.levelname for record in failed] == ["ERROR", "ERROR"]
        relay.loaded.path.write_text(good)
        relay.reload()
        assert relay._status() == "0 clients, 0 streams"
        assert "\nsern_relay_reload_failed 0.0\n" in (await get(relay, "/metrics"))[1]
        assert await get(relay, "/readyz") == (200, "listening\n")
        assert sum("the reload works again" in message for message in caplog.messages) == 1


async def test_before_anything_has_come_back_nothing_else_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        with socket.create_server(("127.0.0.1", lab.port)):  # as a relay that was stopped: the kernel takes connections
            robot = await lab.client(lab.client_file("robot1", ROBOT))
            await until(lambda: robot.readiness().reason == WAITING, "has a connection")
            assert not [record for record in caplog.records if record.levelname == "WARNING"]
            await lab.drop(robot)


async def test_a_client_waits_for_the_handshake_as_long_as_its_file_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[zmq.Socket[bytes]] = []

    def making(*args: Any, **options: Any) -> "zmq.Socket[bytes]":
        made.append(make_client(*args, **options))
        return made[-1]

    monkeypatch.setattr("sern_client.transport.make_client", making)
    async with Lab(tmp_path, "robot1") as lab:
        await lab.relay()
        await lab.connected(lab.client_file("robot1", ROBOT, relay={"handshake_interval_s": 60}))
        assert [socket.getsockopt(zmq.HANDSHAKE_IVL) for socket in made] == [60_000] * len(made) != []
