"""Client and relay go over to new keys while numbered reliable messages run: each arrives once, in order."""

import asyncio
from collections.abc import Callable
from itertools import repeat
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.types import ClientName, TopicName
from sern_runtime.config.client import load_client
from sern_runtime.config.key_changes import MAX_VALID
from sern_runtime.config.keys import (
    NEXT_SUFFIX,
    PublicKey,
    PublicKeys,
    fingerprint,
    generate,
    load_public,
    load_secret,
    write_public,
    write_secret,
)
from sern_runtime.config.relay import load_relay
from sern_tools import keys
from sern_tools.commands import app
from tests.daemons import Lab, Process, bodies, delivered, under, write_bag
from tests.support import until

CHAT = TopicName("/robot1/chat")
STEADY = {"rate": 1}
COUNT = 4000
ROBOT = ClientName("robot1")
DEAD_ENDS = {"kind": "synthetic", "role": "robot", "topics": 1}


def run_sern(*words: str) -> int:
    result = CliRunner().invoke(app, words)
    assert not result.stderr, result.stderr
    return result.exit_code


class World:
    """Relay and robot in processes of their own, and a site here that records what the robot says."""

    def __init__(self, lab: Lab, bag: Path, *, udp: bool, rotate: bool = True, overlap_s: float = 86_400.0) -> None:
        self.lab = lab
        self.bag = bag
        self.said: list[str] = []
        self.relay_file = lab.relay_file(relay={"udp": udp, "rotate_keys": rotate, "key_overlap_s": overlap_s})
        self.robot_file = lab.player_file("robot1", bag, play=STEADY)
        # What each reads at its start is its own, as on machines of their own.
        self.relay: Process
        self.robot: Process
        self.site: Any = None

    async def start(self) -> None:
        self.relay = await self.lab.process(self.relay_file).ready()
        self.site = await self.lab.connected(self.lab.recorder_file("site", "/.*"))
        self.robot = await self.lab.process(self.robot_file).ready()
        await self.arrived(200)

    async def arrived(self, count: int) -> None:
        await until(lambda: delivered(self.site, CHAT) >= count, f"{count} messages have arrived")

    async def rotate_client(self) -> None:
        await asyncio.to_thread(keys.rotate_client, load_client(self.robot_file), out=self.said.append)

    async def rotate_relay(self, *, switch: bool, force: bool = False) -> None:
        loaded = load_relay(self.relay_file)
        await asyncio.to_thread(keys.rotate_relay, loaded, switch=switch, force=force, out=self.said.append)

    def in_use(self) -> str:
        return str(self.relay.json("/api/keys")["clients"]["robot1"]["in_use"])

    async def end(self) -> None:
        """Everything arrives, and nothing twice."""
        await self.arrived(COUNT)
        await self.robot.stop()
        await self.lab.end(self.site)
        await self.relay.stop()
        assert bodies(self.lab.directory / "site.bag") == under("robot1", bodies(self.bag))


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "run.bag", {"/chat": COUNT})


@pytest.mark.parametrize("udp", [True, False], ids=["udp", "tcp"])
async def test_a_client_goes_over_to_a_new_key(tmp_path: Path, bag: Path, udp: bool) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        world = World(lab, bag, udp=udp)
        await world.start()
        old = load_secret(tmp_path / "robot1.key")
        await world.rotate_client()
        new = load_secret(tmp_path / "robot1.key")
        assert new != old and not (tmp_path / "robot1.next.key").exists()
        await world.robot.until(
            lambda: world.in_use() == fingerprint(new.public_key), "has its session with the new key"
        )
        first, second = load_public(lab.clients_dir / "robot1.pub").keys
        assert (first.key, second.key) == (old.public_key, new.public_key)
        assert first.not_after_s is not None and second.not_after_s is None
        assert world.robot.json("/api/keys")["other"] is None
        await world.end()


async def test_the_relay_goes_over_to_a_new_key_while_messages_run(tmp_path: Path, bag: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        world = World(lab, bag, udp=False)
        await world.start()
        old = load_secret(tmp_path / "relay.key")
        await world.rotate_relay(switch=False)
        coming = load_secret(tmp_path / f"relay{NEXT_SUFFIX}")
        assert world.said[-1].startswith("2 of 2 clients accept ")
        assert {key.key for key in load_public(tmp_path / "relay.pub").keys} == {old.public_key, coming.public_key}
        await world.rotate_relay(switch=True)
        assert load_secret(tmp_path / "relay.key") == coming and not (tmp_path / f"relay{NEXT_SUFFIX}").exists()
        await until(lambda: [key.key for key in load_public(tmp_path / "relay.pub").keys] == [coming.public_key])
        await world.robot.until(lambda: world.relay.json("/api/keys")["clients"]["robot1"]["in_use"], "is back")
        count = delivered(world.site, CHAT)
        world.relay.kill()  # the next process has the new key alone
        world.relay = await lab.process(world.relay_file).ready()
        await world.arrived(min(count + 500, COUNT))
        await world.end()


@pytest.mark.parametrize("udp", [True, False], ids=["udp", "tcp"])
async def test_clients_are_back_at_a_relay_that_goes_over_to_a_new_key(tmp_path: Path, udp: bool) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.process(lab.relay_file(relay={"udp": udp})).ready()
        robot = await lab.process(lab.client_file("robot1", DEAD_ENDS)).ready()
        loaded = load_relay(relay.config)
        for _ in range(2):
            await asyncio.to_thread(keys.rotate_relay, loaded, switch=False, force=False, out=print)
            await asyncio.to_thread(keys.rotate_relay, loaded, switch=True, force=False, out=print)
            mark = fingerprint(load_secret(tmp_path / "robot1.key").public_key)
            await robot.until(lambda m=mark: relay.json("/api/keys")["clients"]["robot1"]["in_use"] == m, "is back")
            in_use = relay.json("/api/keys")["relay"]["in_use"]
            assert in_use == fingerprint(load_secret(tmp_path / "relay.key").public_key)
        await robot.stop()
        await relay.stop()


@pytest.mark.parametrize("listen", ["tcp://*:{0}", "tcp://0.0.0.0:{0}", "tcp://127.0.0.1:{0}", "ipc://relay.ipc"])
async def test_a_relay_listens_with_its_new_key_wherever_it_did(tmp_path: Path, listen: str) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay(lab.relay_file(relay={"listen": [listen.format(lab.port)]}))
        if listen.startswith("ipc"):
            lab.endpoint = f"ipc://{tmp_path}/relay.ipc"
        assert relay.transports.server is not None
        robot = await lab.connected(lab.client_file("robot1", DEAD_ENDS))
        old = load_public(tmp_path / "relay.pub").keys[0].key
        new = lab.make_relay_keys()  # the robot reads it when it is told to, as if it were given the file
        both = (PublicKey(old), PublicKey(new.public_key))
        write_public(tmp_path / "relay.pub", PublicKeys(ClientName("relay"), both), replace=True)
        robot.reload()
        relay.reload()
        keyring = robot.relays.current.keyring
        await until(lambda: keyring is not None and keyring.server_keys == (new.public_key,))
        await until(lambda: relay.transports.session_key(ROBOT) is not None, "it is back")
        await lab.end(robot)
        await lab.end(relay)


async def test_a_relay_does_not_go_over_while_a_client_would_be_locked_out(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "robot2") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        robot = await lab.process(lab.client_file("robot1", DEAD_ENDS)).ready()
        loaded, said = load_relay(relay.config), list[str]()
        await asyncio.to_thread(keys.rotate_relay, loaded, switch=False, force=False, out=said.append)
        assert said[-2:-1] == ["robot2 does not know it: it is not connected"]
        before = load_secret(tmp_path / "relay.key")
        with pytest.raises(SernError, match="not done: robot2 would be locked out"):
            await asyncio.to_thread(keys.rotate_relay, loaded, switch=True, force=False, out=said.append)
        assert load_secret(tmp_path / "relay.key") == before
        await asyncio.to_thread(keys.rotate_relay, loaded, switch=True, force=True, out=said.append)
        assert relay.json("/api/keys")["relay"]["in_use"] != fingerprint(before.public_key)
        await robot.stop()
        await relay.stop()


async def test_a_relay_that_takes_no_keys_over_the_link_says_what_its_operator_does(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        robot = await lab.process(lab.client_file("robot1", DEAD_ENDS)).ready()
        coming = next(pair for pair in map(generate, repeat(ROBOT)) if pair.public_key.startswith("-"))
        write_secret(tmp_path / "robot1.next.key", coming)
        said: list[str] = []
        with pytest.raises(SernError, match=r"takes no keys over the link .* On the relay: sern keys add robot1 -- '"):
            await asyncio.to_thread(keys.rotate_client, load_client(robot.config), out=said.append)
        assert len(load_public(lab.clients_dir / "robot1.pub").keys) == 1
        words = ("keys", "add", "robot1", "--config", str(relay.config), "--", coming.public_key)
        code = await asyncio.to_thread(run_sern, *words)
        assert code == 0
        await asyncio.to_thread(keys.rotate_client, load_client(robot.config), out=said.append)
        assert load_secret(tmp_path / "robot1.key") == coming
        await robot.stop()
        await relay.stop()


async def test_a_client_gets_no_more_keys_at_a_time_than_a_few(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.process(lab.relay_file(relay={"rotate_keys": True})).ready()
        robot = await lab.process(lab.client_file("robot1", DEAD_ENDS)).ready()
        for _ in range(MAX_VALID - 1):
            await asyncio.to_thread(keys.rotate_client, load_client(robot.config), out=print)
        with pytest.raises(SernError, match=f"robot1 has {MAX_VALID} keys that hold"):
            await asyncio.to_thread(keys.rotate_client, load_client(robot.config), out=print)
        assert len(load_public(lab.clients_dir / "robot1.pub").keys) == MAX_VALID
        await robot.stop()
        await relay.stop()


class EndedHereError(Exception):
    """The command's process ended."""


def ends(*_args: object, **_kwargs: object) -> None:
    raise EndedHereError


def ends_at(monkeypatch: pytest.MonkeyPatch, point: str) -> None:
    """The command ends before it does this."""
    if point == "tells the daemon":
        monkeypatch.setattr(keys.Running, "reload", ends)
    elif point == "puts it in place":
        monkeypatch.setattr(keys, "put_in_place", ends)
    else:
        monkeypatch.setattr(keys, "sync_directory", ends)
        if point == "renames":
            monkeypatch.setattr(Path, "replace", only_public(Path.replace))


def only_public(replace: Callable[..., Path]) -> Callable[..., Path]:
    def replaced(path: Path, target: Path) -> Path:
        if target.suffix == ".key":
            raise EndedHereError
        return replace(path, target)

    return replaced


POINTS = ["tells the daemon", "puts it in place", "renames", "syncs"]


@pytest.mark.parametrize("point", POINTS)
async def test_a_clients_rotation_that_ends_in_the_middle_goes_on(
    tmp_path: Path, point: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.process(lab.relay_file(relay={"rotate_keys": True})).ready()
        robot = await lab.process(lab.client_file("robot1", DEAD_ENDS)).ready()
        loaded = load_client(robot.config)
        old = load_secret(tmp_path / "robot1.key")
        with monkeypatch.context() as patch:
            ends_at(patch, point)
            with pytest.raises(EndedHereError):
                await asyncio.to_thread(keys.rotate_client, loaded, out=print)
        robot.kill()
        robot = await lab.process(robot.config).ready()
        if (tmp_path / "robot1.next.key").exists():
            await asyncio.to_thread(keys.rotate_client, loaded, out=print)
        new = load_secret(tmp_path / "robot1.key")
        assert new != old and not (tmp_path / "robot1.next.key").exists()
        assert [key.key for key in load_public(tmp_path / "robot1.pub").keys] == [new.public_key]
        await robot.until(
            lambda: relay.json("/api/keys")["clients"]["robot1"]["in_use"] == fingerprint(new.public_key), "new key"
        )  # fmt: skip
        await robot.stop()
        await relay.stop()


@pytest.mark.parametrize("point", POINTS)
async def test_a_relays_rotation_that_ends_in_the_middle_goes_on(
    tmp_path: Path, point: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        robot = await lab.process(lab.client_file("robot1", DEAD_ENDS)).ready()
        loaded = load_relay(relay.config)
        old = load_secret(tmp_path / "relay.key")
        if point != "tells the daemon":
            await asyncio.to_thread(keys.rotate_relay, loaded, switch=False, force=False, out=print)
        with monkeypatch.context() as patch:
            ends_at(patch, point)
            switch = point != POINTS[0]
            with pytest.raises(EndedHereError):
                await asyncio.to_thread(keys.rotate_relay, loaded, switch=switch, force=False, out=print)
        relay.kill()
        relay = await lab.process(relay.config).ready()
        await robot.until(lambda: relay.json("/api/keys")["clients"]["robot1"]["connected"], "is back")
        if (tmp_path / "relay.next.key").exists():
            await asyncio.to_thread(keys.rotate_relay, loaded, switch=False, force=False, out=print)
            await asyncio.to_thread(keys.rotate_relay, loaded, switch=True, force=False, out=print)
        new = load_secret(tmp_path / "relay.key")
        assert new != old and relay.json("/api/keys")["relay"]["in_use"] == fingerprint(new.public_key)
        await until(lambda: [key.key for key in load_public(tmp_path / "relay.pub").keys] == [new.public_key])
        await robot.stop()
        await relay.stop()


async def test_an_old_key_that_ends_disturbs_no_session_of_the_new_one(tmp_path: Path, bag: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        world = World(lab, bag, udp=False, overlap_s=1.0)
        await world.start()
        await world.rotate_client()
        await world.relay.said("robot1 lost a key", "0 connections cut")
        assert "the key no longer holds" not in world.relay.text
        await world.end()
