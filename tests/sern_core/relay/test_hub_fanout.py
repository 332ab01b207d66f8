"""The relay tells subscribers of a stream in slices: everybody gets all of it, in order, whatever happens meanwhile."""

from random import Random

import pytest

from sern_core.relay.hub_events import Relayed
from sern_core.vocabulary.limits import LIMITS
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import ClientName, TopicName
from tests.exploring import seeds
from tests.fuzz.test_hostile_peer import Hostile, _whole
from tests.world import World, limited

READERS = 300
A_SLICE = LIMITS.slice_us // LIMITS.channel_us + 1


def reading(world: World, count: int) -> list[Hostile]:
    readers = [Hostile(world, f"reader{number:03}") for number in range(count)]
    for reader in readers:
        wants(reader, "/robot/.*")
    return readers


def wants(reader: Hostile, *patterns: str) -> None:
    reader.control({"t": "subscribe", "patterns": list(patterns), "more": False})


def due_s(peer: Hostile) -> float | None:
    link = peer.hub.links.get(peer.name)
    times = (None if link is None else link.reading.due_s, peer.hub.matching.due_s.get(peer.name))
    return min((at_s for at_s in times if at_s is not None), default=None)


def turn(peer: Hostile) -> None:
    """The relay goes on with what this peer has said, or wants."""
    at_s = due_s(peer)
    assert at_s is not None
    peer.now = max(peer.now, at_s)
    peer.port.handle_timeout(now=peer.now)


def stream_of(peer: Hostile, topic: str) -> Relayed:
    return peer.hub.relayed[StreamId(peer.name, peer.boot, TopicName(topic))]


def held(relayed: Relayed, reader: Hostile) -> list[int]:
    """What the relay keeps of a reliable stream for a reader that never acknowledges anything."""
    return [out.seq for out in relayed.outs[reader.name][1].retained]


def test_one_announcement_for_many_is_told_in_slices() -> None:
    world = World()
    readers = reading(world, READERS)
    peer = Hostile(world)
    peer.announce(1, "/robot/a", reliable=True)
    peer.say(_whole(1, 1), _whole(1, 2))
    relayed = stream_of(peer, "/robot/a")
    sizes = [0]
    while relayed.waiting:
        peer.hub.validate()
        assert relayed.stream.delivered == 0, "read on before all were told"
        assert len(relayed.outs) - sizes[-1] <= A_SLICE
        sizes.append(len(relayed.outs))
        turn(peer)
    assert len(sizes) > READERS // A_SLICE
    while due_s(peer) is not None:
        turn(peer)
    assert list(relayed.outs) == sorted(reader.name for reader in readers)
    assert all(held(relayed, reader) == [1, 2] for reader in readers)
    peer.hub.validate()


def test_absent_clients_are_waited_for_in_slices() -> None:
    peer = Hostile()
    peer.hub.absent.known = lambda _client: True
    absent = tuple(f"site{number:02}" for number in range(48))
    for channel_id in range(1, 11):
        peer.announce(channel_id, f"/robot/t{channel_id}", reliable=True, required=absent)
        peer.say(_whole(channel_id, 1))
    slices = 0
    before = opened = 0
    while due_s(peer) is not None:
        peer.hub.validate()
        turn(peer)
        opened = sum(len(relayed.outs) for relayed in peer.hub.relayed.values())
        assert opened - before <= 2 * A_SLICE
        before = opened
        slices += 1
    assert slices > 5 and opened == 480
    for channel_id in range(1, 11):
        relayed = stream_of(peer, f"/robot/t{channel_id}")
        assert set(relayed.outs) == set(absent)
        assert all([out.seq for out in channel.retained] == [1] for _link, channel in relayed.outs.values())
    peer.hub.validate()


def test_the_origin_is_told_at_once_who_is_required() -> None:
    world = World()
    reading(world, READERS)
    peer = Hostile(world)
    peer.announce(1, "/robot/a", reliable=True)
    relayed = stream_of(peer, "/robot/a")
    assert relayed.waiting and relayed.stream.wanted
    (change,) = peer.hub.links[peer.name].answers._interest._changes.values()
    assert len(change.answer.required) == READERS
    while due_s(peer) is not None:
        turn(peer)
    (change,) = peer.hub.links[peer.name].answers._interest._changes.values()
    assert change.answer.required == tuple(relayed.outs)


def test_other_properties_are_told_in_slices_too() -> None:
    world = World()
    readers = reading(world, READERS)
    peer = Hostile(world)
    peer.announce(1, "/robot/a")
    while due_s(peer) is not None:
        turn(peer)
    peer.announce(1, "/robot/a", reliable=True)
    peer.say(_whole(1, 1))
    relayed = stream_of(peer, "/robot/a")
    assert 0 < sum(channel.reliable for _link, channel in relayed.outs.values()) <= A_SLICE
    peer.hub.validate()
    while due_s(peer) is not None:
        turn(peer)
        peer.hub.validate()
    assert all(held(relayed, reader) == [1] for reader in readers)


def test_whoever_leaves_meanwhile_is_not_told() -> None:
    world = World()
    readers = reading(world, READERS)
    peer = Hostile(world)
    peer.announce(1, "/robot/a", reliable=True)
    relayed = stream_of(peer, "/robot/a")
    hub, waiting = peer.hub, [reader for reader in readers if reader.name in relayed.waiting]
    wants(waiting[0], "/other")
    hub.forget(waiting[1].name, "revoked", now=peer.now)
    wants(waiting[2], "/other")
    wants(waiting[2], "/robot/a")  # it has changed its mind twice
    turn(waiting[2])
    hub.validate()
    assert waiting[2].name in relayed.outs
    while due_s(peer) is not None:
        turn(peer)
        hub.validate()
    assert relayed.outs.keys() == {reader.name for reader in readers} - {waiting[0].name, waiting[1].name}


@pytest.mark.parametrize("how", ["withdrawn", "revoked", "another boot"])
def test_a_stream_that_ends_meanwhile_is_told_to_nobody_else(how: str) -> None:
    world = World()
    reading(world, READERS)
    peer = Hostile(world)
    peer.announce(1, "/robot/a")
    hub, relayed = peer.hub, stream_of(peer, "/robot/a")
    told = len(relayed.outs)
    if how == "withdrawn":
        peer.control({"t": "retract", "ch": 1})  # it is read when all have been told
        hub.validate()
        assert len(relayed.outs) == told
        while due_s(peer) is not None:
            turn(peer)
    elif how == "revoked":
        hub.forget(peer.name, "revoked", now=peer.now)
    else:
        peer.boot, peer.control_seq, peer.tag = 78, 0, 2
        peer.hello(2)
        peer.announce(1, "/robot/b")
        while due_s(peer) is not None:
            turn(peer)
            hub.validate()
        assert len(stream_of(peer, "/robot/b").outs) == READERS
    hub.validate()
    assert not relayed.waiting and relayed not in hub.relayed.values()


def test_a_session_that_ends_meanwhile_goes_on_in_the_next() -> None:
    """Nothing of the next session is read before all have been told what the one before announced."""
    world = World()
    readers = reading(world, READERS)
    peer = Hostile(world)
    peer.announce(1, "/robot/a", reliable=True)
    relayed = stream_of(peer, "/robot/a")
    assert relayed.waiting
    peer.control_seq, peer.tag = 0, 2
    peer.hello(2)
    peer.announce(4, "/robot/a", reliable=True)
    peer.say(_whole(4, 1))
    while due_s(peer) is not None:
        assert not relayed.waiting or not relayed.stream.delivered
        turn(peer)
        peer.hub.validate()
    assert all(held(relayed, reader) == [1] for reader in readers)


def test_a_peer_without_a_connection_is_gone_on_with() -> None:
    world = World()
    readers = reading(world, READERS)
    peer = Hostile(world)
    peer.announce(1, "/robot/a")
    relayed = stream_of(peer, "/robot/a")
    peer.port.disconnected(now=peer.now)
    for second in range(1, 10):
        peer.hub.sweep(now=peer.now + second)
        peer.hub.validate()
    assert relayed.outs.keys() == {reader.name for reader in readers}


def test_a_message_that_is_read_all_the_same_reaches_all() -> None:
    """After an error of ours at the wrong moment nobody waits for the slices any more."""
    world = World()
    readers = reading(world, READERS)
    peer = Hostile(world)
    peer.announce(1, "/robot/a", reliable=True)
    relayed = stream_of(peer, "/robot/a")
    assert relayed.waiting
    peer.hub.links[peer.name].reading.due_s = None
    peer.say(_whole(1, 1))
    assert all(held(relayed, reader) == [1] for reader in readers)
    peer.hub.sweep(now=peer.now)
    peer.hub.validate()


def test_the_streams_of_a_process_that_was_started_anew_end_in_slices() -> None:
    world = World()
    readers = reading(world, 20)
    peer = Hostile(world)
    for channel in range(1, 41):
        peer.announce(channel, f"/robot/t{channel}", reliable=True)
        while due_s(peer) is not None:
            turn(peer)
    peer.say(_whole(1, 1))
    hub, kept = peer.hub, stream_of(peer, "/robot/t1")
    links = [hub.links[reader.name] for reader in readers]
    peer.boot, peer.control_seq, peer.tag = 78, 0, 2
    peer.hello(2)
    peer.announce(1, "/robot/t1", reliable=True)
    assert {identity.boot for identity in hub.relayed} == {78}
    left = [sum(len(link.sender.channels) for link in links)]
    while due_s(peer) is not None:
        hub.validate()
        assert left[-1] <= 20 or not stream_of(peer, "/robot/t1").outs, "a new stream is told before the old ones end"
        turn(peer)
        left.append(sum(len(link.sender.channels) for link in links))
        assert left[-2] - left[-1] <= LIMITS.slice_us // LIMITS.close_us + 1
        if len(left) == 2:
            hub.forget(readers[0].name, "revoked", now=peer.now)
            links.pop(0)
            left[-1] = sum(len(link.sender.channels) for link in links)
    hub.validate()
    assert len(left) > 3
    identity = kept.stream.stream.id
    assert all(len(link.sender.channels) == 2 and link.outgoing.by_stream[identity].retained for link in links), (
        "what waits is kept"
    )


class Party:
    """An origin and its readers, who do as they like; a slice is two channels."""

    def __init__(self, seed: int, link: LinkParams) -> None:
        self.random = Random(seed)
        self.world = World(link=link)
        self.hub = self.world.relay.hub
        self.readers = reading(self.world, 12)
        self.loyal = set(self.readers)  # those that have wanted everything all the time
        self.peer = Hostile(self.world)
        self.now = 1.0
        self.sent: dict[str, int] = {}  # messages of each stream that is there

    def people(self) -> list[Hostile]:
        return [self.peer, *self.readers]

    def step(self) -> None:
        self.now += self.random.choice((0.0, 0.001, 0.02))
        for person in self.people():
            person.now = max(self.now, person.now)
        self.now = max(person.now for person in self.people())
        what = self.random.choice(
            (
                self.announce,
                self.announce,
                self.message,
                self.message,
                self.retract,
                self.reader,
                self.turns,
                self.again,
            )
        )
        what()
        self.hub.validate()

    def announce(self) -> None:
        topic = f"/robot/{self.random.choice('abc')}"
        if topic not in self.sent:
            self.sent[topic] = 0
            self.peer.announce("abc".index(topic[-1]) + 1, topic, reliable=True)

    def message(self) -> None:
        if self.sent:
            topic = self.random.choice(sorted(self.sent))
            self.sent[topic] += 1
            self.peer.say(_whole("abc".index(topic[-1]) + 1, self.sent[topic]))

    def retract(self) -> None:
        if self.sent and self.random.random() < 0.3:
            topic = self.random.choice(sorted(self.sent))
            del self.sent[topic]
            self.peer.control({"t": "retract", "ch": "abc".index(topic[-1]) + 1})

    def reader(self) -> None:
        reader = self.random.choice(self.readers)
        what = self.random.randrange(4)
        if what == 3 and self.random.random() < 0.7:
            return
        self.loyal.discard(reader)
        if reader.name not in self.hub.links:
            reader.control_seq, reader.tag, reader.boot = 0, reader.tag + 1, reader.boot + 1
            reader.hello(reader.tag)
        if what < 3:
            wants(reader, *(("/robot/.*",), ("/robot/[ab]",), ())[what])
        else:
            self.hub.forget(reader.name, "revoked", now=self.now)

    def turns(self) -> None:
        for person in self.people():
            if (at_s := due_s(person)) is not None and self.random.random() < 0.8:
                person.port.handle_timeout(now=max(at_s, person.now))

    def again(self) -> None:
        """The origin is started anew."""
        if self.random.random() < 0.3:
            self.peer.boot, self.peer.control_seq, self.peer.tag = self.peer.boot + 1, 0, self.peer.tag % 255 + 1
            self.sent = {}
            self.peer.hello(self.peer.tag)
            if self.random.random() < 0.5:
                self.hub.sweep(now=self.now)

    def settle(self) -> None:
        while any(due_s(person) is not None for person in self.people()):
            for person in self.people():
                if due_s(person) is not None:
                    turn(person)
                    self.hub.validate()


@pytest.mark.parametrize("seed", seeds(24))
def test_whatever_happens_everybody_gets_all_they_want(seed: int) -> None:
    party = Party(seed, limited(channel_us=LIMITS.slice_us // 2, close_us=LIMITS.slice_us // 2))
    party.announce()
    for _ in range(60):
        party.step()
    party.settle()
    wait = {identity.topic: relayed for identity, relayed in party.hub.relayed.items()
            if identity.boot == party.peer.boot}  # fmt: skip
    assert wait.keys() == party.sent.keys()
    assert len(party.loyal) >= 1
    for topic, relayed in wait.items():
        assert not relayed.waiting
        assert relayed.stream.delivered == party.sent[topic]
        for reader in party.readers:
            wanted = party.hub.routing.takes(reader.name, topic)
            assert (reader.name in relayed.outs) == wanted
            if wanted:
                assert relayed.outs[reader.name][1].next_seq == party.sent[topic] + 1
                missing = set(range(1, party.sent[topic] + 1)) - set(held(relayed, reader))
                assert not missing or reader not in party.loyal
    channels = [list(party.hub.links[reader.name].outgoing.by_stream) for reader in party.loyal]
    assert all(streams == channels[0] for streams in channels), "told in another order"


def test_a_slice_pays_for_its_channels() -> None:
    world = World()
    reading(world, READERS)
    peer = Hostile(world)
    peer.announce(1, "/robot/a")
    link = peer.hub.links[ClientName("robot")]
    assert LIMITS.slice_us < link.reassembly.work_us <= LIMITS.slice_us + 2 * LIMITS.channel_us
