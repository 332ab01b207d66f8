"""Robot and site in two networks without a route between them; the relay has an address in each."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemons import Lab, Process, balance, bodies, recording, under, write_bag

PORT = 5555
RELAY, ROBOT, SITE = "relay", "robot", "site"
NETWORKS = {ROBOT: "10.199.1", SITE: "10.199.2"}
TRY_TO_CONNECT = "import socket, sys; socket.create_connection((sys.argv[1], int(sys.argv[2])), 2)"
pytestmark = pytest.mark.root


def ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"ip {' '.join(words)}: {done.stderr.strip()}")


class Networks:
    """Three network namespaces of our own; nothing outside them is touched. Their names carry the process id."""

    def __init__(self) -> None:
        self.spaces = {who: f"sern-{os.getpid()}-{who}" for who in (RELAY, ROBOT, SITE)}
        self._made: list[str] = []

    def make(self) -> None:
        for space in self.spaces.values():
            ip("netns", "add", space)
            self._made.append(space)
            ip("-n", space, "link", "set", "lo", "up")
        for who, network in NETWORKS.items():
            here, there = self.spaces[who], self.spaces[RELAY]
            ip("-n", here, "link", "add", "up0", "type", "veth", "peer", "name", f"to-{who}", "netns", there)
            for space, device, host in ((here, "up0", 2), (there, f"to-{who}", 1)):
                ip("-n", space, "address", "add", f"{network}.{host}/24", "dev", device)
                ip("-n", space, "link", "set", device, "up")
        self.run(RELAY, "sh", "-c", "echo 0 > /proc/sys/net/ipv4/ip_forward").check_returncode()

    def remove(self) -> None:
        left, self._made = self._made, []
        for space in left:
            subprocess.run(["ip", "netns", "delete", space], check=False)

    def inside(self, who: str) -> list[str]:
        return ["ip", "netns", "exec", self.spaces[who]]

    def run(self, who: str, *command: str) -> "subprocess.CompletedProcess[str]":
        return subprocess.run([*self.inside(who), *command], capture_output=True, text=True, check=False)

    def connects(self, who: str, host: str, port: int) -> bool:
        return self.run(who, sys.executable, "-c", TRY_TO_CONNECT, host, str(port)).returncode == 0


@pytest.fixture
def networks() -> Iterator[Networks]:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and the ip command (apt-get install iproute2)")
    networks = Networks()
    try:
        try:
            networks.make()
        except RuntimeError as error:
            pytest.skip(f"no network namespaces here: {error}")
        yield networks
    finally:
        networks.remove()


def delivered(log: Path) -> int:
    """Lines of a message log that tell of a delivery."""
    return log.read_text().count("\ndelivered,") if log.exists() else 0


@pytest.mark.parametrize("source", ["husky", "generated"])
async def test_a_recording_crosses_between_networks_without_a_route(
    tmp_path: Path, networks: Networks, source: str
) -> None:
    husky = source == "husky"
    bag = recording("husky_gps_imu_odom.bag") if husky else write_bag(tmp_path / "run.bag", {"/chat": 1000})
    content = bodies(bag)
    listen = [f"tcp://{network}.1:{PORT}" for network in NETWORKS.values()]
    silent = {"listen": None}
    async with Lab(tmp_path, "robot1", "site1") as lab:

        def start(who: str, config: Path) -> Process:
            return lab.process(config, before=networks.inside(who))

        relay = start(RELAY, lab.relay_file(relay={"listen": listen}, http=silent))
        await relay.said("relay relay listens on", *listen)
        up = {who: {"endpoint": f"tcp://{network}.1:{PORT}"} for who, network in NETWORKS.items()}
        site = start(
            SITE, lab.recorder_file("site1", "/.*", relay=up[SITE], http=silent, message_log="site1.csv")
        )  # fmt: skip
        await site.said("connected to relay")

        for who, other in ((ROBOT, SITE), (SITE, ROBOT)):
            assert networks.connects(who, f"{NETWORKS[who]}.1", PORT), f"{who} reaches the relay"
            assert not networks.connects(who, f"{NETWORKS[other]}.1", PORT), f"{who} is not in the network of {other}"
            route = networks.run(who, "ip", "route", "get", f"{NETWORKS[other]}.2")
            assert route.returncode != 0
            assert "unreachable" in route.stderr

        robot = start(ROBOT, lab.player_file("robot1", bag, relay=up[ROBOT], http=silent))
        count = sum(map(len, content.values()))
        await site.until(lambda: delivered(tmp_path / "site1.csv") >= count, f"has {count} messages")
        for process in (robot, site, relay):
            await process.stop()
        assert balance(robot.summary()["topics"]) == []
        for counters in relay.summary()["links"].values():
            assert balance(counters) == []
    assert bodies(tmp_path / "site1.bag") == under("robot1", content)


def test_nothing_is_left_of_namespaces(networks: Networks) -> None:
    def listed() -> set[str]:
        output = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout
        return {line.split()[0] for line in output.splitlines()}

    spaces = set(networks.spaces.values())
    assert spaces <= listed()
    networks.remove()
    assert not spaces & listed()
