"""When data goes over the stream though datagrams get through: what shows it, and how soon it is given up again."""

from math import inf

import pytest

from sern_core.path.capacity import AckSample
from sern_core.path.lanes import LANE_UDP, LANE_ZMQ, Lane
from sern_core.path.stream_choice import CLEAN_LOSS, LATE_S, MAX_REST_S, PROVEN_S, REST_S, SHORT_S, StreamChoice
from sern_core.vocabulary.params import LinkParams

FROM_BPS = 40e6
STEP_S = 0.05


class Scene:
    """Two lanes that carry what a test says."""

    def __init__(self, *, from_bps: float = FROM_BPS, rtt_s: float = 0.002) -> None:
        self.choice = StreamChoice(from_bps)
        self.datagrams = Lane(LANE_UDP, LinkParams(), lossless=False)
        self.stream = Lane(LANE_ZMQ, LinkParams(), lossless=True)
        self.now = 100.0
        for lane in (self.datagrams, self.stream):
            self.carry(lane, 1000, rtt_s)

    def carry(self, lane: Lane, nbytes: int, rtt_s: float = 0.002) -> None:
        lane.path.arrived_bytes += nbytes
        lane.estimator.on_ack(
            AckSample(self.now, rtt_s, nbytes, 0, self.now, lane.path.arrived_bytes, True, self.now - rtt_s)
        )

    def look(self, lane: Lane) -> bool:
        """Whether it is the stream, as it is found now."""
        self.choice.look(lane, now=self.now)
        return self.choice.stream

    def run(self, seconds: float, bps: float, *, held: bool = False) -> bool:
        """The lane of choice carries `bps`. Returns whether it is the stream in the end."""
        for _ in range(round(seconds / STEP_S)):
            self.now += STEP_S
            lane = self.stream if self.choice.stream else self.datagrams
            self.carry(lane, round(bps * STEP_S / 8))
            lane.path.held = held
            self.choice.look(lane, now=self.now)
        return self.choice.stream


def streaming() -> Scene:
    scene = Scene()
    assert scene.run(2.2, 60e6)
    return scene


def test_much_over_a_short_clean_path_goes_over_the_stream_and_stays_there() -> None:
    scene = Scene()
    assert not scene.run(0.9, 60e6), "a moment says nothing"
    assert scene.run(1.3, 60e6)
    assert scene.run(120.0, 60e6, held=True)


@pytest.mark.parametrize(
    ("bps", "rtt_s", "loss", "from_bps"),
    [
        (30e6, 0.002, 0.0, FROM_BPS),
        (60e6, SHORT_S * 1.5, 0.0, FROM_BPS),
        (60e6, 0.002, CLEAN_LOSS + 0.001, FROM_BPS),
        (600e6, 0.002, 0.0, inf),
    ],
    ids=["little", "a long path", "losses", "never"],
)
def test_data_stays_with_the_datagrams(bps: float, rtt_s: float, loss: float, from_bps: float) -> None:
    scene = Scene(from_bps=from_bps, rtt_s=rtt_s)
    for _ in range(100):
        scene.now += STEP_S
        scene.datagrams.resolved(acked=round(1000 * (1 - loss)), lost=round(1000 * loss))
        scene.carry(scene.datagrams, round(bps * STEP_S / 8), rtt_s)
        assert not scene.look(scene.datagrams)


def test_a_loss_now_and_then_is_no_lossy_path() -> None:
    scene = Scene()
    for number in range(60):
        scene.datagrams.resolved(acked=1000, lost=number % 2)
        scene.run(STEP_S, 60e6)
    assert scene.choice.stream


def test_a_path_of_unknown_length_is_not_short() -> None:
    scene = Scene()
    scene.datagrams = Lane(LANE_UDP, LinkParams(), lossless=False)
    assert scene.datagrams.estimator.rtprop_s is None
    for _ in range(100):
        scene.now += STEP_S
        scene.datagrams.path.arrived_bytes += 10**6
        assert not scene.look(scene.datagrams)


def test_little_to_send_goes_with_datagrams_again_and_much_needs_no_rest() -> None:
    scene = streaming()
    assert not scene.run(1.2, 5e6)
    assert scene.run(2.2, 60e6)


def test_pauses_between_large_messages_are_no_idleness() -> None:
    scene = streaming()
    for _ in range(20):
        assert scene.run(0.1, 150e6) and scene.run(0.4, 0.0)


def test_less_than_datagrams_carried_is_a_failure_only_where_something_waits() -> None:
    scene = streaming()
    assert scene.run(3.0, 20e6), "there is no more to send"
    assert not scene.run(1.2, 20e6, held=True)
    assert not scene.run(REST_S - 2.0, 60e6)
    assert scene.run(3.0, 60e6)


def test_a_stream_whose_window_lets_little_through_is_not_idle() -> None:
    scene = streaming()
    assert not scene.run(1.2, 5e6, held=True)
    assert not scene.run(REST_S - 2.0, 60e6), "it is not tried again at once"


def test_what_is_late_in_flight_gives_the_stream_up_at_once_and_each_time_for_longer() -> None:
    scene = streaming()
    rests_s: list[float] = []
    for _ in range(8):
        scene.now += 0.1
        scene.stream.flight.sent(now=scene.now, nbytes=1000, items=[], app_limited=False)
        number = scene.stream.flight.next_number - 1
        scene.now += LATE_S
        assert scene.look(scene.stream), "it may yet come"
        scene.now += 0.01
        assert not scene.look(scene.stream)
        scene.stream.flight.acked(number, 0, now=scene.now)
        began_s = scene.now
        while not scene.run(STEP_S, 60e6):
            pass
        rests_s.append(scene.now - began_s)
    assert rests_s == sorted(rests_s) and rests_s[0] == pytest.approx(REST_S, abs=1.1)
    assert rests_s[-1] == pytest.approx(MAX_REST_S, abs=1.1)
    scene.run(PROVEN_S + 2.0, 60e6)
    scene.choice.failed(scene.now)
    assert not scene.run(REST_S - 0.1, 60e6) and scene.run(1.2, 60e6), "it had proven itself"


def test_a_stream_that_is_gone_is_a_failure_once() -> None:
    scene = streaming()
    for _ in range(3):
        scene.choice.failed(scene.now)
    assert not scene.run(REST_S - 0.1, 60e6) and scene.run(1.2, 60e6)


def test_nothing_is_judged_while_a_change_is_under_way() -> None:
    """The peer has not confirmed yet what it was told: data goes on over the lane before."""
    scene = streaming()
    for _ in range(100):
        scene.now += STEP_S
        scene.carry(scene.datagrams, 1000)
        assert scene.look(scene.datagrams)
