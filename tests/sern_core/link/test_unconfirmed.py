"""One hop, message by message: what its sender says of each agrees with what its receiver had, and the sum is exact.

A sender knows of a message that it arrived, that it did not, or (`unconfirmed`) neither. With the receiver's list at
hand the last ones are told apart, and nothing is left over or counted twice.
"""

from collections import Counter

from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import DropReason, PriorityClass
from sern_sim.models import LinkModel
from tests.exploring import cases
from tests.world import World, spec

TOPIC = "/robot/points"


@settings(max_examples=cases(8), phases=(Phase.explicit, Phase.generate))
@given(
    loss=st.sampled_from([0.0, 0.05, 0.3]),
    jitter_s=st.sampled_from([0.0, 0.02]),
    rate_bps=st.sampled_from([2e5, 2e6]),
    lifespan_s=st.sampled_from([None, 0.1, 1.0]),
    depth=st.sampled_from([1, 5]),
    size=st.sampled_from([50, 5_000]),
    outage=st.booleans(),
    seed=st.integers(0, 1000),
)
@example(loss=0.0, jitter_s=0.0, rate_bps=2e5, lifespan_s=0.1, depth=5, size=50, outage=True, seed=196)
def test_offered_is_received_and_dropped_and_unconfirmed_that_did_not_arrive(
    loss: float,
    jitter_s: float,
    rate_bps: float,
    lifespan_s: float | None,
    depth: int,
    size: int,
    outage: bool,
    seed: int,
) -> None:
    world = World(seed=seed, lossless=False)
    robot = world.client("robot", LinkModel(rate_bps=rate_bps, delay_s=0.02, jitter_s=jitter_s, loss=loss))
    world.client("site", patterns=[".*"])
    had: list[int] = []
    inner = world.relay.message

    def message(stream: StreamInfo, one: Message, *, now: float) -> None:
        inner(stream, one, now=now)
        if stream.id.topic == TOPIC:
            had.append(one.seq)

    world.relay.message = message  # type: ignore[method-assign, assignment]
    points = robot.publish(TOPIC, spec(PriorityClass.BULK, lifespan_s=lifespan_s, depth=depth))
    world.until(lambda: points.wanted)
    stop = robot.every(0.01, points, bytes(size))
    world.run(3.0)
    if outage:
        robot.core.link.disconnected(now=robot.now)
        world.run(0.5)
        robot.core.link.connected(now=robot.now)
    world.run(3.0)
    stop()
    world.run(20.0)
    robot.core.unpublish(points, now=robot.now)
    world.run(2.0)

    counters = points.counters
    fates = {drop.seq: drop.reason for drop in robot.dropped_out if drop.topic == TOPIC}
    told = Counter(fates.values())
    assert told == Counter({reason: n for reason, n in counters.by_reason.items() if n})
    received = set(had)
    assert len(received) == len(had), "nothing has its turn twice"
    unconfirmed = {seq for seq, reason in fates.items() if reason is DropReason.UNCONFIRMED}
    known_lost = fates.keys() - unconfirmed
    assert not received & known_lost, "what is known not to have arrived has not"
    offered = {seq for topic, seq in robot.sent if topic == TOPIC}
    # Acknowledged, and its receiver had no turn for it: it says so itself.
    behind = offered - received - known_lost - unconfirmed
    assert counters.delivered == len(received - unconfirmed) + len(behind)
    arrivals = world.relay.hub.received.topics.get(points.counters.topic)
    assert (
        len(behind) <= sum(n for reason, n in arrivals.by_reason.items() if reason is not DropReason.DUPLICATE)
        if arrivals is not None
        else not behind
    )
    assert counters.offered == len(received) + len(known_lost) + len(unconfirmed - received) + len(behind)
    world.validate()
