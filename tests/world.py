"""A relay core and client cores in the virtual-time network, with a record of everything promised."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

from sern_core.access import AccessRule, AccessTable
from sern_core.client import ClientCore
from sern_core.hub import Hub, HubParams, HubPort
from sern_core.message import Message, StreamInfo, TopicInfo, TopicSpec
from sern_core.params import LinkParams, SchedulerParams
from sern_core.queues import OutChannel
from sern_core.types import (
    ClientName,
    DropReason,
    Durability,
    Encoding,
    PriorityClass,
    Reliability,
    TopicName,
)
from sern_sim.models import LinkModel
from sern_sim.network import Hop, Network
from sern_sim.ports import Port

OPEN_ACCESS = AccessTable([AccessRule(client=".*", publish=(".*",), subscribe=(".*",))])


def spec(
    priority: PriorityClass = PriorityClass.STATE,
    *,
    reliable: bool = False,
    latched: bool = False,
    depth: int = 1,
    lifespan_s: float | None = None,
    max_rate_hz: float | None = None,
    retention_s: float = 600.0,
    max_queue_bytes: int = 32 * 2**20,
    many_writers: bool = False,
) -> TopicSpec:
    return TopicSpec(
        priority=priority,
        weight=(10.0, 3.0, 1.0)[priority],
        reliability=Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
        depth=depth,
        lifespan_s=lifespan_s,
        max_rate_hz=max_rate_hz,
        retention_s=retention_s,
        max_queue_bytes=max_queue_bytes,
        many_writers=many_writers,
    )


@dataclass(slots=True)
class Got:
    """One message as it was delivered."""

    topic: str
    seq: int
    body: bytes
    age_s: float
    at_s: float
    replay: bool


@dataclass
class SimClient:
    """A client core as a node of the network; it records what it is told."""

    name: ClientName
    core: ClientCore = field(init=False)
    got: list[Got] = field(default_factory=list)
    expired_seqs: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    skipped_count: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    dropped_out: list[tuple[str, int, DropReason]] = field(default_factory=list)
    refusals: list[tuple[str, str]] = field(default_factory=list)
    rejections: list[tuple[str, str]] = field(default_factory=list)
    opened: list[StreamInfo] = field(default_factory=list)
    closed: list[StreamInfo] = field(default_factory=list)
    wants: dict[str, bool] = field(default_factory=dict)
    ups: int = 0

    def start(
        self, now: float, *, boot: int, lossless: bool, link: LinkParams, scheduler: SchedulerParams
    ) -> "SimClient":
        self.core = ClientCore(
            name=self.name, boot=boot, events=self, link=link, scheduler=scheduler, now=now, lossless=lossless
        )
        return self

    def ports(self) -> list[Port]:
        return [self.core.link]

    # ClientEvents
    def link_up(self, *, resumed: bool) -> None:
        self.ups += 1

    def link_down(self, reason: str) -> None: ...

    def rejected(self, code: str, text: str) -> None:
        self.rejections.append((code, text))

    def stream_opened(self, stream: StreamInfo) -> None:
        self.opened.append(stream)

    def stream_closed(self, stream: StreamInfo) -> None:
        self.closed.append(stream)

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        self.got.append(Got(stream.id.topic, message.seq, message.body, now - message.born_s, now, message.replay))

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        self.expired_seqs[stream.id.topic].append(seq)

    def skipped(self, stream: StreamInfo, count: int) -> None:
        self.skipped_count[stream.id.topic] += count

    def send_dropped(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        self.dropped_out.append((stream.id.topic, seq, reason))

    def wanted(self, stream: StreamInfo, wanted: bool) -> None:
        self.wants[stream.id.topic] = wanted

    def publication_refused(self, stream: StreamInfo, code: str, text: str) -> None:
        self.refusals.append((code, text))

    # helpers
    def publish(self, topic: str, topic_spec: TopicSpec, now: float, definition: str = "") -> OutChannel:
        info = TopicInfo(TopicName(topic), "std_msgs/msg/String", Encoding.CDR, "RIHS01_0", definition)
        return self.core.publish(info, topic_spec, now=now)

    def on(self, topic: str) -> list[Got]:
        return [got for got in self.got if got.topic == topic]

    def seqs(self, topic: str) -> list[int]:
        return [got.seq for got in self.got if got.topic == topic]


class SimHub:
    """A relay core as a node."""

    def __init__(self, now: float, *, boot: int, lossless: bool, link: LinkParams, access: AccessTable) -> None:
        self.refusals: list[tuple[str, str]] = []
        self.hub = Hub(
            name=ClientName("relay"),
            boot=boot,
            access=access,
            known=lambda _name: True,
            events=self,
            link=link,
            scheduler=SchedulerParams(),
            params=HubParams(),
            wall_ns=lambda t: int(t * 1e9),
            now=now,
            lossless=lossless,
        )
        self.sides: dict[ClientName, HubPort] = {}

    def port(self, client: ClientName) -> HubPort:
        return self.sides.setdefault(client, HubPort(self.hub, client))

    def ports(self) -> list[Port]:
        return [*self.sides.values()]

    def client_up(self, client: ClientName, *, resumed: bool) -> None: ...

    def client_down(self, client: ClientName, reason: str) -> None: ...

    def stream_added(self, stream: StreamInfo) -> None: ...

    def stream_removed(self, stream: StreamInfo) -> None: ...

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None: ...

    def refused(self, client: ClientName, code: str, text: str) -> None:
        self.refusals.append((code, text))


class World:
    """One relay and any number of clients, each behind a link of its own."""

    def __init__(
        self, seed: int = 1, *, link: LinkParams | None = None, access: AccessTable = OPEN_ACCESS, lossless: bool = True
    ) -> None:
        self.network = Network(seed)
        self.link = link or LinkParams()
        self.access = access
        self.lossless = lossless
        self._boots = 1000
        self.relay = self._new_relay()
        self.clients: dict[str, SimClient] = {}
        self.hops: dict[str, Hop] = {}
        self.network.every(1.0, lambda now: self.relay.hub.sweep(now=now))

    @property
    def now(self) -> float:
        return self.network.now

    def _boot(self) -> int:
        self._boots += 1
        return self._boots

    def _new_relay(self) -> SimHub:
        return SimHub(self.now, boot=self._boot(), lossless=self.lossless, link=self.link, access=self.access)

    def client(
        self,
        name: str,
        up: LinkModel | None = None,
        down: LinkModel | None = None,
        *,
        patterns: Iterable[str] = (),
        scheduler: SchedulerParams | None = None,
    ) -> SimClient:
        """A client that connects now; `up` carries its traffic to the relay (a perfect wire by default)."""
        wire = LinkModel().as_stream() if self.lossless else LinkModel()
        client = SimClient(ClientName(name)).start(
            self.now,
            boot=self._boot(),
            lossless=self.lossless,
            link=self.link,
            scheduler=scheduler or SchedulerParams(),
        )
        client.core.subscribe(tuple(patterns), now=self.now)
        self.clients[name] = client
        self.hops[name] = self.network.join(
            client.core.link,
            client,
            self.relay.port(client.name),
            self.relay,
            up or wire,
            down or up or wire,
            name=name,
        )
        return client

    def restart_relay(self) -> None:
        """kill -9: a new process in its place that knows nothing."""
        old = self.relay
        self.relay = self._new_relay()
        pairs = [(old.sides[name], self.relay.port(name)) for name in old.sides]
        self.network.replace_node(old, self.relay, pairs)

    def run(self, seconds: float) -> None:
        self.network.run_for(seconds)

    def validate(self) -> None:
        self.relay.hub.validate()
        for client in self.clients.values():
            client.core.link.validate()
