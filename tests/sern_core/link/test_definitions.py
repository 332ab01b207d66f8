"""Texts of definitions are kept while a stream uses them, whoever has sent them and however often it came back."""

from random import Random

import pytest

from sern_core.link.definitions import LINGERING_TEXTS, DefinitionStore, PeerDefinitions
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.limits import LIMITS
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_core.wire.announce import definition_hash
from tests.exploring import seeds
from tests.fuzz.test_hostile_peer import Hostile
from tests.world import World, limited, spec


def test_texts_go_with_the_streams_that_use_them() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=[".*"])
    world.run(1.0)
    for index in range(200):
        channel = robot.publish(f"/robot/t{index}", spec(), f"uint8 x{index}\n")
        world.run(0.1)
        robot.core.unpublish(channel, now=robot.now)
    world.run(1.0)
    assert len(site.opened) == len(site.closed) == 200 and site.opened[7].info.definition == "uint8 x7\n"
    assert len(robot.core.definitions) == 0
    assert len(world.relay.hub.definitions) <= LINGERING_TEXTS and len(site.core.definitions) <= LINGERING_TEXTS
    robot.core.link.close("bye", now=robot.now)
    world.run(1.0)
    world.relay.hub.forget(robot.name, "test", now=world.relay.now)
    assert len(world.relay.hub.definitions) == 0


def test_a_topic_that_comes_again_has_its_definition_again() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=[".*"])
    world.run(1.0)
    for _ in range(5):
        channel = robot.publish("/robot/t", spec(), "uint8 x\n")
        world.run(0.5)
        robot.core.unpublish(channel, now=robot.now)
        world.run(0.5)
    assert [stream.info.definition for stream in site.opened] == ["uint8 x\n"] * 5


def test_a_stream_of_which_messages_wait_keeps_its_definition() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=[".*"])
    world.run(1.0)
    log = robot.publish("/robot/log", spec(reliable=True), "uint8 x\n")
    world.run(1.0)
    world.hops["site"].break_connection(reconnect_s=2.0)
    robot.send(log, b"1")
    world.run(0.5)
    robot.core.unpublish(log, now=robot.now)
    world.run(0.5)
    site = world.restart_client("site")
    world.until(lambda: site.seqs("/robot/log") == [1])
    assert site.opened[0].info.definition == "uint8 x\n"


def test_what_a_client_had_kept_is_gone_however_often_it_comes_back() -> None:
    peer = Hostile()
    store = peer.hub.definitions
    for session in range(5):
        for index in range(200):
            text = f"# {session}.{index}\n".ljust(2000, "x")
            peer.announce(1, f"/robot/t{index}", digest=definition_hash(text))
            peer.control({"t": "define", "dh": definition_hash(text)}, text.encode())
            peer.control({"t": "retract", "ch": 1})
        assert 0 < len(store) <= LINGERING_TEXTS
        peer.port.receive(framing.encode_handshake(framing.Kind.CLOSE, peer.tag, 0, {"why": "bye"}), now=peer.now)
        assert len(store) == 0
        peer.tag, peer.number, peer.control_seq, peer.boot = peer.tag + 1, 0, 0, peer.boot + 1
        peer.hello(tag=peer.tag)
    peer.hub.validate()


def test_what_the_streams_of_a_client_use_has_a_bound() -> None:
    peer = Hostile(World(link=limited(peer_definition_bytes=10_000)))

    def define(index: int) -> None:
        text = f"#{index}".ljust(2_000)
        peer.announce(index + 1, f"/robot/t{index}", digest=definition_hash(text))
        peer.control({"t": "define", "dh": definition_hash(text)}, text.encode())

    for index in range(5):
        define(index)
    with pytest.raises(WireError, match="more than 10000 bytes of definitions"):
        define(5)
    assert peer.hub.links[peer.name].texts.bytes == 10_000


def test_only_texts_of_ones_own_streams_are_told() -> None:
    peer = Hostile()
    text = "uint8 secret\n"
    peer.announce(1, "/robot/t", digest=definition_hash(text))
    peer.control({"t": "define", "dh": definition_hash(text)}, text.encode())
    other = Hostile(peer.world, "other")
    link = peer.hub.links[other.name]
    said = link.control.out.next_seq
    other.control({"t": "need", "dh": definition_hash(text)})
    assert link.control.out.next_seq == said


def test_a_text_that_comes_too_late_is_not_kept() -> None:
    peer = Hostile()
    text = "uint8 x\n"
    peer.announce(1, "/robot/t", digest=definition_hash(text))
    peer.control({"t": "retract", "ch": 1})
    peer.control({"t": "define", "dh": definition_hash(text)}, text.encode())
    assert len(peer.hub.definitions) == 0


@pytest.mark.parametrize("seed", seeds(10))
def test_uses_add_up_whatever_happens(seed: int) -> None:
    random = Random(seed)
    store = DefinitionStore()
    links = [
        PeerDefinitions(store, ClientName(f"peer{index}"), max_bytes=LIMITS.peer_definition_bytes) for index in range(3)
    ]
    texts = {definition_hash(text): text for text in (f"uint8 x{index}\n" for index in range(12))}
    for _ in range(2_000):
        link = random.choice(links)
        digest = random.choice(list(texts))
        match random.randrange(6):
            case 0 | 1:
                link.use_incoming(random.randrange(5), random.choice(["", digest]))
            case 2:
                link.use_outgoing(random.randrange(5), random.choice(["", digest]), random.choice(["", texts[digest]]))
            case 3:
                if link.lacks(digest) and link.came(digest, texts[digest].encode()):
                    for other in links:
                        other.known(digest)
            case 4:
                link.asked(digest)
            case _:
                if random.random() < 0.1:
                    link.begin()
        store.validate()
        for each in links:
            each.validate()
    for each in links:
        each.close()
        each.validate()
    assert len(store) == 0 and not store._uses
