"""A robot with an adaptation behind a link in virtual time, and topics that have a summary."""

from dataclasses import dataclass, field
from random import Random

from sern_core.adaptation.adapter import SAMPLES, AdapterParams, HopAdapter, Step
from sern_core.adaptation.cost import Ranges, profile
from sern_core.adaptation.model import Configuration
from sern_core.adaptation.policy import Mmcf, Policy
from sern_core.adaptation.predict import Grid
from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.spec import SummaryLevel, SummaryProfile
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.world import SimClient, World

CONTROL, STATE, BULK = PriorityClass
WEIGHTS = profile("teleoperation")
MODES = ("none", "lz4", "zstd")
GRID = Grid.of(
    rates=[(1.0,), (1.0, 0.5), (1.0, 0.4, 0.1)],
    queues=[(10,), (1, 10), (1, 10)],
    codecs=MODES,
    redundancy=(0, 1),
)
LEVELS = Grid.of(
    rates=[(1.0,), (1.0, 0.5), (1.0, 0.4, 0.1)],
    queues=[(10,), (1, 10), (1, 10)],
    codecs=MODES,
    redundancy=(0, 1),
    summarised=(BULK,),
)
ALL_RAW = (False, False, False)
_RANDOM = Random(1)
TEXT = bytes(_RANDOM.randrange(24) for _ in range(60_000))  # compresses to about 0.6


@dataclass
class Rig:
    """A robot with an adaptation behind a link, a site that wants everything of it."""

    world: World
    robot: SimClient
    site: SimClient
    adapter: HopAdapter
    steps: list[Step] = field(default_factory=list)

    def feed(self, channel: OutChannel, rate_hz: float, size: int, *, until_s: float = 1e9, body: bytes = TEXT) -> None:
        """Send the first `size` bytes of `body`."""
        world = self.world

        def send(now: float) -> None:
            if world.network.elapsed_s < until_s and channel.channel_id in self.robot.core.link.sender.channels:
                self.robot.core.send(channel, body[:size], 0, now=now)

        # Off the beat of the intervals, as sources are.
        world.network.after(
            0.003 + 0.37 / rate_hz, lambda _now: world.network.every(1.0 / rate_hz, send, node=self.robot)
        )

    def at(self, at_s: float) -> Step:
        """The interval that ended at about `at_s`."""
        return min(self.steps, key=lambda step: abs(step.now - self.world.network.start_s - at_s))


@dataclass
class Thinned:
    """A topic whose summary is the first part of it; a `Summarised`."""

    robot: SimClient
    source: OutChannel
    channel: OutChannel
    part: float = 0.1
    adapt: bool = True
    level: SummaryLevel = SummaryLevel.RAW
    level_by_rule: SummaryLevel = SummaryLevel.RAW
    cpu_s: float = 0.0
    profile: SummaryProfile = field(default_factory=SummaryProfile)
    changes: list[tuple[float, SummaryLevel]] = field(default_factory=list)

    def set_level(self, level: SummaryLevel) -> None:
        self.level = level
        self.changes.append((self.robot.world.network.elapsed_s, level))

    def offer(self, body: bytes, now: float) -> None:
        self.profile = SummaryProfile(self.profile.messages + 1, 5.0, len(body), self.part, 0.002)
        if self.level is SummaryLevel.RAW:
            self.robot.core.send(self.source, body, 0, now=now)
        else:
            self.cpu_s += 0.002
            self.robot.core.send(self.channel, body[: round(self.part * len(body))], 0, now=now)


def rig(
    policy: Policy | None = None,
    model: LinkModel | None = None,
    *,
    lossless: bool = True,
    link: LinkParams | None = None,
    summaries: list[Thinned] | None = None,
) -> Rig:
    world = World(lossless=lossless, compress=True, link=link)
    model = model or LinkModel(rate_bps=4e6, delay_s=0.025)
    robot = world.client("robot", model.as_stream() if lossless else model)
    site = world.client("site", patterns=["/robot/.*"])
    policy = policy or Mmcf(GRID, weights=WEIGHTS, ranges=Ranges(), initial=Configuration(queues=(10, 10, 10)))
    params = AdapterParams(weights=WEIGHTS, modes=MODES)
    items = summaries if summaries is not None else []
    adapter = HopAdapter(
        robot.core.link, policy, params, coder=robot.core.coder, now=world.now, summaries=lambda: items
    )
    found = Rig(world, robot, site, adapter)
    world.network.every(1.0 / SAMPLES, lambda now: adapter.sample(now=now), node=robot)
    world.network.every(1.0, lambda now: found.steps.append(adapter.step(now=now)), node=robot)
    return found
