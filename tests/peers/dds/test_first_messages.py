"""What is published as soon as a stream begins reaches the subscribers that are known."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from sern_client.endpoints.common import first_messages
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding
from sern_runtime.ros_types import topic_info
from tests.peers.dds.conftest import MakeEndpoint, MakePeer
from tests.peers.dds.test_topics import STAMP_NS, STRING, body_of, same
from tests.support import until

CHAT: TopicInfo = topic_info("/chat", "std_msgs/msg/String", Encoding.CDR, reliable=True)
BODIES = [body_of(STRING, seed) for seed in range(5)]
FOREVER_S = 600.0


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Nothing is written by the clock: `patient(0.0)` says that the subscriber knows, where the product waits."""
    monkeypatch.setattr("sern_client.endpoints.dds.endpoint.LEARN_S", FOREVER_S)
    monkeypatch.setattr(first_messages, "FIRST_MESSAGES_S", FOREVER_S)

    def settle(after_s: float) -> None:
        monkeypatch.setattr(first_messages, "SETTLE_S", after_s)

    settle(FOREVER_S)
    return settle


async def test_the_first_messages_wait_for_the_subscribers_there_are(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint, patient: Callable[[float], None]
) -> None:
    peer = await make_peer(domain)
    endpoint, _ = await make_endpoint(domain)
    await peer.do(f"sub b rt/chat {STRING} reliable")
    await until(lambda: endpoint.graph.readers("rt/chat"), "the subscriber is known")
    for number in range(3):  # each time a stream of a moment, as the one message of `ros2 topic pub --once`
        stream = endpoint.advertise(CHAT)
        for body in BODIES:
            stream.publish(body, STAMP_NS + number)
        stream.close()
        await peer.line("matched b 1", number)
        patient(0.0)
        await peer.line("got b ", 5 * number + 4)
        patient(FOREVER_S)
    got = peer.got("b")
    assert len(got) == 15 and all(same(one, other) for one, other in zip(got, BODIES * 3, strict=True))
    await until(lambda: not any(local.topic == "rt/chat" for local in endpoint.graph.locals.values()))
    assert endpoint.drops == {}


async def test_a_young_endpoint_waits_until_it_knows(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint, patient: Callable[[float], None]
) -> None:
    peer = await make_peer(domain)
    await peer.do(f"sub b rt/chat {STRING} reliable")
    endpoint, _ = await make_endpoint(domain)
    stream = endpoint.advertise(CHAT)
    for body in BODIES:
        stream.publish(body, STAMP_NS)
    await peer.line("matched b 1")
    patient(0.0)
    await peer.line("got b ", 4)
    assert all(same(one, other) for one, other in zip(peer.got("b"), BODIES, strict=True))
    assert endpoint.drops == {}


async def test_a_fast_topic_keeps_all_of_its_first_messages(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint, patient: Callable[[float], None]
) -> None:
    """More than the default depth of an endpoint's queue: 0.1 s and a little more of 1 kHz."""
    peer = await make_peer(domain)
    bodies = BODIES * 100
    await peer.do(f"sub b rt/chat {STRING} reliable depth={len(bodies)}")
    endpoint, _ = await make_endpoint(domain)
    stream = endpoint.advertise(replace(CHAT, depth=10))
    for body in bodies:
        stream.publish(body, STAMP_NS)
    assert endpoint.drops == {}
    await peer.line("matched b 1")
    patient(0.0)
    await peer.line("got b ")
    await peer.line("got b ", len(bodies) - 1)
    assert all(same(one, other) for one, other in zip(peer.got("b"), bodies, strict=True))
    assert endpoint.drops == {}


async def test_what_is_too_old_is_dropped_and_the_newest_kept(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint, patient: Callable[[float], None]
) -> None:
    peer = await make_peer(domain)
    endpoint, _ = await make_endpoint(domain)
    await peer.do(f"sub b rt/chat {STRING}")
    await until(lambda: endpoint.graph.readers("rt/chat"), "the subscriber is known")
    stream = endpoint.advertise(topic_info("/chat", "std_msgs/msg/String", Encoding.CDR, reliable=False))
    for body in BODIES:
        stream.publish(body, STAMP_NS)
    assert endpoint.drops == {DropReason.SUPERSEDED: 4}
    await peer.line("matched b 1")
    patient(0.0)
    await peer.line("got b ")
    assert [same(body, BODIES[-1]) for body in peer.got("b")] == [True]
