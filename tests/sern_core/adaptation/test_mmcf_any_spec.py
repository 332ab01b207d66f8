"""Whatever spec an announcement may have, the adaptation of a robot and of a relay's downlink measures and decides."""

from hypothesis import example, given, settings
from hypothesis import strategies as st

from sern_core.adaptation.adapter import AdapterParams, HopAdapter
from sern_core.adaptation.cost import Ranges, profile
from sern_core.adaptation.model import Configuration
from sern_core.adaptation.policy import Mmcf
from sern_core.adaptation.predict import Grid
from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.types import Durability, PriorityClass, Reliability
from tests.exploring import cases
from tests.world import World

GRID = Grid.of(
    rates=[(1.0,), (1.0, 0.5), (1.0, 0.1)], queues=[(10,), (1, 10), (1, 10)], codecs=("none",), redundancy=(0, 1)
)
WEIGHTS = profile("teleoperation")
TIMES = st.one_of(st.none(), st.sampled_from([0.0, 1e-9, 1e-3, 1.0, 1e9]))
SPECS = st.builds(
    TopicSpec,
    priority=st.sampled_from(PriorityClass),
    weight=st.sampled_from([1e-9, 1.0, 1e9]),
    reliability=st.sampled_from(Reliability),
    durability=st.sampled_from(Durability),
    depth=st.sampled_from([1, 2, 100_000]),
    lifespan_s=TIMES,
    deadline_s=TIMES,
    retention_s=st.sampled_from([0.0, 1.0, 1e9]),
    many_writers=st.booleans(),
)


@given(specs=st.lists(SPECS, min_size=1, max_size=4), sizes=st.lists(st.sampled_from([0, 1, 300, 20_000]), min_size=1))
@example(specs=[TopicSpec(lifespan_s=0.0, reliability=Reliability.RELIABLE)], sizes=[10])
@settings(max_examples=cases(24))
def test_any_spec_that_may_be_announced_can_be_adapted_to(specs: list[TopicSpec], sizes: list[int]) -> None:
    world = World()
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    channels = [robot.publish(f"/robot/t{index}", topic_spec) for index, topic_spec in enumerate(specs)]
    world.run(1.0)
    links = (robot.core.link, world.relay.hub.links[site.name])
    adapters = [
        HopAdapter(
            link,
            Mmcf(GRID, weights=WEIGHTS, ranges=Ranges(), initial=Configuration(queues=(10, 10, 10))),
            AdapterParams(weights=WEIGHTS, modes=("none",)),
            coder=None,
            now=world.now,
        )
        for link in links
    ]
    for interval in range(4):
        for size in sizes[:8]:
            for channel in channels:
                robot.send(channel, bytes(size))
            world.run(0.05)
            for adapter in adapters:
                adapter.sample(now=world.now)
        world.run(0.5)
        for adapter in adapters:
            step = adapter.step(now=world.now)
            assert step.cost is None or 0.0 <= step.cost <= 1.0, interval
    for adapter in adapters:
        adapter.close(now=world.now)
    world.validate()
