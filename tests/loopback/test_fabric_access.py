"""Access over two relays, as processes with keys: who is revoked at one is out at both, and both rules must grant."""

import asyncio
import json
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from sern_tools.commands import app
from tests.daemons import Lab, Process, delivered, metric, write_bag
from tests.two_relays import RELAYS, TwoRelays

pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")

OPEN = {"client": ".*", "publish": [".*"], "subscribe": [".*"]}


async def connected(two: TwoRelays, **sections: dict[str, Any]) -> dict[str, Process]:
    """Both relays, with what is said of each by its name, once they have a session."""
    relays = {name: two.relay(name, **sections.get(name, {})) for name in RELAYS}
    for name, process in relays.items():
        (other,) = (each for each in RELAYS if each != name)
        await process.said(f"connected to the relay {other}")
    return relays


async def revoke(client: str, relay: Process) -> str:
    """What `sern keys revoke` says."""
    words = ["keys", "revoke", client, "--config", str(relay.config)]
    result = await asyncio.to_thread(CliRunner().invoke, app, words)
    assert result.exit_code == 0, result.stderr
    return result.stdout


async def test_who_is_revoked_at_one_relay_is_out_at_both_and_stays_so(tmp_path: Path) -> None:
    """Also one that goes over to the other relay, and after that is started anew."""
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        shutil.copytree(lab.clients_dir, tmp_path / "clients2")
        of_second: dict[str, Any] = {"relay": {"clients_dir": "clients2"}}
        relays = await connected(two, relay2=of_second)
        first, second = relays.values()
        bag = write_bag(tmp_path / "run.bag", {"/chat": 2000})
        site = await lab.process(lab.recorder_file("site", "/.*", relay=two.at("relay2"))).ready()
        robot_file = two.with_both(lab.player_file("robot1", bag, play={"rate": 1}), first="relay1")
        robot = lab.process(robot_file)
        await site.until(lambda: delivered(site) >= 20, "has messages of the robot")

        assert "told to the relays that it is connected to: relay2" in await revoke("robot1", first)
        await second.said("the relay relay1 has revoked the key", "of robot1")
        await second.until(lambda: revoked(tmp_path / "clients2") == ["told-by-relay1"], "writes it down")
        for relay in (first, second):  # the robot goes from one to the other, and is let in at neither
            await relay.until(lambda relay=relay: refusals(relay), "turns the robot away")
        await first.until(lambda: "robot1" not in [row["name"] for row in rows(first)], "forgets the robot")
        assert "not connected to the relay" not in first.text, "a reload ends no session of relays"

        second.kill()
        again = two.relay("relay2", **of_second)
        await again.until(lambda: refusals(again), "turns the robot away")
        await first.said("connected to the relay relay2")
        await again.until(lambda: state_of("site", again) == "connected", "has the site again")
        await revoke("site", first)
        await again.said("site lost a key; 1 connections cut")
        await robot.stop()
        for process in (site, first, again):
            await process.stop()


def revoked(clients: Path) -> list[str]:
    """Who told of what is revoked in a folder of client keys."""
    folder = clients / "revoked"
    return [file.stem.rpartition(".")[2] for file in folder.iterdir()] if folder.exists() else []


def refusals(relay: Process) -> list[str]:
    """What a relay says of revoked keys at its door."""
    return [event["text"] for event in events(relay) if "is revoked" in event["text"]]


def events(relay: Process) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = relay.json("/api/events")["events"] if relay.get("/readyz")[0] == 200 else []
    return found


def rows(relay: Process) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = relay.json("/api/clients")["clients"]
    return found


def state_of(client: str, relay: Process) -> str:
    """How a relay sees a client."""
    (state,) = (row["state"] for row in rows(relay) if row["name"] == client)
    return str(state)


async def test_a_relay_that_was_away_hears_of_it_when_it_comes(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        two = TwoRelays(lab)
        shutil.copytree(lab.clients_dir, tmp_path / "clients2")
        first = await two.relay("relay1").ready()
        assert "not reached now, and told when they are: relay2" in await revoke("robot1", first)
        second = two.relay("relay2", relay={"clients_dir": "clients2"})
        await second.said("the relay relay1 has revoked the key", "of robot1")
        await second.until(lambda: revoked(tmp_path / "clients2") == ["told-by-relay1"], "writes it down")
        for process in (second, first):
            await process.stop()


async def test_what_the_rules_of_the_robots_relay_forbid_does_not_reach_a_site_at_another(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/open": 100, "/secret": 100})
    strict = [{"client": "site", "publish": [".*"], "subscribe": [".*/open"]}, OPEN]
    async with Lab(tmp_path, "robot1", "site", "beside") as lab:
        two = TwoRelays(lab)
        relays = await connected(two, relay1={"access": strict})
        first, second = relays.values()
        await second.said("the relay relay1 has other access rules than this one")
        site = await lab.process(lab.recorder_file("site", "/.*", relay=two.at("relay2"))).ready()
        beside = await lab.process(lab.recorder_file("beside", "/.*", relay=two.at("relay2"))).ready()
        robot = lab.process(lab.player_file("robot1", bag, relay=two.at("relay1")))
        await beside.until(lambda: delivered(beside) == 200, "has everything")
        await site.until(lambda: delivered(site, "/robot1/open") == 100, "has what it may have")
        assert delivered(site) == 100
        assert [metric(relay, "sern_fabric_rules_differ") for relay in (first, second)] == [1, 1]

        content = json.loads(first.config.read_text())
        first.config.write_text(json.dumps({**content, "access": [OPEN]}))
        first.signal(signal.SIGHUP)
        for relay, other in ((first, "relay2"), (second, "relay1")):
            await relay.said(f"the relay {other} has the access rules of this one")
        assert [metric(relay, "sern_fabric_rules_differ") for relay in (first, second)] == [0, 0]
        for process in (robot, site, beside, second, first):
            await process.stop()


async def test_two_processes_of_one_name_at_two_relays_are_an_error(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        two = TwoRelays(lab)
        relays = await connected(two)
        clients = []
        for name in RELAYS:
            (tmp_path / f"at_{name}").mkdir()
            file = lab.client_file(
                "robot1", {"kind": "synthetic", "role": "robot", "topics": ["/pose"]}, relay=two.at(name)
            )
            clients.append(lab.process(file.rename(file.with_name(f"robot1_{name}.yaml"))))
        for name, relay in relays.items():
            (other,) = (each for each in RELAYS if each != name)
            await relay.said(
                "robot1: its sessions begin at the relays", name, other, "two processes have one name and key"
            )
            assert metric(relay, "sern_relay_takeovers_total") >= 1
            assert [row["takeovers"] >= 1 for row in rows(relay) if row["name"] == "robot1"] == [True]
            assert any(event["kind"] == "takeover" and event["relay"] == other for event in events(relay))
        for process in (*clients, *relays.values()):
            await process.stop()
