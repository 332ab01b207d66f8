"""A site that fetches what its robot has kept, over a thin link in virtual time, beside what comes live.

The link is between robot and relay. A pose at 50 Hz, and clouds that take three tenths of the link; commands go the
other way. What is kept is asked for and answered with the messages of `sern_core.site.spool`, as the daemons do it.
"""

from dataclasses import dataclass, replace
from typing import Final

from sern_core.site.spool import (
    ALWAYS,
    FETCHED,
    SETTLE_S,
    Request,
    Span,
    TopicFetch,
    decode_request,
    encode_request,
)
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.world import SimClient, World, spec

DATAGRAM_BYTES: Final = 1171 + 60 + 28
"""A full datagram on the link, headers included."""
OVERHEAD_BYTES: Final = 28
CONNECTED_S: Final = 2.0
SETTLED_S: Final = 15.0
RUN_S: Final = 75.0
POSE, CLOUD, COMMAND = "/robot/odom", "/robot/points", "/robot/cmd_vel"
FETCH, ANSWER = "/robot/kept/_fetch/site", "/robot/kept/_fetched/site"
KEPT_BYTES: Final = 30_000
CLOUD_BYTES: Final = 20_000
CLOUD_SHARE: Final = 0.3
WINDOW_BYTES: Final = 256 * 2**10
BOOT: Final = 7


@dataclass(frozen=True)
class ThinPath:
    """One way of the link takes `delay_s`."""

    rate_bps: float
    delay_s: float
    loss: float = 0.0

    @property
    def datagram_s(self) -> float:
        """What a full datagram takes of the link."""
        return 8 * DATAGRAM_BYTES / self.rate_bps


@dataclass
class Played:
    """A run that is over."""

    path: ThinPath
    robot: SimClient
    site: SimClient
    fetched: list[int]
    wire_bytes: int
    """What the robot has sent after the link was found out, headers included."""

    def ages_s(self, topic: str) -> list[float]:
        """Ages of what arrived once the link was found out, youngest first."""
        sender, receiver = (self.site, self.robot) if topic == COMMAND else (self.robot, self.site)
        begin_s = self.site.world.network.start_s + SETTLED_S
        return sorted(got.at_s - sender.sent[topic, got.seq][0] for got in receiver.on(topic) if got.at_s > begin_s)

    @property
    def wire_bps(self) -> float:
        return 8 * self.wire_bytes / (RUN_S - SETTLED_S)

    @property
    def fetched_bps(self) -> float:
        """Bodies that were fetched once the link was found out."""
        begin_s = self.site.world.network.start_s + SETTLED_S
        came = sum(got.at_s > begin_s and len(got.body) > FETCHED.size for got in self.site.on(ANSWER))
        return 8 * KEPT_BYTES * came / (RUN_S - SETTLED_S)


def idle_share(alone: Played, beside: Played) -> float:
    """The share of what the live traffic leaves of the link, headers included, that the bodies of a fetch take."""
    return beside.fetched_bps / (alone.path.rate_bps - alone.wire_bps)


class _Robot:
    """Answers what it is asked for from what it has kept: every seq there is."""

    def __init__(self, client: SimClient) -> None:
        self._client = client
        self._answers: OutChannel | None = None
        self._read = 0
        self._left: list[tuple[Request, list[int]]] = []

    def work(self, _now: float) -> None:
        client = self._client
        asked = client.on(FETCH)
        for got in asked[self._read :]:
            request = decode_request(got.body)
            self._left.append((request, [seq for a, b in request.runs for seq in range(a, b + 1)]))
        self._read = len(asked)
        if self._answers is None:
            fetched = spec(PriorityClass.BULK, reliable=True, depth=10_000)
            self._answers = client.publish(ANSWER, replace(fetched, background=True))
        while self._left and self._answers.retained_bytes < WINDOW_BYTES:
            request, seqs = self._left[0]
            if seqs:
                client.send(self._answers, FETCHED.pack(request.boot, seqs.pop(0)) + bytes(KEPT_BYTES))
            else:
                client.send(self._answers, FETCHED.pack(0, request.number))
                del self._left[0]


class _Site:
    """Asks for whatever is missing."""

    def __init__(self, client: SimClient, messages: int) -> None:
        self.fetched: list[int] = []
        self._client = client
        self._asking: OutChannel | None = None
        self._read = 0
        self._fetch = TopicFetch(1)
        span = Span(BOOT, 1, messages, 1, 2, messages, messages * KEPT_BYTES, False)
        for at_s in (client.now - SETTLE_S, client.now):
            self._fetch.reported([span], now=at_s)

    def work(self, _now: float) -> None:
        client = self._client
        came = client.on(ANSWER)
        for got in came[self._read :]:
            boot, number = FETCHED.unpack_from(got.body)
            if not boot:
                self._fetch.done(number)
            elif self._fetch.accept(boot, number):
                self._fetch.recorded(boot, number)
                self.fetched.append(number)
        self._read = len(came)
        while (request := self._fetch.ask([ALWAYS], now=client.now)) is not None:
            if self._asking is None:
                self._asking = client.publish(FETCH, spec(PriorityClass.STATE, reliable=True, depth=100))
            client.send(self._asking, encode_request(request))


def play(path: ThinPath, *, fetch: bool, clouds: bool = True, messages: int = 100_000) -> Played:
    """One run, with a fetch beside what is live or without."""
    world = World(lossless=False)
    model = LinkModel(rate_bps=path.rate_bps, delay_s=path.delay_s, overhead_bytes=OVERHEAD_BYTES, loss=path.loss)
    robot, site = world.client("robot", model), world.client("site", patterns=["/robot/.*"])
    robot.subscribe(COMMAND, FETCH)
    pose = robot.publish(POSE, spec(PriorityClass.CONTROL))
    cloud = robot.publish(CLOUD, spec(PriorityClass.BULK))
    command = site.publish(COMMAND, spec(PriorityClass.CONTROL, lifespan_s=1.0))
    robot.every(0.02, pose, bytes(100))
    site.every(0.1, command, bytes(50))
    if clouds:
        robot.every(8 * CLOUD_BYTES / (CLOUD_SHARE * path.rate_bps), cloud, bytes(CLOUD_BYTES))
    fetching = _Site(site, messages)
    world.run(CONNECTED_S)
    if fetch:
        world.network.every(0.02, _Robot(robot).work)
        world.network.every(0.02, fetching.work)
    world.run(SETTLED_S - CONNECTED_S)
    before = robot.core.link.observe(now=robot.now).wire_bytes
    world.run(RUN_S - SETTLED_S)
    after = robot.core.link.observe(now=robot.now).wire_bytes
    return Played(path, robot, site, fetching.fetched, after - before)
