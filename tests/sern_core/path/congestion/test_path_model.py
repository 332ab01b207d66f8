"""What is known of the path, epoch by epoch."""

import pytest

from sern_core.path.congestion.link_rate import SPAN_PACKETS, Slowdown
from sern_core.path.congestion.params import DEFAULT_HYBRID
from sern_core.path.congestion.path_delay import STALE_S
from tests.sern_core.path.congestion.acknowledged import FRAGMENT_BYTES, MEMORY_S, RTT_S, Path


def test_an_epoch_lasts_for_a_round_trip_and_shows_the_queue() -> None:
    path = Path().settled()
    before_s = path.now
    seen = path.epoch(0.004)
    assert RTT_S <= path.now - before_s < 2 * RTT_S
    assert seen.queue_s == pytest.approx(0.004, abs=1e-6) and seen.rtt_s == pytest.approx(RTT_S)
    assert not seen.early and not seen.quicker


def test_an_epoch_of_too_few_packets_goes_on() -> None:
    model = Path().model
    model.begin_epoch(100.0)
    assert not model.epoch_over(200.0)


def test_one_that_overtook_others_does_not_show_how_long_the_path_is() -> None:
    path = Path().settled()
    for _ in range(50):
        assert path.model.note(path.packet(-0.02, overtook=True)) == 0.0
    seen = path.epoch()
    assert seen.rtt_s == pytest.approx(RTT_S) and not seen.early
    assert path.model.note(path.packet(0.01, overtook=True)) == pytest.approx(0.01), "behind a lost one it queued"


def test_whether_there_was_more_to_send_is_judged_by_half_of_the_epoch() -> None:
    path = Path().settled()
    assert path.epoch().limited
    assert not path.epoch(app_limited=True).limited


def test_the_rate_is_what_arrives() -> None:
    assert Path(250e3).settled().model.rate.value == pytest.approx(250e3, rel=0.01)


def test_a_queue_that_stays_shows_a_slower_link() -> None:
    path = Path().settled()
    path.rate = 100e3
    slower = [path.model.slower_rate(path.packet(0.05)) for _ in range(30)]
    found = [rate for rate in slower if rate is not None]
    assert found and found[0] == pytest.approx(100e3, rel=0.05)
    assert path.model.replace_rate(path.now, found[0]), "that is clearly less"
    assert path.model.rate.value == found[0]
    assert not path.model.replace_rate(path.now, 0.9 * found[0])


def test_a_packet_or_two_of_a_thin_link_show_no_rate() -> None:
    slowdown, packet_s = Slowdown(DEFAULT_HYBRID), 0.15
    assert slowdown.arrives(1.0, 0, packet_s) is None
    assert slowdown.arrives(1.2, 208, packet_s) is None, "a small one"
    assert slowdown.arrives(1.0 + SPAN_PACKETS * packet_s, 4800, packet_s) == pytest.approx(8000.0)


def test_when_the_queue_of_a_slower_link_has_gone_its_rate_is_all_that_it_can_do() -> None:
    path = Path().settled()
    path.rate = 100e3
    path.epoch(0.05)
    assert path.model.replace_rate(path.now, 100e3) and path.model.rate.peak > 400e3
    path.epoch()
    assert path.model.rate.peak == path.model.rate.value and path.model.slowdown.faster_rate is None


def test_a_longer_path_is_no_queue_any_more() -> None:
    path = Path().settled()
    path.epoch(0.03)
    path.model.longer_path(path.now, 0.03)
    assert path.model.rtt_s == pytest.approx(RTT_S + 0.03) and path.model.view.queue_s == 0.0
    assert path.epoch(0.03).queue_s == pytest.approx(0.0, abs=1e-6)


LARGE_BYTES, LONG_S = 12_000, 8.0


def _long_with_large_packets() -> Path:
    """Large packets have found a queue of 8 s for longer than the least delay counts; then it has gone, and there are
    small ones only."""
    path = Path()
    path.model.larger_packet(LARGE_BYTES)
    for _ in range(20):
        path.epoch(nbytes=LARGE_BYTES)
        path.epoch()
    until_s = path.now + MEMORY_S + 1.0
    while path.now < until_s:
        path.epoch(LONG_S, nbytes=LARGE_BYTES)
    assert path.model.rtt_s is not None and path.model.rtt_s > LONG_S
    return path


def test_small_packets_show_that_the_path_is_short_again_though_no_large_one_goes_any_more() -> None:
    path = _long_with_large_packets()
    gone_s = path.now
    while path.model.rtt_s is None or path.model.rtt_s > 2 * RTT_S:
        path.epoch(app_limited=True)
        assert path.now < gone_s + STALE_S + 0.5


def test_what_has_not_been_sent_for_as_long_as_the_least_delay_counts_is_not_what_there_is_to_send() -> None:
    path = _long_with_large_packets()
    until_s = path.now + MEMORY_S + 1.0
    while path.now < until_s:
        path.model.longest = FRAGMENT_BYTES
        path.epoch()
    assert path.model.fragment == FRAGMENT_BYTES
    assert path.epoch(0.02).queue_s == pytest.approx(0.02, abs=1e-3), "they are the large ones now"


def test_a_large_packet_now_and_then_is_still_what_there_is_to_send() -> None:
    path = _long_with_large_packets()
    for _ in range(10):
        path.model.longest = LARGE_BYTES
        path.epoch(nbytes=LARGE_BYTES)
        until_s = path.now + MEMORY_S / 2
        while path.now < until_s:
            path.model.longest = FRAGMENT_BYTES
            path.epoch()
    assert path.model.fragment == LARGE_BYTES


def test_packets_that_come_sooner_than_over_the_empty_path_are_noticed() -> None:
    path = Path().settled()
    path.epoch(0.05)
    path.model.longer_path(path.now, 0.05)
    path.epoch(0.05)
    assert path.epoch().early


def test_a_larger_packet_takes_longer_and_is_no_queue_for_it() -> None:
    path = Path().settled()
    rate = path.model.rate.peak
    base_s = path.model.delay.empty_s(segmented=False)
    path.model.larger_packet(2 * FRAGMENT_BYTES)
    assert path.model.fragment == 2 * FRAGMENT_BYTES
    assert path.model.delay.empty_s(segmented=False) - base_s == pytest.approx(FRAGMENT_BYTES / rate)


@pytest.mark.parametrize("jitter", [True, False])
def test_much_larger_packets_that_jitter_holds_longer_are_no_queue(jitter: bool) -> None:
    path = Path().settled()
    model = path.model
    if jitter:
        model.view.learn()
        model.view.jitter_s = 0.002
    model.larger_packet(2 * FRAGMENT_BYTES)
    path.epoch()  # of small ones too
    seen = path.epoch(0.003)
    assert seen.queue_s == pytest.approx(0.0 if jitter else 0.003, abs=1e-4)
    assert path.epoch(0.009).queue_s == pytest.approx(seen.queue_s + 0.006, abs=1e-4), "what grows since is one"


def test_what_jitter_holds_is_no_more_than_it_can() -> None:
    path = Path().settled()
    path.model.view.learn()
    path.model.view.jitter_s = 0.002
    path.model.larger_packet(2 * FRAGMENT_BYTES)
    path.epoch()
    most_s = DEFAULT_HYBRID.segmented_spreads * path.model.view.jitter_s
    assert path.epoch(0.5).queue_s == pytest.approx(0.5 - most_s, abs=1e-3)


def test_packets_that_follow_each_other_closely_take_no_longer_than_that() -> None:
    """A window of few packets shows a small rate, by which each would take long, and hide the jitter."""
    path = Path(rate=100e3).settled()
    assert not path.model.view.jittery
    packet_s = FRAGMENT_BYTES / 1e6
    for _ in range(20):
        model, now = path.model, path.now
        model.begin_epoch(now)
        for number in range(8):  # four at once now and again, two of which are held by half of a packet's time
            path.now = now + 0.05 * (number // 4) + packet_s * (number % 4)
            sample = path.packet(0.006 * (number % 2))
            path.now -= FRAGMENT_BYTES / path.rate
            model.note(sample)
        path.now = now + 0.1
        model.close_epoch(path.now, DEFAULT_HYBRID.base_window_s, path.window, steered=True)
    assert path.model.view.jittery


def test_a_restart_keeps_length_and_rate() -> None:
    path = Path().settled()
    rate, rtt_s = path.model.rate.value, path.model.rtt_s
    path.model.restart()
    assert (path.model.rate.value, path.model.rtt_s, path.model.epoch_s) == (rate, rtt_s, None)
    assert path.epoch().queue_s <= DEFAULT_HYBRID.target_s
