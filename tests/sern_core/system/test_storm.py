"""Ten minutes without a link for everybody, and then all of them are back at once."""

from dataclasses import replace

from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.types import PriorityClass, Reliability
from sern_sim.models import LinkModel, Window
from tests.world import World, spec

ROBOTS = 40
AWAY = Window(10.0, 610.0)
LINK = LinkModel(rate_bps=2e6, delay_s=0.02, disconnect_after_s=5.0, reconnect_s=0.5, blackouts=(AWAY,)).as_stream()
LOG = TopicSpec(
    priority=PriorityClass.STATE, reliability=Reliability.RELIABLE, depth=1000, lifespan_s=None, retention_s=3600.0
)


def test_everybody_is_back_after_ten_minutes_and_nothing_is_missing() -> None:
    """40 robots go on publishing meanwhile. What is reliable arrives whole and in order; of what is fresh the newest
    comes first, and nothing that is older than its lifespan."""
    world = World(1)
    site = world.client("site", replace(LINK, rate_bps=8e6), patterns=[".*"])
    names = [f"robot{number}" for number in range(ROBOTS)]
    for name in names:
        robot = world.client(name, LINK)
        log = robot.publish(f"/{name}/log", LOG)
        pose = robot.publish(f"/{name}/pose", spec(PriorityClass.CONTROL, lifespan_s=0.5))
        robot.every(2.0, log, bytes(200))
        robot.every(0.5, pose, bytes(100))
    world.run(630.0)
    for name in names:
        seqs = site.seqs(f"/{name}/log")
        assert seqs == list(range(1, len(seqs) + 1)) and len(seqs) >= 300, name
        later = [got for got in site.on(f"/{name}/pose") if got.at_s > AWAY.end_s]
        assert later, f"no pose of {name} since"
        assert all(got.age_s <= 0.5 for got in later)
    world.validate()
    world.check_faults()
