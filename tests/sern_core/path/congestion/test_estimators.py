"""Estimators take any acknowledgement: what a peer says of its clock and its counters may be anything."""

import heapq
import math
import random
from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

from benchmarks.delay import DelayWindow
from sern_core.path.capacity import AckSample, CapacityEstimator, Pacer
from sern_core.path.clocksync import ClockSync
from sern_core.path.congestion.fixed import FixedWindow
from sern_core.path.congestion.hybrid import HybridWindow
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import PriorityClass
from sern_core.wire import framing
from tests.exploring import cases
from tests.world import World, spec

ESTIMATORS: dict[str, Callable[[], CapacityEstimator]] = {
    "hybrid": HybridWindow,
    "delay": DelayWindow,
    "fixed": lambda: FixedWindow(50_000),
}
U64 = 2**64 - 1
SETTINGS = settings(
    phases=[Phase.explicit, Phase.generate],
    max_examples=cases(40),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example],
)

_steps_s = st.sampled_from([0.0, 1e-6, 0.001, 0.01, 0.02, 0.05, 0.13, 0.2, 1.0, 5.0])
_any_s = st.one_of(_steps_s, st.floats(-1.9e13, 1.9e13), st.sampled_from([1.8e13, -1.8e13, 0.0]))
_counts = st.one_of(st.sampled_from([0, 1200, 65_000, U64]), st.integers(0, U64))


@st.composite
def _peers(draw: st.DrawFn) -> list[tuple[str, float, float, float, int, int, bool, int]]:
    """What happens, one after the other. A whole history stands still, goes on, or jumps: hardly any random one goes
    on for long enough to be believed."""
    clock = draw(st.sampled_from(["steady", "still", "any"]))
    counter = draw(st.sampled_from(["steady", "still", "any"]))
    kinds = st.sampled_from(["sent"] * 4 + ["acked"] * 6 + ["lost", "stalled", "reset"])
    steps = []
    for _ in range(draw(st.integers(1, 120))):
        kind = draw(kinds)
        if kind == "acked" and draw(st.integers(0, 9)) == 0:
            rtt_s = draw(st.floats(1e-6, 1.9e13))
        else:
            rtt_s = draw(st.sampled_from([1e-6, 0.01, 0.05, 0.3]))
        moved_s = draw(_steps_s) if clock == "steady" else draw(_any_s) if clock == "any" else 0.0
        nbytes = draw(st.sampled_from([0, 76, 1231, 1260, 65_000]))
        cum_bytes = nbytes if counter == "steady" else draw(_counts) if counter == "any" else 0
        steps.append(
            (kind, draw(_steps_s), rtt_s, moved_s, cum_bytes, nbytes, draw(st.booleans()), draw(st.integers(0, 3)))
        )
    return steps


def check(estimator: CapacityEstimator) -> None:
    for rate in (estimator.rate_bps, estimator.bound_bps, estimator.pacing_bps, estimator.rtprop_s):
        assert rate is None or (rate > 0.0 and math.isfinite(rate)), estimator.snapshot()
    assert estimator.window_bytes > 0.0 and math.isfinite(estimator.window_bytes), estimator.snapshot()
    assert all(value is None or math.isfinite(value) for value in estimator.snapshot().values())


@SETTINGS
@given(steps=_peers())
def test_whatever_a_peer_says_window_and_rates_stay_numbers(
    steps: list[tuple[str, float, float, float, int, int, bool, int]],
) -> None:
    for new_estimator in ESTIMATORS.values():
        hear(new_estimator(), steps)


def hear(estimator: CapacityEstimator, steps: list[tuple[str, float, float, float, int, int, bool, int]]) -> None:
    pacer = Pacer()
    now, receiver_s, cum_bytes, inflight_bytes = 100.0, 5.0, 0, 0
    for kind, after_s, rtt_s, moved_s, counted, nbytes, app_limited, choice in steps:
        now += after_s
        if kind == "sent":
            inflight_bytes += nbytes
            estimator.on_sent(now=now, nbytes=nbytes, inflight_bytes=inflight_bytes)
            pacer.sent(now=now, nbytes=nbytes, pacing_bps=estimator.pacing_bps)
            assert math.isfinite(pacer.due_s)
        elif kind == "acked":
            receiver_s = receiver_s + moved_s if choice else moved_s
            cum_bytes = (cum_bytes + counted) & U64
            inflight_bytes = max(0, inflight_bytes - nbytes)
            sent_s = (now - rtt_s, now, None, 0.0)[choice]
            sample = AckSample(
                now, rtt_s, nbytes, inflight_bytes, receiver_s, cum_bytes, app_limited, sent_s, nbytes * (choice % 2)
            )
            estimator.on_ack(sample)
        elif kind == "lost":
            estimator.on_loss(now=now, nbytes=nbytes)
        elif kind == "stalled":
            estimator.on_stall(now=now)
        else:
            estimator.on_reset(now=now)
        check(estimator)


_stamps = st.one_of(st.integers(0, U64), st.sampled_from([0, 1, 2**32, 2**63, U64]))


@SETTINGS
@given(
    pings=st.lists(
        st.tuples(
            st.floats(0.0, 10.0),
            st.floats(-1.9e13, 1.9e13),
            st.floats(-1.9e13, 1.9e13),
            st.floats(-1.9e13, 1.9e13) | st.just(0.05),
        ),
        max_size=60,
    )
)
def test_a_clock_estimate_takes_any_stamps(pings: list[tuple[float, float, float, float]]) -> None:
    clock, now = ClockSync(), 100.0
    for after_s, t1, t2, held_s in pings:
        now += after_s
        clock.sample(t1 if held_s < 0.0 else now - 0.1, t2, t2 + held_s, now)
        delay_s, uncertainty_s = clock.one_way_delay_s(t2, now)
        assert math.isfinite(delay_s) and delay_s >= 0.0 and uncertainty_s >= 0.0
        for value in (clock.offset_s, clock.skew_ppm, clock.skew_error_ppm, clock.rtt.srtt_s, clock.rtt.rto_s):
            assert math.isfinite(value)


@settings(SETTINGS, max_examples=cases(10))
@given(
    acks=st.lists(
        st.tuples(
            st.floats(0.0, 0.2),
            st.integers(0, 3),
            st.sampled_from([0, 1, U64]) | st.integers(0, U64),
            _stamps | st.none(),
            _stamps | st.none(),
            _stamps,
            _stamps | st.none(),
        ),
        min_size=1,
        max_size=15,
    )
)
def test_a_link_takes_any_acknowledgement(
    acks: list[tuple[float, int, int, int | None, int | None, int, int | None]],
) -> None:
    """`behind` the newest packet; None: as an honest peer would say. A peer that errs may be cut off, nothing else."""
    world = World()
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    pose = robot.publish("/robot/pose", spec(PriorityClass.CONTROL))
    cloud = robot.publish("/robot/points", spec(PriorityClass.BULK))
    world.run(1.0)
    link = robot.core.link
    robot.every(0.05, pose, b"p" * 100)
    robot.every(0.1, cloud, b"c" * 8_000)
    for after_s, behind, sack, echo, received, cum_bytes, stamp in acks:
        world.run(after_s)
        now_us = int(robot.now * 1e6)
        highest = max(0, link.lane.flight.next_number - 1 - behind)
        echo_us = now_us - 50_000 if echo is None else echo
        stamp_us = now_us if stamp is None else stamp
        received_us = stamp_us if received is None else received
        head = framing.encode_header(framing.Kind.DATA, link.end.tag, 0, stamp_us)
        ack = framing.encode_ack(link.lane.id, highest, sack, echo_us, received_us, cum_bytes)
        try:
            link.receive(head + ack, now=robot.now)
        except WireError:
            break
        check(link.lane.estimator)
        link.validate()
    # Lies cost at most the session they were told in.
    world.hops["robot"].break_connection(reconnect_s=0.0)
    world.run(1.0)
    before = len(site.on("/robot/pose"))
    world.run(1.0)
    assert len(site.on("/robot/pose")) >= before + 15
    world.validate()


@st.composite
def _paths(draw: st.DrawFn) -> list[tuple[float, float, float, float, float, int, bool]]:
    """What a path and a sender are like, one after the other: for how long, the rate, the delay, the jitter, the share
    that is lost, the bytes of a packet, and whether there is always more to send."""
    return draw(
        st.lists(
            st.tuples(
                st.sampled_from([0.02, 0.2, 1.0, 3.0]) | st.integers(1, 40).map(lambda count: count * 0.01),
                st.sampled_from([2e3, 6e4, 5e5, 1e7]),
                st.sampled_from([0.0, 1e-4, 0.01, 0.3]),
                st.sampled_from([0.0, 0.001, 0.05]),
                st.sampled_from([0.0, 0.0, 0.05, 0.9]),
                st.sampled_from([76, 600, 1260, 9000]),
                st.booleans(),
            ),
            min_size=1,
            max_size=6,
        )
    )


@pytest.mark.parametrize("name", ESTIMATORS)
@settings(SETTINGS, max_examples=cases(60))
@given(stretches=_paths(), seed=st.integers(0, 2**16))
@example(  # the first rate was known before an epoch had seen one: a division by zero
    stretches=[
        (3.0, 1e7, 0.0, 0.001, 0.0, 1260, True),
        (1.0, 6e4, 1e-4, 0.05, 0.9, 1260, False),
        (0.27, 5e5, 0.0, 0.05, 0.0, 76, False),
    ],
    seed=1720,
)
def test_on_any_path_window_and_rates_stay_numbers(
    name: str, stretches: list[tuple[float, float, float, float, float, int, bool]], seed: int
) -> None:
    """Random acknowledgements hardly ever make the history that a path makes: this one is a queue with a rate."""
    chance = random.Random(seed)
    estimator, pacer = ESTIMATORS[name](), Pacer()
    now, free_s, inflight_bytes, cum_bytes = 10.0, 0.0, 0, 0
    acks: list[tuple[float, float, float, int, bool, bool]] = []  # (due, sent, arrived, bytes, app limited, lost)
    for lasts_s, rate, delay_s, jitter_s, loss, nbytes, greedy in stretches:
        until_s = now + lasts_s
        for _ in range(400):
            if acks and (acks[0][0] <= now or inflight_bytes + nbytes > estimator.window_bytes):
                due_s, sent_s, arrived_s, size, limited, lost = heapq.heappop(acks)
                now = max(now, due_s)
                inflight_bytes -= size
                if lost:
                    estimator.on_loss(now=now, nbytes=size)
                else:
                    cum_bytes += size
                    sample = AckSample(
                        now, now - sent_s, size, inflight_bytes, arrived_s, cum_bytes, limited, sent_s, size
                    )
                    estimator.on_ack(sample)
                check(estimator)
            elif now < until_s:
                inflight_bytes += nbytes
                estimator.on_sent(now=now, nbytes=nbytes, inflight_bytes=inflight_bytes)
                pacer.sent(now=now, nbytes=nbytes, pacing_bps=estimator.pacing_bps)
                free_s = max(now, free_s) + nbytes / rate
                arrived_s = free_s + delay_s + chance.random() * jitter_s
                lost = chance.random() < loss
                heapq.heappush(acks, (arrived_s + delay_s, now, arrived_s, nbytes, not greedy, lost))
                check(estimator)
                now = max(now, pacer.due_s) if greedy else now + 0.01
            else:
                break
        now = max(now, until_s)
