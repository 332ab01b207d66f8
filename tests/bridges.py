"""A bridge with a core of its own, over any endpoint, without a link: what it tells its shell is kept."""

from collections.abc import Sequence
from typing import Any

from sern_client.bridge import Bridge
from sern_client.endpoints.base import Difference, Held, Sink, TopicEvents
from sern_client.site import Site
from sern_core.site.client import ClientCore
from sern_core.site.client_events import ClientEvents
from sern_core.topics.rules import Discovery, DiscoveryMode, RuleSet, TopicRule
from sern_core.vocabulary.key_news import RelayKeys
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_core.wire import framing
from sern_runtime.message_log import MessageLog


class FakePublisher:
    """Keeps what is published. `error` is raised by the next call of anything."""

    def __init__(self, info: TopicInfo) -> None:
        self.info = info
        self.bodies: list[bytes] = []
        self.left_s: list[float] = []
        self.closed = False
        self.error: Exception | None = None

    def _fail(self) -> None:
        error, self.error = self.error, None
        if error is not None:
            raise error

    def publish(self, body: bytes, stamp_ns: int) -> None:
        raise AssertionError("it may keep messages back, so it is told for how long")

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        self._fail()
        self.bodies.append(body)
        self.left_s.append(left_s)

    def close(self) -> None:
        self.closed = True
        self._fail()


class FakeSubscription:
    """One of a local topic; `sink` is where its messages go."""

    def __init__(self, sink: Sink) -> None:
        self.sink = sink
        self.closed = False

    def close(self) -> None:
        self.closed = True


class FakeEndpoint:
    """An endpoint whose nodes are the test: it keeps what is asked of it. What is in `refusals` is raised for a name by
    `subscribe` and `advertise`."""

    encoding: Encoding | None = None
    exhausted = False

    def __init__(self) -> None:
        self.subscriptions: list[tuple[TopicName, FakeSubscription]] = []
        self.publishers: list[FakePublisher] = []
        self.interests: list[tuple[TopicName, bool]] = []
        self.refusals: dict[str, Exception] = {}
        self.differences: list[Difference] = []
        self.held = Held()
        self.events: TopicEvents | None = None

    async def start(self, events: TopicEvents) -> None:
        self.events = events

    async def stop(self) -> None:
        self.events = None

    def subscribe(self, name: TopicName, sink: Sink) -> FakeSubscription:
        if name in self.refusals:
            raise self.refusals[name]
        self.subscriptions.append((name, FakeSubscription(sink)))
        return self.subscriptions[-1][1]

    def advertise(self, info: TopicInfo) -> FakePublisher:
        if info.name in self.refusals:
            raise self.refusals[info.name]
        self.publishers.append(FakePublisher(info))
        return self.publishers[-1]

    def interest(self, name: TopicName, wanted: bool) -> None:
        self.interests.append((name, wanted))

    def validate(self, held: Held) -> list[Difference]:
        self.held = held
        return self.differences

    @property
    def open(self) -> dict[TopicName, FakeSubscription]:
        """The subscriptions that are open, by local name; one of each."""
        found = [(name, each) for name, each in self.subscriptions if not each.closed]
        assert len(dict(found)) == len(found)
        return dict(found)


class Shell:
    """Keeps what it is told of the link, and counts kicks."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.faults: list[Exception] = []
        self.kicks = 0

    def kick(self) -> None:
        self.kicks += 1

    def link_up(self) -> None:
        self.said.append("up")

    def link_down(self, reason: str) -> None:
        self.said.append(f"down: {reason}")

    def lane_offered(self, parameters: framing.Envelope) -> None:
        self.said.append(f"lane offered: {parameters['t']}")

    def lane_closed(self) -> None:
        self.said.append("lane closed")

    def keys_told(self, keys: RelayKeys) -> None:
        self.said.append(f"keys: {', '.join(keys.relay)}")

    def fault(self, error: Exception) -> None:
        self.faults.append(error)


def bridge_of(
    endpoint: Any,
    rules: Sequence[TopicRule] = (),
    mode: DiscoveryMode = DiscoveryMode.MANUAL,
    *,
    name: str = "site",
    namespace: str = "/",
    shell: Shell | None = None,
    link: LinkParams | None = None,
    boot: int = 1,
    now: float = 0.0,
    frame_prefix: str | None = None,
    log: MessageLog | None = None,
    **options: Any,
) -> Bridge:
    """The bridge of a client; `options` are further ones of `Bridge`."""
    shell = shell or Shell()

    def make_core(events: ClientEvents) -> ClientCore:
        return ClientCore(
            name=ClientName(name), boot=boot, events=events, link=link or LinkParams(), scheduler=SchedulerParams(),
            now=now,
        )  # fmt: skip

    site = Site(endpoint, RuleSet(tuple(rules)), namespace, kick=shell.kick, frame_prefix=frame_prefix, log=log)
    return Bridge(site, make_core, Discovery(mode), shell, **options)
