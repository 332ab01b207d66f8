"""Poses that leave only when a twin would be wrong without them."""

import logging
import math
from collections.abc import Callable

import pytest

from sern_client.endpoints.twin.bodies import Writer
from sern_client.reckoned import ReckonedPoses
from sern_core.vocabulary.types import Encoding, TopicName
from sern_twin.acceleration import Accelerations
from sern_twin.motion import Motion, Twist
from sern_twin.predictors import ConstantAcceleration

STEP_S = 0.02


class Sent:
    def __init__(self, encoding: Encoding = Encoding.CDR) -> None:
        self.encoding = encoding
        self.writer = Writer(encoding)
        self.bodies: list[bytes] = []
        self.kept = 0
        self.poses = ReckonedPoses(TopicName("/odom"), encoding, self._take, self._keep)

    def _take(self, body: bytes, stamp_ns: int) -> bool:
        self.bodies.append(body)
        return True

    def _keep(self) -> None:
        self.kept += 1

    def say(self, time_s: float, motion: Motion) -> bool:
        """Whether it went out."""
        before = len(self.bodies)
        stamp_ns = round(time_s * 1e9)
        body = self.writer.odometry(
            motion, 0.0, z_m=0.0, stamp_ns=stamp_ns, frame_id="odom", child_frame_id="base_link"
        )
        assert self.poses.sink(body, stamp_ns), "what is kept back is no refusal"
        return len(self.bodies) > before


def straight(time_s: float) -> Motion:
    return Motion(time_s, 0.0, 0.0, Twist(1.0))


def weaving(time_s: float) -> Motion:
    """1 m/s, to the left and to the right."""
    turn = 0.6 * math.sin(time_s)
    return Motion(time_s, 0.1 * math.sin(2 * time_s), turn, Twist(1.0, 0.0, 0.6 * math.cos(time_s)))


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
def test_one_that_goes_on_as_it_went_is_heard_five_times_a_second(encoding: Encoding) -> None:
    sent = Sent(encoding)
    for step in range(500):
        sent.say(100 + step * STEP_S, straight(step * STEP_S))
    assert len(sent.bodies) == 50 and sent.kept == 450


@pytest.mark.parametrize("path", [straight, weaving])
def test_a_twin_of_what_went_out_is_never_further_off_than_was_said(path: Callable[[float], Motion]) -> None:
    """The twin's own predictor, from what it got: within 2 cm and a degree at each pose that did not go out."""
    sent, accelerations, predictor = Sent(), Accelerations(), ConstantAcceleration()
    known: tuple[float, Motion] | None = None
    for step in range(1000):
        time_s = 100 + step * STEP_S
        motion = path(step * STEP_S)
        if sent.say(time_s, motion):
            motion = accelerations.of(time_s, motion)
            accelerations.took(time_s, motion)
            known = time_s, motion
            continue
        assert known is not None
        there = predictor.reach(known[1], known[0], time_s, STEP_S, heard_s=known[0])
        assert there.distance_m(motion) < 0.0201 and abs(there.turn_rad(motion)) < math.radians(1.01)
    assert len(sent.bodies) < 500


def test_a_stop_goes_out_at_once() -> None:
    sent = Sent()
    for step in range(100):
        sent.say(step * STEP_S, straight(step * STEP_S))
    went = [sent.say(2.0 + step * STEP_S, Motion(1.98, 0.0, 0.0)) for step in range(4)]
    assert any(went)


def test_what_cannot_be_read_goes_as_it_is_and_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    sent = Sent()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            assert sent.poses.sink(b"\0\1\0\0none", 5)
    assert sent.bodies == [b"\0\1\0\0none"] * 3
    assert caplog.text.count("no dead reckoning, such messages are sent as they are") == 1


def test_a_place_that_is_none_is_not_kept_back() -> None:
    sent = Sent()
    assert sent.say(1.0, straight(1.0))
    assert sent.say(1.02, Motion(math.nan, 0.0, 0.0)), "its twin counts it"
    assert not sent.say(1.04, straight(1.04))
