"""A relay core and client cores in the virtual-time network, with a record of everything promised.

Every node has a clock of its own (offset and rate); what is recorded here is on the network's clock, the true one.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import NamedTuple

from sern_core.bodies.codecs import Coder, Work, raw_size
from sern_core.link.datagram import SentPing
from sern_core.link.link import Link
from sern_core.objects.feed import PERIOD_S
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import Hub, HubParams
from sern_core.relay.hub_port import HubPort
from sern_core.relay.traces import Traces
from sern_core.site.client import ClientCore
from sern_core.stream.decoding import DecodeRequest
from sern_core.stream.encoding import EncodeRequest
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.codec_names import DEFAULT_LOSSY, Compression, LossyParams
from sern_core.vocabulary.key_news import ClientKeys, KeyRevocation, RelayKeys
from sern_core.vocabulary.limits import PeerLimits
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import (
    ClientName,
    DropReason,
    Durability,
    Encoding,
    PriorityClass,
    Reliability,
    TopicName,
)
from sern_core.wire import framing
from sern_sim.hop import Hop
from sern_sim.models import LinkModel
from sern_sim.network import Network
from sern_sim.ports import Port

OPEN_ACCESS = AccessTable([AccessRule(client=".*", publish=(".*",), subscribe=(".*",), replay=(".*",))])


def limited(**limits: int) -> LinkParams:
    """A link whose peer may cost no more than this (`PeerLimits`)."""
    return LinkParams(limits=PeerLimits(**limits))


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
    compression: Compression | None = None,
    lossy: tuple[Compression, ...] = (),
    lossy_params: LossyParams = DEFAULT_LOSSY,
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
        compression=compression,
        lossy=lossy,
        lossy_params=lossy_params,
    )


class Clock(NamedTuple):
    """A node's clock against the network's: `offset_s` ahead, and fast by `rate_ppm`."""

    offset_s: float = 0.0
    rate_ppm: float = 0.0

    def local(self, true_s: float) -> float:
        return self.offset_s + true_s * (1.0 + self.rate_ppm * 1e-6)

    def true(self, local_s: float) -> float:
        return (local_s - self.offset_s) / (1.0 + self.rate_ppm * 1e-6)


class ClockedPort:
    """A port whose node lives on another clock than the network's. `sent` is told every datagram that leaves."""

    def __init__(self, port: Port, clock: Clock) -> None:
        self.inner = port
        self.clock = clock
        self.sent: Callable[[bytes, float], object] | None = None

    @property
    def clock(self) -> Clock:
        return self._clock

    @clock.setter
    def clock(self, clock: Clock) -> None:
        self._clock = clock
        self._true = clock == Clock()

    @property
    def dirty(self) -> bool:
        return getattr(self.inner, "dirty", True)

    def receive(self, data: bytes, *, now: float) -> None:
        self.inner.receive(data, now=now if self._true else self._clock.local(now))

    def next_datagram(self, *, now: float) -> bytes | None:
        data = self.inner.next_datagram(now=now if self._true else self.clock.local(now))
        if data is not None and self.sent is not None:
            self.sent(data, now)
        return data

    def next_deadline(self) -> float | None:
        deadline_s = self.inner.next_deadline()
        if deadline_s is None or self._true:
            return deadline_s
        # A nanosecond late: converted back it must not lie before the deadline.
        return self.clock.true(deadline_s) + 1e-9

    def handle_timeout(self, *, now: float) -> None:
        self.inner.handle_timeout(now=self.clock.local(now))

    def connected(self, *, now: float) -> None:
        self.inner.connected(now=self.clock.local(now))

    def disconnected(self, *, now: float) -> None:
        self.inner.disconnected(now=self.clock.local(now))


class DeadPort:
    """Where datagrams arrive that nobody has the keys for."""

    def receive(self, data: bytes, *, now: float) -> None: ...

    def next_datagram(self, *, now: float) -> bytes | None:
        return None

    def next_deadline(self) -> float | None:
        return None

    def handle_timeout(self, *, now: float) -> None: ...

    def connected(self, *, now: float) -> None: ...

    def disconnected(self, *, now: float) -> None: ...


@dataclass(slots=True)
class Got:
    """One message as it was delivered. `age_s` is what the receiver thinks, `at_s` true time."""

    topic: str
    seq: int
    body: bytes
    age_s: float
    error_s: float
    at_s: float
    replay: bool
    stream: StreamId


class Dropped(NamedTuple):
    """A message of ours of which we were told that it was dropped."""

    topic: str
    seq: int
    reason: DropReason
    where: str


@dataclass
class SimClient:
    """A client core as a node of the network; it records what it is told. One object a process: a restarted client is
    another."""

    name: ClientName
    world: "World"
    clock: Clock = field(default_factory=Clock)
    core: ClientCore = field(init=False)
    port: ClockedPort = field(init=False)
    got: list[Got] = field(default_factory=list)
    turns: dict[StreamId, list[int]] = field(default_factory=lambda: defaultdict(list))
    """Seqs delivered or expired, by stream, in the order of their turns; -n for n that were skipped."""
    expired_seqs: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    skipped_count: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    sent: dict[tuple[str, int], tuple[float, bytes]] = field(default_factory=dict)
    """What was accepted from us, by topic and seq: true time and body."""
    refused: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    dropped_out: list[Dropped] = field(default_factory=list)
    refusals: list[tuple[str, str]] = field(default_factory=list)
    objects_refused: list[tuple[str, str]] = field(default_factory=list)
    denials: list[tuple[str, str]] = field(default_factory=list)
    """Subscriptions that the relay refused."""
    rejections: list[tuple[str, str]] = field(default_factory=list)
    opened: list[StreamInfo] = field(default_factory=list)
    closed: list[StreamInfo] = field(default_factory=list)
    wants: dict[str, list[bool]] = field(default_factory=lambda: defaultdict(list))
    ups: list[bool] = field(default_factory=list)
    """Whether each session was with the same relay process as the one before."""
    downs: list[str] = field(default_factory=list)
    undecodables: list[tuple[str, str]] = field(default_factory=list)
    more_ports: list[Port] = field(default_factory=list)
    lanes_closed: int = 0

    def start(
        self, *, boot: int, lossless: bool, link: LinkParams, scheduler: SchedulerParams, coder: Coder | None
    ) -> "SimClient":
        self.core = ClientCore(
            name=self.name,
            boot=boot,
            events=self,
            link=link,
            scheduler=scheduler,
            trace=DecisionTrace(),
            now=self.now,
            lossless=lossless,
            coder=coder,
        )
        self.port = ClockedPort(self.core.link, self.clock)
        return self

    @property
    def now(self) -> float:
        """Our own clock."""
        return self.clock.local(self.world.network.now)

    def ports(self) -> list[Port]:
        return [self.port, *self.more_ports]

    # ClientEvents
    def link_up(self, *, resumed: bool) -> None:
        self.ups.append(resumed)

    def link_down(self, reason: str) -> None:
        self.downs.append(reason)

    def lane_offered(self, parameters: framing.Envelope) -> None: ...

    def lane_closed(self) -> None:
        self.keys: list[RelayKeys] = []
        self.lanes_closed += 1

    def keys_told(self, keys: RelayKeys) -> None:
        self.keys.append(keys)

    def rejected(self, code: str, text: str) -> None:
        self.rejections.append((code, text))

    def stream_opened(self, stream: StreamInfo) -> None:
        self.opened.append(stream)

    def stream_closed(self, stream: StreamInfo) -> None:
        self.closed.append(stream)

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        true_s = self.world.network.now
        self.turns[stream.id].append(message.seq)
        self.got.append(
            Got(
                stream.id.topic,
                message.seq,
                message.body,
                now - message.born_s,
                message.error_s,
                true_s,
                message.replay,
                stream.id,
            )
        )

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        self.turns[stream.id].append(seq)
        self.expired_seqs[stream.id.topic].append(seq)

    def skipped(self, stream: StreamInfo, count: int) -> None:
        self.turns[stream.id].append(-count)
        self.skipped_count[stream.id.topic] += count

    def send_dropped(self, stream: StreamInfo, first: int, count: int, reason: DropReason, where: str) -> None:
        self.dropped_out += [Dropped(stream.id.topic, seq, reason, where) for seq in range(first, first + count)]

    def wanted(self, stream: StreamInfo, wanted: bool) -> None:
        self.wants[stream.id.topic].append(wanted)

    def publication_refused(self, stream: StreamInfo, code: str, text: str) -> None:
        self.refusals.append((code, text))

    def undecodable(self, stream: StreamInfo, problem: str) -> None:
        self.undecodables.append((stream.id.topic, problem))

    def object_refused(self, object_id: str, code: str, why: str) -> None:
        self.objects_refused.append((object_id, code))

    def subscription_refused(self, code: str, text: str) -> None:
        self.denials.append((code, text))

    def fault(self, error: Exception) -> None:
        self.world.fault(error)

    # helpers
    def publish(
        self, topic: str, topic_spec: TopicSpec, definition: str = "", *, type_name: str = "std_msgs/msg/String"
    ) -> OutChannel:
        info = TopicInfo(TopicName(topic), type_name, Encoding.CDR, "RIHS01_0", definition)
        return self.core.publish(info, topic_spec, now=self.now)

    def send(self, channel: OutChannel, body: bytes) -> bool:
        """Offer a message now; it is recorded under its seq if it is accepted."""
        seq = channel.next_seq
        if not self.core.send(channel, body, 0, now=self.now):
            self.refused[channel.stream.id.topic] += 1
            return False
        self.sent[channel.stream.id.topic, seq] = (self.world.network.now, body)
        return True

    def every(
        self, period_s: float, channel: OutChannel, body: Callable[[int], bytes] | bytes, *, first_s: float = 0.0
    ) -> Callable[[], None]:
        """Send every `period_s`, from `first_s` from now, until the function that this returns is called."""

        def tick(_now: float) -> None:
            self.send(channel, body if isinstance(body, bytes) else body(channel.next_seq))

        return self.world.network.every(period_s, tick, node=self, first_s=first_s).cancel

    def subscribe(self, *patterns: str) -> None:
        self.core.subscribe(patterns, now=self.now)

    def on(self, topic: str) -> list[Got]:
        return [got for got in self.got if got.topic == topic]

    def seqs(self, topic: str) -> list[int]:
        return [got.seq for got in self.got if got.topic == topic]


class SimPool:
    """One thread that encodes and decodes for a client, at so many bytes of raw body a second."""

    def __init__(self, client: SimClient, bytes_per_s: float) -> None:
        self.client = client
        self.bytes_per_s = bytes_per_s
        self.taken: list[Work] = []
        self._free_s = 0.0

    def take(self, work: Work) -> None:
        network = self.client.world.network
        self.taken.append(work)
        nbytes = 0
        if isinstance(work, EncodeRequest | DecodeRequest):
            nbytes = raw_size(work.message.codec, work.message.body)
        self._free_s = max(self._free_s, network.now) + nbytes / self.bytes_per_s

        def done(_now: float) -> None:
            work.run()
            work.done(now=self.client.now)

        network.after(self._free_s - network.now, done, node=self.client)


class SimHub:
    """A relay core as a node."""

    def __init__(self, world: "World", *, boot: int, name: str = "relay", access: AccessTable | None = None) -> None:
        self.world = world
        self.clock = world.relay_clock
        self.refusals: list[tuple[str, str]] = []
        self.client_keys: list[tuple[ClientName, ClientKeys]] = []
        self.fed: list[Message] = []
        self.turns: list[tuple[ClientName, ClientName, bool]] = []
        """Clients that went over from a peer, or to it."""
        self.revoked_keys: list[tuple[ClientName, KeyRevocation]] = []
        self.compared: list[tuple[ClientName, bool]] = []
        """Peers, and whether they have our rules."""
        self.hub = Hub(
            name=ClientName(name),
            boot=boot,
            access=access or world.access,
            known=lambda _name: True,
            events=self,
            link=world.link,
            scheduler=SchedulerParams(),
            params=world.hub_params,
            traces=Traces(),
            wall_ns=lambda t: int(t * 1e9),
            now=self.now,
            lossless=world.lossless,
        )
        self.sides: dict[ClientName, ClockedPort] = {}
        self._sides: list[tuple[HubPort, ClockedPort]] = []
        self.more_ports: list[Port] = []

    @property
    def now(self) -> float:
        return self.clock.local(self.world.network.now)

    def port(self, client: ClientName) -> ClockedPort:
        port = self.sides.get(client)
        if port is None:
            inner = HubPort(self.hub, client)
            port = self.sides[client] = ClockedPort(inner, self.clock)
            self._sides.append((inner, port))
        return port

    def peer_port(self, relay: str) -> ClockedPort:
        """The end of the hop to another relay."""
        inner = self.hub.add_peer(ClientName(relay))
        port = self.sides.get(inner.client)
        if port is None:
            port = self.sides[inner.client] = ClockedPort(inner, self.clock)
            self._sides.append((inner, port))
        return port

    def ports(self) -> list[Port]:
        return [*self.sides.values(), *self.more_ports]

    def take_dirty(self) -> list[Port]:
        """Only these ports are asked for more after an event on another."""
        sides = [side for port, side in self._sides if (port.link is not None or port.replies) and port.dirty]
        return [*sides, *self.more_ports]

    def links(self) -> Iterator[Link]:
        yield from self.hub.links.values()

    def lane_asked(self, client: ClientName, ciphers: list[str]) -> None: ...

    def lane_closed(self, client: ClientName) -> None: ...

    def keys_asked(self, client: ClientName) -> None: ...

    def keys_told(self, client: ClientName, keys: ClientKeys) -> None:
        self.client_keys.append((client, keys))

    def client_up(self, client: ClientName, *, resumed: bool) -> None: ...

    def client_down(self, client: ClientName, reason: str) -> None: ...

    def peer_up(self, peer: ClientName) -> None: ...

    def peer_down(self, peer: ClientName, reason: str) -> None: ...

    def went_over(self, client: ClientName, peer: ClientName, *, came: bool) -> None:
        self.turns.append((client, peer, came))

    def revoked(self, peer: ClientName, revocations: Sequence[KeyRevocation]) -> None:
        self.revoked_keys += [(peer, each) for each in revocations]

    def rules_compared(self, peer: ClientName, *, same: bool) -> None:
        self.compared.append((peer, same))

    def stream_added(self, stream: StreamInfo) -> None: ...

    def stream_removed(self, stream: StreamInfo) -> None: ...

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        self.fed.append(message)

    def refused(self, client: ClientName, code: str, text: str) -> None:
        self.refusals.append((code, text))

    def fault(self, client: ClientName | None, error: Exception) -> None:
        self.world.fault(error)


class World:
    """One relay and any number of clients, each behind a link of its own."""

    def __init__(
        self,
        seed: int = 1,
        *,
        link: LinkParams | None = None,
        access: AccessTable = OPEN_ACCESS,
        lossless: bool = True,
        hub_params: HubParams | None = None,
        relay_clock: Clock | None = None,
        encode_bytes_per_s: float | None = None,
        compress: bool = False,
    ) -> None:
        """`compress`: clients compress what they publish; `encode_bytes_per_s`: the speed of it for large bodies."""
        self.compress = compress
        self.encode_bytes_per_s = encode_bytes_per_s
        self.network = Network(seed)
        self.link = link or LinkParams()
        self.access = access
        self.lossless = lossless
        self.hub_params = hub_params or HubParams()
        self.relay_clock = relay_clock or Clock()
        self.expected_faults: tuple[type[Exception], ...] = ()
        self.faults: list[Exception] = []
        self._boots = Random(seed)
        self.relay = SimHub(self, boot=self._boot())
        self.clients: dict[str, SimClient] = {}
        self.hops: dict[str, Hop] = {}
        self.network.every(1.0, self._sweep)

    def _sweep(self, _now: float) -> None:
        hub, now = self.relay.hub, self.relay.now
        hub.sweep(now=now)
        while hub.lapse(now=now):
            pass

    def tell_objects(self) -> None:
        """From now on relay and clients tell ten times a second what has changed of their objects, as daemons do."""

        def pump(_now: float) -> None:
            self.relay.hub.tell_objects(now=self.relay.now)
            for client in self.clients.values():
                client.core.objects.pump(now=client.now)

        self.network.every(PERIOD_S, pump)

    def fault(self, error: Exception) -> None:
        """What a core tells its shell of errors that nobody expects: a test that expects one says so."""
        self.faults.append(error)

    @property
    def now(self) -> float:
        return self.network.now

    def _boot(self) -> int:
        return self._boots.getrandbits(63)

    def _process(self, name: str, clock: Clock, scheduler: SchedulerParams, patterns: Iterable[str]) -> SimClient:
        client = SimClient(ClientName(name), self, clock)
        coder = Coder(max_bytes=self.link.max_message_bytes) if self.compress else None
        if coder is not None and self.encode_bytes_per_s is not None:
            coder.offload = SimPool(client, self.encode_bytes_per_s).take
        client.start(boot=self._boot(), lossless=self.lossless, link=self.link, scheduler=scheduler, coder=coder)
        client.subscribe(*patterns)
        self.clients[name] = client
        return client

    def client(
        self,
        name: str,
        up: LinkModel | None = None,
        down: LinkModel | None = None,
        *,
        patterns: Iterable[str] = (),
        scheduler: SchedulerParams | None = None,
        clock: Clock | None = None,
    ) -> SimClient:
        """A client that connects now; `up` carries its traffic to the relay (a perfect wire by default)."""
        wire = LinkModel().as_stream() if self.lossless else LinkModel()
        client = self._process(name, clock or Clock(), scheduler or SchedulerParams(), patterns)
        relay_port = self.relay.port(client.name)
        self.hops[name] = self.network.join(
            client.port, client, relay_port, self.relay, up or wire, down or up or wire, name=name
        )
        return client

    def restart_client(self, name: str, *, patterns: Iterable[str] | None = None) -> SimClient:
        """kill -9 of a client: a new process in its place that knows nothing. Returns it; the old one is the record."""
        old = self.clients[name]
        wanted = old.core.subscription.patterns if patterns is None else patterns
        new = self._process(name, old.clock, SchedulerParams(), wanted)
        self.network.replace_node(old, new, [(old.port, new.port)])
        return new

    def restart_relay(self) -> None:
        """kill -9: a new process in its place that knows nothing."""
        old = self.relay
        self.relay = SimHub(self, boot=self._boot())
        pairs: list[tuple[Port, Port]] = [(old.sides[name], self.relay.port(name)) for name in old.sides]
        for port in old.more_ports:  # lanes whose keys nobody has any more
            self.relay.more_ports.append(DeadPort())
            pairs.append((port, self.relay.more_ports[-1]))
        self.network.replace_node(old, self.relay, pairs)

    def check_faults(self) -> None:
        """Raises what a core met and nobody expected (`expected_faults`)."""
        unexpected = [error for error in self.faults if not isinstance(error, self.expected_faults)]
        if unexpected:
            raise AssertionError("an error inside a core") from unexpected[0]

    def run(self, seconds: float) -> None:
        self.network.run_for(seconds)
        self.check_faults()

    def until(self, condition: Callable[[], object], *, within_s: float = 60.0, what: str = "condition") -> float:
        taken_s = self.network.run_until_true(condition, within_s=within_s, what=what)
        self.check_faults()
        return taken_s

    def links(self) -> Iterator[Link]:
        yield from (client.core.link for client in self.clients.values())
        yield from self.relay.links()

    def up(self) -> set[ClientName]:
        """Clients with a session, as the relay sees it."""
        return {client for client, link in self.relay.hub.links.items() if link.established}

    def quiet(self) -> bool:
        """Everybody is connected, and nothing is left to send, to acknowledge or to confirm."""
        for link in self.links():
            if not link.established or link.control.out.retained:
                return False
            if any(type(item) is not SentPing for packet in link.lane.flight.packets.values() for item in packet.items):
                return False
            for channel in link.sender.channels.values():
                if channel.retained or (channel.wanted is not False and (channel.queue or channel.flying)):
                    return False
        return True

    def watch(self, period_s: float = 0.1) -> "World":
        """Validate everything again and again while the world runs."""
        self.network.every(period_s, lambda _now: self.validate())
        return self

    def validate(self) -> None:
        self.relay.hub.validate()
        for client in self.clients.values():
            client.core.link.validate()
            client.core.trace.validate()
