"""What happens to processes around several relays: each kind is killed (kill -9), and stands still for a while."""

from pathlib import Path

import pytest

from tests.hazards.relays import HOME, SPARE, relays
from tests.hazards.test_bad_luck import UNCONFIRMED

pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")

OF_RELAY = {"relay1": ("robot1",), "relay2": ("robot2", "operator", "site")}


@pytest.mark.parametrize("who", ["relay1", "relay2"])
async def test_kill_9_of_a_relay_with_clients(tmp_path: Path, who: str) -> None:
    """They go on at the next relay of their list, and it makes no difference that theirs comes back."""
    async with relays(tmp_path) as world:
        world.kill(who)
        await world.at(SPARE, *OF_RELAY[who])
        await world.goes_on()
        await world.again_at(who)


@pytest.mark.parametrize("who", ["relay1", "relay2"])
async def test_a_relay_with_clients_stands_still(tmp_path: Path, who: str) -> None:
    """They go on at the next relay of their list. When theirs runs again it learns that they are elsewhere, and what it
    still holds for them or of them harms nobody."""
    async with relays(tmp_path) as world:
        world.stop(who)
        await world.at(SPARE, *OF_RELAY[who])
        await world.goes_on()
        world.go_on(who)


@pytest.mark.parametrize("how", ["killed", "stands still"])
async def test_a_relay_without_clients_fails(tmp_path: Path, how: str) -> None:
    """The others go on, and have it again."""
    async with relays(tmp_path) as world:
        if how == "killed":
            world.kill(SPARE)
        else:
            world.stop(SPARE)
        for other in OF_RELAY:
            await world.parted(other, SPARE)
        await world.goes_on()
        if how == "killed":
            await world.again_at(SPARE)
        else:
            world.go_on(SPARE)


async def test_kill_9_of_a_robot(tmp_path: Path) -> None:
    """Its relay notices, and a site at another one; what the robot's next process sends arrives whole."""
    async with relays(tmp_path) as world:
        await world.until("site", lambda: world.peer("site", "robot1") == "connected", "reaches robot1")
        world.kill("robot1")
        home = HOME["robot1"]
        await world.until(home, lambda: world.state(home, "robot1") != "connected", "has lost robot1")
        await world.until("site", lambda: world.peer("site", "robot1") == "gone", "is told so")
        world.anew = {"/robot1/count"}
        await world.start("robot1", world.robot_file("robot1"))


async def test_kill_9_of_a_site(tmp_path: Path) -> None:
    """Its next process goes on where the last recording ends, or with what had not been confirmed of it."""
    async with relays(tmp_path) as world:
        world.kill("site")
        world.again = UNCONFIRMED
        await world.start_site("second")


@pytest.mark.parametrize("who", ["robot1", "site", "operator"])
async def test_a_client_stands_still(tmp_path: Path, who: str) -> None:
    """It is where it was when it runs again, and its streams go on without a gap."""
    async with relays(tmp_path) as world:
        relay = "relay1" if who == "robot1" else "relay2"
        world.stop(who)
        await world.until(relay, lambda: world.state(relay, who) != "connected", f"misses {who}")
        world.go_on(who)
