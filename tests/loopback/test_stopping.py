"""What a client still owes when it is stopped: sent if that is possible, and counted whatever becomes of it."""

from pathlib import Path

from tests.daemons import Lab, balance, write_bag

COUNT = 40


async def test_what_never_left_is_counted_as_such(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": COUNT})
    async with Lab(tmp_path, "robot1") as lab:  # there is no relay
        robot = lab.process(lab.player_file("robot1", bag, play={"wait_for": []}))
        await robot.until(lambda: robot.get("/healthz")[0] == 200, "runs")
        await robot.until(lambda: _offered(robot.json("/api/topics")) == COUNT, "has offered everything")
        await robot.stop()
        counters = robot.summary()["topics"]["/robot1/chat"]
        assert (counters["dropped"], counters["in_queue"], counters["in_flight"]) == ({"shutdown": COUNT}, 0, 0)
        assert f"{COUNT} reliable messages that not everyone has confirmed" in robot.text


async def test_what_was_sent_and_not_confirmed_is_told_from_it(tmp_path: Path) -> None:
    """The relay holds it for a site that wanted it and is away: it may yet arrive."""
    bag = write_bag(tmp_path / "run.bag", {"/chat": COUNT})
    async with Lab(tmp_path, "robot1", "site1") as lab:
        lab.process(lab.relay_file())
        site = lab.process(lab.recorder_file("site1", "/.*"))
        await site.said("connected to relay")
        robot = lab.process(lab.player_file("robot1", bag, play={"rate": 0.001}))
        await site.said("receiving", "/robot1/chat")
        site.kill()
        before = _offered(robot.json("/api/topics"))
        await robot.until(
            lambda: _offered(robot.json("/api/topics")) > before, "has offered something that nobody gets"
        )
        await robot.stop()
        topics = robot.summary()["topics"]
        counters = topics["/robot1/chat"]
        assert balance(topics) == []
        assert (counters["in_queue"], counters["in_flight"]) == (0, 0)
        assert counters["dropped"].keys() == {"unconfirmed"}


def _offered(topics: dict[str, dict[str, int]]) -> int:
    return sum(counters.get("offered", 0) for counters in topics.values())
