"""The end of what waits for a subscriber: drop markers and gaps in it, and exactly the messages in between are lost."""

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import HubParams
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.stream.prices import CLIENT_OVERHEAD_BYTES
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import ClientName, DropReason
from sern_sim.models import LinkModel
from tests.exploring import cases
from tests.world import World, limited, spec

PHASES = (Phase.explicit, Phase.generate)
LARGE_BYTES = 2_000
"""Fits into no bound of what waits."""
ROOM_BYTES = 24 * (CLIENT_OVERHEAD_BYTES + 1)
ENDS = ("stays away", "leaves", "forbidden", "comes back")
ACTIONS = ("small", "small", "large", "too large", "lapse", "joins", "goes")


def _access(*, forbidden: str = "") -> AccessTable:
    taken = () if forbidden else (".*",)
    return AccessTable(
        [
            AccessRule(client="away", publish=(), subscribe=taken, max_queue_bytes=ROOM_BYTES),
            AccessRule(client=".*", publish=(".*",), subscribe=(".*",)),
        ]
    )


@settings(max_examples=cases(24), phases=PHASES)
@given(
    actions=st.lists(st.sampled_from(ACTIONS), min_size=4, max_size=60),
    end=st.sampled_from(ENDS),
    latched=st.booleans(),
)
def test_what_ends_is_what_waited_and_nothing_else(actions: list[str], end: str, latched: bool) -> None:
    """At both ends: of each message the origin knows whether it was delivered or dropped, once, and the same."""
    world = World(
        link=LinkParams(max_message_bytes=LARGE_BYTES), access=_access(), hub_params=HubParams(resume_s=100.0)
    ).watch(0.5)
    robot = world.client("robot")
    near = world.client("near", patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True, retention_s=600.0, latched=latched, depth=5))
    world.run(1.0)
    joined = here = False
    for action in actions:
        if action in ("small", "large", "too large"):
            size = {"small": 1, "large": LARGE_BYTES, "too large": LARGE_BYTES + 1}[action]
            assert robot.send(log, bytes(size))
            world.run(0.05)
        elif action == "lapse":  # gives up what it sends meanwhile: a gap for all
            world.hops["robot"].break_connection(reconnect_s=1.0)
            assert robot.send(log, b"x")
            robot.core.link.sender.shed(log, 1, DropReason.QUEUE_FULL, now=robot.now)
            world.run(1.5)
        elif action == "joins" and not joined:
            joined = here = True
            world.client("away", patterns=["/robot/.*"])
            world.run(0.02)
        elif action == "goes" and here:
            here = False
            world.network.crash_node(world.clients["away"])
    hub = world.relay.hub
    if here:
        world.network.crash_node(world.clients["away"])
    world.until(lambda: not log.queue and not log.flying, what="the relay has all of it")
    world.run(0.5)
    channels = hub.links[ClientName("away")].sender.channels.values() if joined else ()
    waiting = {out.seq for channel in channels for out in channel.retained if not out.counted}
    open_at_origin = {out.seq for out in log.retained if not out.counted}
    lost_before = [drop.seq for drop in robot.dropped_out]
    back = None
    if joined and end == "stays away":
        world.run(110.0)
    elif joined and end == "forbidden":
        hub.revoke(_access(forbidden="away"), now=world.relay.now)
    elif joined:
        back = world.restart_client("away", patterns=["/robot/.*"] if end == "comes back" else [])
    assert robot.send(log, b"last")
    world.until(lambda: not log.retained, within_s=30.0)
    world.run(0.5)
    sent = set(range(1, log.next_seq))
    lost = [drop.seq for drop in robot.dropped_out]
    reported = end in ("stays away", "forbidden")
    assert len(lost) == len(set(lost)), "told twice"
    assert set(lost) - set(lost_before) == (waiting & open_at_origin if joined and reported else set())
    counters = log.counters
    assert counters.offered == len(sent) == counters.delivered + counters.dropped
    assert counters.dropped == len(lost)
    got = near.seqs("/robot/log")
    assert got == sorted(set(got)) and set(got) | set(lost) == sent, "once, in order, or reported"
    if back is not None and end == "comes back":
        taken = back.seqs("/robot/log")
        assert waiting - set(lost_before) <= set(taken) and taken == sorted(set(taken))


@pytest.mark.interpreted
def test_what_lapses_in_many_sweeps_is_reported_once_and_never_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where 500 messages lapse at a time and a sweep is for 3: the next one is due at once, and what lies between two
    sweeps sends none of them."""
    sent: list[bool] = []
    take = OutChannel.take

    def taken(channel: OutChannel, out: OutMessage, room: int, now: float) -> tuple[int, int]:
        sent.append(not out.message.drop_marker and now - out.retain_from_s > channel.spec.retention_s)
        return take(channel, out, room, now)

    monkeypatch.setattr(OutChannel, "take", taken)
    world = World(link=limited(lapsed_a_sweep=3)).watch()
    robot = world.client("robot")
    thin = LinkModel(rate_bps=40e3, delay_s=0.05).as_stream()
    site = world.client("site", thin, thin, patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True, retention_s=4.0))
    world.run(1.0)
    for _ in range(500):
        assert robot.send(log, bytes(100))
    world.until(lambda: not log.retained, within_s=60.0)
    lost = [drop.seq for drop in robot.dropped_out]
    got = site.seqs("/robot/log")
    assert got == list(range(1, len(got) + 1)) and 20 < len(got) < 400
    assert len(lost) == len(set(lost)) and set(lost) >= set(range(len(got) + 1, 501))
    assert sent and not any(sent), "what has lapsed is sent"
    (channel,) = world.relay.hub.links[site.name].sender.channels.values()
    assert channel.counters.by_reason[DropReason.RETENTION] >= 500 - len(got)
    assert log.counters.offered == log.counters.delivered + log.counters.dropped == 500


@pytest.mark.parametrize(("count", "kept"), [(10, [27, 24, 21, 17, 14, 11, 7, 4, 1]), (2, [2])])
def test_what_lapses_for_clients_that_are_away_goes_in_many_turns(count: int, kept: list[int]) -> None:
    """Also of several clients: one turn is not for all that wait for all of them, however little it is of each."""
    world = World(link=limited(lapsed_a_sweep=3), hub_params=HubParams(resume_s=1e6))
    robot = world.client("robot")
    sites = [world.client(name, patterns=["/robot/.*"]) for name in ("one", "two", "three")]
    log = robot.publish("/robot/log", spec(reliable=True, retention_s=60.0))
    world.run(1.0)
    for site in sites:
        world.network.crash_node(site)
    world.run(1.0)
    for _ in range(count):
        assert robot.send(log, b"x")
    world.run(20.0)
    hub = world.relay.hub
    channels = [channel for site in sites for channel in hub.links[site.name].sender.channels.values()]
    assert [channel.kept for channel in channels] == [count] * 3
    now = world.relay.now + 60.0
    hub.sweep(now=now)
    left = [sum(channel.kept for channel in channels)]
    while hub.lapse(now=now):
        left.append(sum(channel.kept for channel in channels))
    assert left == kept and not any(channel.kept for channel in channels)
    world.run(1.0)
    assert sorted(drop.seq for drop in robot.dropped_out) == list(range(1, count + 1)) and not log.retained


@pytest.mark.parametrize(("reliable", "most", "told"), [(True, 9, 3), (True, 2, 5), (False, 2, 3)])
def test_an_origin_is_told_of_exactly_what_is_dropped_unless_that_is_in_too_many_runs(
    reliable: bool, most: int, told: int
) -> None:
    """Between two reliable messages lies what was told before, between two others perhaps one that arrived."""
    world = World(link=limited(runs_told=most))
    robot = world.client("robot")
    channel = robot.publish("/robot/a", spec(reliable=reliable))
    outs = [OutMessage(Message(channel.stream.id, seq, b"x", 0, robot.now)) for seq in (1, 3, 5)]
    robot.core.on_out_drop(robot.core.link, channel, outs, DropReason.LIFESPAN)
    assert [drop.seq for drop in robot.dropped_out] == ([1, 3, 5] if told == 3 else [1, 2, 3, 4, 5])
