"""Messages of a robot over a scripted link to a site, with the real cores, in virtual time.

    robot ── the profile's link ── relay ── a perfect wire ── site

Used by `sern explain` and by benchmarks. What is measured there is the core's own: the network only says what the link
does to datagrams.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Any, Final, NamedTuple

from sern_core.bodies.codecs import Coder
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import Hub
from sern_core.relay.hub_port import HubPort
from sern_core.site.client import ClientCore
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import Message, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import ClientName, TopicName
from sern_sim.models import LinkModel
from sern_sim.network import Network
from sern_sim.ports import Port
from sern_sim.profiles import LinkProfile

ROBOT: Final = ClientName("robot")
SITE: Final = ClientName("site")
OPEN: Final = AccessTable([AccessRule(client=".*", publish=(".*",), subscribe=(".*",), replay=(".*",))])


class Arrival(NamedTuple):
    """One message at the site, `at_s` from the start of the run."""

    at_s: float
    age_s: float
    nbytes: int


@dataclass
class _Silent:
    """Takes whatever a core tells its shell, and does nothing with it."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        if name.startswith("__"):
            raise AttributeError(name)
        return _nothing


def _nothing(*_args: object, **_named: object) -> None:
    return None


@dataclass
class _Site(_Silent):
    """Notes what arrives, by topic."""

    start_s: float = 0.0
    arrivals: dict[TopicName, list[Arrival]] = field(default_factory=lambda: defaultdict(list))

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        arrival = Arrival(now - self.start_s, now - message.born_s, len(message.body))
        self.arrivals[stream.id.topic].append(arrival)


class _ClientNode:
    def __init__(self, core: ClientCore) -> None:
        self.core = core

    def ports(self) -> list[Port]:
        return [self.core.link]


class _HubNode:
    def __init__(self, hub: Hub) -> None:
        self.hub = hub
        self.sides: dict[ClientName, HubPort] = {}

    def port(self, client: ClientName) -> HubPort:
        return self.sides.setdefault(client, HubPort(self.hub, client))

    def ports(self) -> list[Port]:
        return list(self.sides.values())

    def take_dirty(self) -> Iterable[Port]:
        return [port for port in self.sides.values() if port.dirty]


class ReplayWorld:
    """`publish`, `feed`, then `run`. Times are seconds from the start. `coder` encodes what the robot publishes."""

    def __init__(
        self,
        profile: LinkProfile,
        *,
        seed: int = 1,
        link: LinkParams | None = None,
        scheduler: SchedulerParams | None = None,
        coder: Coder | None = None,
        trace: DecisionTrace | None = None,
    ) -> None:
        self.network = Network(seed)
        now = self.network.now
        boots = Random(seed)
        link, scheduler = link or LinkParams(), scheduler or SchedulerParams()
        lossless = profile.up.streaming
        silent: Any = _Silent()
        self._site = _Site(start_s=now)
        site_events: Any = self._site
        self.hub = Hub(
            name=ClientName("relay"),
            boot=boots.getrandbits(63),
            access=OPEN,
            known=lambda _name: True,
            events=silent,
            link=link,
            scheduler=scheduler,
            wall_ns=lambda t: int(t * 1e9),
            now=now,
            lossless=lossless,
        )
        self._hub_node = _HubNode(self.hub)
        client = partial(ClientCore, link=link, scheduler=scheduler, now=now, lossless=lossless)
        self.robot = client(name=ROBOT, boot=boots.getrandbits(63), events=silent, trace=trace, coder=coder)
        self.site = client(name=SITE, boot=boots.getrandbits(63), events=site_events)
        self.site.subscribe((".*",), now=now)
        self.robot_node = _ClientNode(self.robot)
        perfect = LinkModel().as_stream() if lossless else LinkModel()
        for node, up, down in (
            (self.robot_node, profile.up, profile.down),
            (_ClientNode(self.site), perfect, perfect),
        ):
            port = self._hub_node.port(node.core.name)
            self.network.join(node.core.link, node, port, self._hub_node, up, down, name=str(node.core.name))
        self.network.every(1.0, self._sweep)

    def _sweep(self, now: float) -> None:
        self.hub.sweep(now=now)
        while self.hub.lapse(now=now):
            pass

    @property
    def arrivals(self) -> dict[TopicName, list[Arrival]]:
        """What the site has got, by topic."""
        return self._site.arrivals

    def publish(self, info: TopicInfo, spec: TopicSpec) -> OutChannel:
        return self.robot.publish(info, spec, now=self.network.now)

    def unpublish(self, channel: OutChannel) -> None:
        self.robot.unpublish(channel, now=self.network.now)

    def feed(self, messages: Iterable[tuple[float, OutChannel, bytes]]) -> None:
        """(time, channel, body), in the order of their times; those of a channel that was closed are left out."""
        queue = iter(messages)

        def arm() -> None:
            entry = next(queue, None)
            if entry is not None:
                at_s, channel, body = entry
                at_s = max(at_s, self.network.elapsed_s)
                self.network.at(at_s, lambda now: give(channel, body, now), node=self.robot_node)

        def give(channel: OutChannel, body: bytes, now: float) -> None:
            if self.robot.link.sender.channels.get(channel.channel_id) is channel:
                self.robot.send(channel, body, int(now * 1e9), now=now)
            arm()

        arm()

    def every(self, period_s: float, call: Callable[[float], object]) -> None:
        """Call again and again with the robot's clock."""
        self.network.every(period_s, call, node=self.robot_node)

    def run(self, until_s: float) -> None:
        self.network.run_until(until_s)
