"""What is in the background keeps below what the path holds, and leaves the window to what is live."""

import pytest

from sern_core.link.background import LIVE_S, MIN_BYTES, Background
from sern_core.path.capacity import AckSample, CapacityEstimator
from sern_core.path.lanes import LANE_UDP, OVERHEAD_BYTES, Lane
from sern_core.vocabulary.params import LinkParams


class KnownPath(CapacityEstimator):
    """A path of which everything is known."""

    def __init__(self, rate_bps: float | None, unqueued_bytes: float) -> None:
        self._rate_bps, self._unqueued_bytes = rate_bps, unqueued_bytes

    @property
    def window_bytes(self) -> float:
        return 2 * self._unqueued_bytes

    @property
    def rate_bps(self) -> float | None:
        return self._rate_bps

    @property
    def rtprop_s(self) -> float | None:
        return 0.1

    @property
    def unqueued_bytes(self) -> float:
        return self._unqueued_bytes

    def on_sent(self, *, now: float, nbytes: int, inflight_bytes: int) -> None:
        """It learns nothing."""

    def on_ack(self, sample: AckSample) -> None:
        """It learns nothing."""

    def on_loss(self, *, now: float, nbytes: int) -> None:
        """It learns nothing."""

    def on_reset(self, *, now: float) -> None:
        """It learns nothing."""

    def on_stall(self, *, now: float) -> None:
        """It learns nothing."""


def lane(rate_bps: float | None, unqueued_bytes: float = 12_500.0) -> Lane:
    made = Lane(LANE_UDP, LinkParams(), lossless=False)
    made.estimator = KnownPath(rate_bps, unqueued_bytes)
    return made


def in_flight(made: Lane, nbytes: int) -> Lane:
    if nbytes:
        made.flight.sent(now=0.0, nbytes=nbytes, items=[], app_limited=False)
    return made


@pytest.mark.parametrize(
    ("rate_bps", "expected"), [(64e3, MIN_BYTES), (1e6, MIN_BYTES), (2e6, 750), (8e6, 1171), (None, 1171)]
)
def test_its_datagrams_take_little_of_a_slow_link(rate_bps: float | None, expected: int) -> None:
    assert Background().limit(lane(rate_bps), 0.0) == expected


@pytest.mark.parametrize("unqueued_bytes", [100.0, 5_000.0, 12_500.0])
def test_it_keeps_below_what_the_path_holds(unqueued_bytes: float) -> None:
    background, datagram = Background(), MIN_BYTES + OVERHEAD_BYTES
    fits = [n for n in range(0, 20_000, 50) if background.room(in_flight(lane(1e6, unqueued_bytes), n), 0.0)]
    assert fits == [0, *(n for n in range(50, 20_000, 50) if n + datagram <= unqueued_bytes)]


def test_while_live_traffic_fills_the_link_its_window_holds_for_all() -> None:
    background, path = Background(), in_flight(lane(1e6), 12_500)
    assert not background.room(path, 10.0)
    background.live_waits(10.0)
    for now in (10.0, 10.0 + LIVE_S / 2):
        assert background.room(path, now)
        assert background.limit(path, now) == path.fragment_bytes
    assert not background.room(path, 10.0 + LIVE_S)
    assert background.limit(path, 10.0 + LIVE_S) == MIN_BYTES
