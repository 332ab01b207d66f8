"""Two relays that do not know of each other, as processes with keys, and a robot and a site that go from one to the
other when it is killed or stands still, and back."""

import json
import logging
import signal
from pathlib import Path
from typing import Any

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from rosbags.typesys import Stores, get_typestore

from sern_client.daemon import ClientDaemon
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.keys import PublicKey, PublicKeys, write_public
from sern_runtime.metrics import Metrics
from sern_tools.harness.files import relay_content, write
from sern_tools.keygen import write_pair
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab, Process, bodies, delivered
from tests.support import until

ROBOT: dict[str, Any] = {
    "kind": "synthetic", "role": "robot", "topics": ["/pose"], "patrol": True, "counter_topics": ["/log"],
}  # fmt: skip
RULES = [
    {"match": "/pose", "class": "control", "lifespan_s": 0.5},
    {"match": "/log", "class": "state", "reliability": "reliable"},
]
POSE, LOG = "/robot1/pose", "/robot1/log"
A, B = 0, 1


class TwoRelays:
    """Files and keys of two relays, and of clients that go to either."""

    def __init__(self, lab: Lab, directory: Path, *, failover_s: float = 2.0, return_s: float = 3600.0) -> None:
        self.lab = lab
        self.directory = directory
        self.failover = {"failover_s": failover_s, "return_s": return_s}
        self.addresses = [f"tcp://{HOST}:{port}" for port in free_ports(2)]
        self.files = []
        for number, address in enumerate(self.addresses, 1):
            name = f"relay{number}"
            write_pair(ClientName(name), directory, directory, replace=True)
            own = {"name": name, "secret_key_file": f"{name}.key"}
            http = {"listen": f"{HOST}:{free_ports(1)[0]}"}
            self.files.append(write(directory, name, relay_content(address, relay=own, http=http)))

    async def start(self, which: int) -> Process:
        return await self.lab.process(self.files[which]).ready()

    def of_client(self, file: Path, **keys: dict[str, str]) -> Path:
        """The client's file with a list in place of its relay; `keys` replace keys of relay1 or relay2."""
        content = json.loads(file.read_text())
        relay = content.pop("relay")
        content["relays"] = [
            {**relay, "endpoint": address, "server_key_file": f"relay{number}.pub", **keys.get(f"relay{number}", {})}
            for number, address in enumerate(self.addresses, 1)
        ]
        content["failover"] = self.failover
        return write(self.directory, file.stem, content)

    def robot_file(self, **keys: dict[str, str]) -> Path:
        return self.of_client(self.lab.client_file("robot1", ROBOT, topics=RULES), **keys)

    def site_file(self) -> Path:
        return self.of_client(self.lab.recorder_file("site", "/robot1/.*"))


def at(client: ClientDaemon, which: int) -> bool:
    return client.core.link.established and client.relays.choice.at == which


async def arrive(which: int, *clients: ClientDaemon) -> None:
    await until(lambda: all(at(client, which) for client in clients), f"all are at relay {which + 1}")


async def more(site: ClientDaemon, count: int = 5) -> None:
    """So many more messages arrive, of the numbered stream and of poses."""
    for topic in (LOG, POSE):
        least = delivered(site, topic) + count
        await until(lambda topic=topic, least=least: delivered(site, topic) >= least, f"more of {topic}")  # type: ignore[misc]


def numbers(bag: Path) -> list[int]:
    """The numbers of the messages of the numbered stream, as they were recorded."""
    store = get_typestore(Stores.ROS1_NOETIC)
    texts = [store.deserialize_ros1(body, "std_msgs/msg/String") for body in bodies(bag)[LOG]]
    return [int(text.data.rpartition(" ")[2]) for text in texts]  # type: ignore[attr-defined]


def known(relay: Process) -> set[str]:
    """Of whom a relay keeps something."""
    return {row["name"] for row in relay.json("/api/clients")["clients"] if row["state"] != "forgotten"}


def why(client: ClientDaemon, which: int) -> str:
    """Why a relay does not answer, as /api/link has it."""
    view: Any = client.views.link()["relay"]
    return str(view["relays"][which]["why"])


def registry_of(client: ClientDaemon) -> CollectorRegistry:
    """The metrics of its relays."""
    registry = CollectorRegistry()
    client.relays.register(Metrics(registry))
    return registry


def moves(client: ClientDaemon, which: int, reason: str) -> int:
    return client.relays.moves[client.relays.entries[which].address, reason]


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
async def test_robot_and_site_meet_at_the_other_relay_and_come_back(
    tmp_path: Path, how: signal.Signals, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab, tmp_path, return_s=1.0)
        first, second = await two.start(A), await two.start(B)
        site = await lab.client(two.site_file())
        robot = await lab.client(two.robot_file())
        await arrive(A, site, robot)
        await more(site)
        first.signal(how)
        await arrive(B, site, robot)
        await more(site)
        for client in (robot, site):
            assert moves(client, B, "silent") >= 1
            view = client.views.link()["relay"]
            assert isinstance(view, dict) and view["name"] == "relay2" and view["address"] == two.addresses[B]
            assert view["preferred"] is False and view["moves"] >= 1
        if how is signal.SIGKILL:
            await first.ended()
            first = await two.start(A)
        else:
            first.signal(signal.SIGCONT)
        await arrive(A, site, robot)
        await more(site)
        returns = [moves(client, A, "return") + moves(client, A, "follow") for client in (robot, site)]
        assert min(returns) >= 1
        await until(lambda: known(second) == set(), "the relay that was left cleanly has forgotten them")
        await until(lambda: known(first) == {"robot1", "site"})
        await lab.end(robot)
        await lab.end(site)
    came = numbers(tmp_path / "site.bag")
    assert came == list(range(1, len(came) + 1)) and len(came) > 15
    said = [record.getMessage() for record in caplog.records if "moved from relay" in record.getMessage()]
    there = f"moved from relay {two.addresses[A]} (relay1) to {two.addresses[B]} (relay2): "
    back = f"moved from relay {two.addresses[B]} (relay2) to {two.addresses[A]} (relay1): that one "
    assert all(any(line.startswith(words) for line in said) for words in (there, back)), said


async def test_a_relay_with_another_key_is_left_out_and_that_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab, tmp_path, failover_s=0.5)
        write_public(
            tmp_path / "wrong.pub",
            PublicKeys(ClientName("relay1"), (PublicKey(lab.make_keys("stranger").public_key),)),
        )
        await two.start(A)
        await two.start(B)
        robot = await lab.client(two.robot_file(relay1={"server_key_file": "wrong.pub"}))
        await arrive(B, robot)
        said = [record.getMessage() for record in caplog.records if "its key is not the one" in record.getMessage()]
        metrics = generate_latest(registry_of(robot)).decode()
        row = 'sern_client_failovers_total{reason="%s",relay="%s"} %s'
        for reason, which, count in (("silent", B, "1.0"), ("silent", A, "0.0"), ("return", A, "0.0")):
            assert row % (reason, two.addresses[which], count) in metrics
        assert [f'sern_client_at_relay{{relay="{two.addresses[which]}"}} {which}.0' in metrics for which in (A, B)] == [
            True
        ] * 2
        assert said and len(said) == len(set(said)), "a reason is said once, however often it is tried"
        await until(lambda: "its key is not the one" in why(robot, A), "it is asked again, and refused")
        assert robot.relays.choice.answering_s(A, robot.core.link.now) is None
        await lab.end(robot)


async def test_when_all_are_away_it_says_which_were_tried_and_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        two = TwoRelays(lab, tmp_path, failover_s=0.5)
        robot = await lab.client(two.robot_file())

        def said() -> list[str]:
            return [record.getMessage() for record in caplog.records if "no relay answers" in record.getMessage()]

        await until(said)
        assert all(address in said()[0] for address in two.addresses)
        health = robot.readiness()
        assert not health.ok and "; tried " in health.reason and all(each in health.reason for each in two.addresses)
        for which in (A, B, A):
            await until(lambda which=which: robot.relays.choice.at == which, "it goes round")  # type: ignore[misc]
        assert len(said()) == 1 and not robot.relays.moves
        await two.start(B)
        await arrive(B, robot)
        await lab.end(robot)


async def test_keys_that_are_read_anew_hold_for_every_relay(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        two = TwoRelays(lab, tmp_path)
        first, second = await two.start(A), await two.start(B)
        robot = await lab.client(two.robot_file())
        await arrive(A, robot)
        new = write_pair(ClientName("relay2"), tmp_path, tmp_path, replace=True)
        second.signal(signal.SIGHUP)
        robot.reload()
        keyring = robot.relays.entries[B].keyring
        assert keyring is not None and keyring.server_keys == (new.public_key,)
        first.kill()
        await arrive(B, robot)
        await lab.end(robot)
