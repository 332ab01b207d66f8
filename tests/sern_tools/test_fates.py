"""Fates by seq, end to end over bad links in virtual time: every message has one, and one that vanishes is found."""

import zlib

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sern_core.link.link import Link
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import ClientName, DropReason, PriorityClass
from sern_sim.models import LinkModel
from sern_tools.fates import Fate, Fates, Route, fates
from sern_tools.message_log import Delivery, Offer, TopicLog
from tests.exploring import cases
from tests.world import SimClient, World, spec

TOPIC = "/robot/points"
ROUTE = Route("robot", "relay", "site")


class Recorder:
    """`sern_core.vocabulary.fates.Fates` of one place, into the log of one topic."""

    def __init__(self, log: TopicLog, place: str) -> None:
        self.log = log
        self.place = place

    def dropped(self, stream: StreamInfo, seq: int, reason: DropReason, peer: ClientName) -> None:
        self._put(self.log.dropped, stream, seq, str(reason), peer)

    def discarded(self, stream: StreamInfo, seq: int, reason: DropReason, peer: ClientName) -> None:
        self._put(self.log.discarded, stream, seq, str(reason), peer)

    def held(self, stream: StreamInfo, seq: int, peer: ClientName, *, exposed: bool) -> None:
        self._put(self.log.held, stream, seq, "unconfirmed" if exposed else "", peer)

    def received(self, stream: StreamInfo, message: Message, peer: ClientName) -> None:
        if stream.id.topic == self.log.topic:
            self.log.received.setdefault(self.place, set()).add(message.seq)

    def _put(
        self, table: dict[tuple[str, str], dict[int, str]], stream: StreamInfo, seq: int, reason: str, peer: str
    ) -> None:
        if stream.id.topic == self.log.topic:
            table.setdefault((self.place, peer), {})[seq] = reason


class Stage:
    """A robot that sends 300 messages through a relay to a site, all over bad links; sessions break on the way."""

    def __init__(
        self,
        *,
        seed: int,
        loss: float,
        rate_bps: float,
        reliable: bool,
        lifespan_s: float | None,
        size: int,
        depth: int,
    ) -> None:
        self.log = TopicLog(TOPIC, "bulk", "robot")
        self.reliable = reliable
        self.world = World(seed=seed, lossless=False)
        self.world.relay.hub.forwarding.fates = Recorder(self.log, "relay")
        model = LinkModel(rate_bps=rate_bps, delay_s=0.02, jitter_s=0.005, loss=loss)
        self.robot = self.world.client("robot", model)
        self.site = self.world.client("site", model, patterns=[".*"])
        for client in (self.robot, self.site):
            client.core.link.end.fates = Recorder(self.log, client.name)
        self.channel = self.robot.publish(
            TOPIC, spec(PriorityClass.BULK, reliable=reliable, lifespan_s=lifespan_s, depth=depth)
        )
        self.size = size

    def play(self) -> Fates:
        world = self.world
        world.until(lambda: self.channel.wanted)
        stop = self.robot.every(0.02, self.channel, bytes(self.size))
        for client in (self.robot, self.site, self.robot):
            world.run(1.5)
            self._cut(client, 0.4)
        world.run(1.0)
        stop()
        world.run(20.0)
        self.robot.core.unpublish(self.channel, now=self.robot.now)
        world.run(2.0)
        world.validate()
        for link in world.relay.hub.links.values():
            for channel in link.sender.channels.values():
                for out in channel.undelivered():
                    Recorder(self.log, "relay").held(channel.stream, out.seq, link.peer, exposed=out.exposed)
        return self.fates()

    def _cut(self, client: SimClient, seconds: float) -> None:
        client.core.link.disconnected(now=client.now)
        self.world.run(seconds)
        client.core.link.connected(now=client.now)

    def fates(self) -> Fates:
        log = self.log
        for topic, seq in self.robot.sent:
            if topic == TOPIC:
                log.offers[seq] = Offer(0, seq, self.size, zlib.crc32(bytes(self.size)))
        log.deliveries = [Delivery(0, seq, self.size, 0, 0, None) for seq in self.site.seqs(TOPIC)]
        log.expired = dict.fromkeys(self.site.expired_seqs[TOPIC], "expired")
        return fates(log, ROUTE, reliable=self.reliable)


@settings(max_examples=cases(15), phases=(Phase.explicit, Phase.generate))
@given(
    seed=st.integers(0, 1000),
    loss=st.sampled_from([0.0, 0.05, 0.3]),
    rate_bps=st.sampled_from([2e5, 2e6]),
    reliable=st.booleans(),
    lifespan_s=st.sampled_from([None, 0.1, 1.0]),
    size=st.sampled_from([50, 5_000]),
    depth=st.sampled_from([1, 5]),
)
def test_every_message_has_one_fate(
    seed: int, loss: float, rate_bps: float, reliable: bool, lifespan_s: float | None, size: int, depth: int
) -> None:
    stage = Stage(
        seed=seed, loss=loss, rate_bps=rate_bps, reliable=reliable, lifespan_s=lifespan_s, size=size, depth=depth
    )
    found = stage.play()
    assert found.faults == {}
    delivered = len(set(stage.site.seqs(TOPIC)))
    assert len(stage.log.offers) == delivered + found.dropped().total() + found.waiting
    assert found.decided[Fate("site", "delivered")] == delivered


def test_what_a_sender_could_not_know_is_decided() -> None:
    stage = Stage(seed=3, loss=0.3, rate_bps=2e5, reliable=False, lifespan_s=1.0, size=5_000, depth=1)
    found = stage.play()
    unsure = [
        found.by_seq[seq]
        for seq, reason in stage.log.dropped.get(("robot", "relay"), {}).items()
        if reason == "unconfirmed"
    ]
    assert found.faults == {}
    assert any(fate.place != "robot" for fate in unsure), "of some the next place knows more"


@pytest.mark.parametrize("where", ["robot", "relay", "site"])
def test_a_message_that_vanishes_is_found(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fault is put into the program: one message is acknowledged, and goes nowhere."""
    stage = Stage(seed=5, loss=0.05, rate_bps=2e6, reliable=False, lifespan_s=None, size=50, depth=5)
    vanished: list[int] = []

    def once(seq: int) -> bool:
        if vanished or seq < 100:
            return False
        vanished.append(seq)
        return True

    if where == "robot":
        submit = OutChannel.submit

        def forgets(self: OutChannel, message: Message, *, now: float, forced: bool = False) -> bool:
            if message.stream.topic == TOPIC and not forced and once(message.seq):
                self.skip_to(message.seq + 1)
                return True
            return submit(self, message, now=now, forced=forced)

        monkeypatch.setattr(OutChannel, "submit", forgets)
    else:
        handler = stage.world.relay.hub.link_handler if where == "relay" else stage.site.core
        on_message = handler.on_message

        def loses(link: Link, stream: object, message: Message, *, now: float) -> None:
            if message.stream.topic != TOPIC or not once(message.seq):
                on_message(link, stream, message, now=now)  # type: ignore[arg-type]

        monkeypatch.setattr(handler, "on_message", loses)
    found = stage.play()
    assert vanished and found.faults.keys() == set(vanished)
