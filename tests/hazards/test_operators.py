"""What its operators do to a relay that runs: keys that go and come back, and files with mistakes."""

import json
import shutil
import signal
from pathlib import Path

from tests.daemons import metric, write_bag
from tests.hazards.field import field


async def test_revoked_and_allowed_again(tmp_path: Path) -> None:
    """A client whose key is taken away is cut off in both directions at the reload, and comes back by itself when the
    key is there again."""
    bag = write_bag(tmp_path / "other.bag", {"/count": 500})
    async with field(tmp_path) as world:
        lab, relay = world.lab, world.relay
        play = {"rate": 0.2, "loop": True, "wait_for": []}
        robot2 = lab.process(lab.player_file("robot2", bag, play=play))
        await relay.said("robot2 connected")
        key = lab.clients_dir / "robot2.pub"
        away = key.rename(tmp_path / "robot2.pub")
        relay.signal(signal.SIGHUP)
        await robot2.said("WARNING", "relay refused our key")
        # Of a name that is in no directory the row goes as well, when the relay looks next.
        states = {row["state"] for row in relay.json("/api/clients")["clients"] if row["name"] == "robot2"}
        assert states <= {"forgotten"} and "/robot2/count" not in relay.json("/api/topics")["announced"]
        shutil.copy(away, key)
        relay.signal(signal.SIGHUP)
        await relay.until(lambda: "/robot2/count" in relay.json("/api/topics")["announced"], "has it again")
        await robot2.stop()


async def test_bad_file_at_reload(tmp_path: Path) -> None:
    """The old rules stay in force, the error is one line with the place, and a good file is in force at once."""
    async with field(tmp_path) as world:
        relay = world.relay
        good = relay.config.read_text()
        for count, bad in enumerate(("relay: [", good.replace('"publish"', '"publisch"')), start=1):
            relay.config.write_text(bad)
            relay.signal(signal.SIGHUP)
            await relay.until(lambda n=count: metric(relay, "sern_relay_reload_failures_total") == n, "has failed")
            lines = [line for line in relay.lines if "reload failed, the old configuration stays: " in line]
            assert len(lines) == count and f"{relay.config}:" in lines[-1]
            assert metric(relay, "sern_relay_reload_failed") == 1
            await world.goes_on()
        content = json.loads(good)
        content["access"] = [{"client": "site", "subscribe": [".*"]}, {"client": "robot1", "publish": [".*"]}]
        relay.config.write_text(json.dumps(content))
        relay.signal(signal.SIGHUP)
        await relay.until(lambda: metric(relay, "sern_relay_reload_failed") == 0, "takes the good one")


async def test_broken_key_file_at_reload(tmp_path: Path) -> None:
    """A key file that is none changes nothing for the others."""
    async with field(tmp_path) as world:
        (world.lab.clients_dir / "robot2.pub").write_text("nonsense")
        world.relay.signal(signal.SIGHUP)
        await world.relay.said("reload failed, the old configuration stays", "robot2.pub")
        assert metric(world.relay, "sern_relay_reload_failed") == 1
