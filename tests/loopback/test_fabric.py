"""Two relays on one fabric as their users run them: keys for the clients, certificates between the relays."""

from pathlib import Path

import pytest

from sern_tools.keygen_fabric import add_relays
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab, bodies, delivered, under, write_bag
from tests.loopback.test_services import Sites
from tests.sern_runtime.fabric.relays import external_router, files
from tests.two_relays import RELAYS, TwoRelays

pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")


async def test_a_recording_goes_from_a_robot_at_one_relay_to_a_site_at_another(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 500, "/log": 300, "/map": 1}, latched=["/map"])
    content = bodies(bag)
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        first, second = two.relay("relay1"), two.relay("relay2")
        await first.said("connected to the relay relay2")
        await second.said("connected to the relay relay1")
        site = await lab.process(lab.recorder_file("site", "/.*", relay=two.at("relay2"))).ready()
        robot = lab.process(lab.player_file("robot1", bag, relay=two.at("relay1")))
        await site.until(lambda: delivered(site) >= sum(map(len, content.values())), "has everything")
        for process in (robot, site, second, first):
            await process.stop()
    assert bodies(tmp_path / "site.bag") == under("robot1", content)


async def test_a_recording_goes_through_a_router_that_nobody_believes(tmp_path: Path) -> None:
    """It sees datagrams of both relays, and nothing of what is in them."""
    bag = write_bag(tmp_path / "run.bag", {"/chat": 300, "/map": 1}, latched=["/map"])
    content = bodies(bag)
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        add_relays(["router"], out=tmp_path / "fabric")
        (port,) = free_ports(1)
        with external_router(port, files(tmp_path / "fabric", "router")) as session:
            seen: list[bytes] = []
            tap = session.declare_subscriber("sern/**", lambda sample: seen.append(sample.payload.to_bytes()))
            relays = [two.relay(name, router=f"tls/{HOST}:{port}") for name in RELAYS]
            await relays[0].said("connected to the relay relay2")
            site = await lab.process(lab.recorder_file("site", "/.*", relay=two.at("relay2"))).ready()
            robot = lab.process(lab.player_file("robot1", bag, relay=two.at("relay1")))
            await site.until(lambda: delivered(site) >= sum(map(len, content.values())), "has everything")
            for process in (robot, site, *relays):
                await process.stop()
            tap.undeclare()
    assert bodies(tmp_path / "site.bag") == under("robot1", content)
    sizes_bytes = sum(map(len, seen))
    assert sizes_bytes > 300 * len("/chat 300") and not any(b"chat" in each or b"robot1" in each for each in seen)


async def test_a_relay_that_is_killed_on_the_way_costs_nothing(tmp_path: Path) -> None:
    """Either of them: reliable messages of a recording that is played in real time arrive once and in order."""
    bag = write_bag(tmp_path / "run.bag", {"/chat": 400})
    content = bodies(bag)
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        relays = {name: two.relay(name) for name in RELAYS}
        site = await lab.process(lab.recorder_file("site", "/.*", relay=two.at("relay2"))).ready()
        robot = lab.process(lab.player_file("robot1", bag, play={"rate": 1}, relay=two.at("relay1")))
        for count, name in ((50, "relay2"), (150, "relay1")):
            await site.until(lambda count=count: delivered(site) >= count, f"has {count} messages")
            relays[name].kill()
            relays[name] = two.relay(name)
        await site.until(lambda: delivered(site) >= 400, "has everything")
        for process in (robot, site, *relays.values()):
            await process.stop()
    assert bodies(tmp_path / "site.bag") == under("robot1", content)


async def test_a_service_of_a_robot_is_called_from_another_relay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        for name in RELAYS:
            await two.relay(name).ready()
        sites = Sites(lab, monkeypatch)
        await sites.start_robot(relay=two.at("relay1"))
        site = await sites.start_site(relay=two.at("relay2"))
        sites.offer()
        handler = await sites.served()
        assert [await handler(b"%d" % number) for number in range(5)] == [b"re: %d" % number for number in range(5)]
        assert await handler(b"x" * 100_000) == b"re: " + b"x" * 100_000
        assert site.bridge.services is not None


@pytest.mark.parametrize("who", ["robot1", "site"])
async def test_who_goes_over_to_the_other_relay_loses_nothing(tmp_path: Path, who: str) -> None:
    """The relay of one of the two is killed for good, and that one goes on at the other's."""
    bag = write_bag(tmp_path / "run.bag", {"/chat": 400})
    content = bodies(bag)
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        relays = {name: two.relay(name) for name in RELAYS}
        moves = {"robot1": "relay1", "site": "relay2"}[who]
        site_file = lab.recorder_file("site", "/.*", relay=two.at("relay2"))
        robot_file = lab.player_file("robot1", bag, play={"rate": 1}, relay=two.at("relay1"))
        if who == "site":
            site_file = two.with_both(site_file, first=moves)
        else:
            robot_file = two.with_both(robot_file, first=moves)
        site = await lab.process(site_file).ready()
        robot = lab.process(robot_file)
        await site.until(lambda: delivered(site) >= 100, "has 100 messages")
        relays.pop(moves).kill()
        await site.until(lambda: delivered(site) >= 400, "has everything")
        for process in (robot, site, *relays.values()):
            await process.stop()
    assert bodies(tmp_path / "site.bag") == under("robot1", content)
