"""What links do to packets and connections: loss, order, queues, blackouts, broken connections, crashes."""

import math
from dataclasses import replace
from itertools import pairwise
from random import Random

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_sim.links import LOST, NS, Link
from sern_sim.models import PERFECT, BurstLoss, Flap, Jitter, LinkModel, RateStep, Window
from sern_sim.network import Network
from sern_sim.ports import SoloNode
from tests.sern_sim.toys import (
    ArqReceiver,
    ArqSender,
    Hub,
    Ticker,
    Wire,
    elapsed,
    is_up,
    joined,
    number_of,
    numbered,
    send_at,
)

SAMPLES = 20_000


def within(count: int, total: int, probability: float) -> bool:
    """Whether a binomial count is within five standard deviations of its mean."""
    return abs(count - total * probability) <= 5 * math.sqrt(total * probability * (1 - probability))


def flooded(model: LinkModel, *, count: int = SAMPLES, seed: int = 3) -> tuple[Network, Wire, Link]:
    """`count` numbered packets, one every millisecond."""
    a, b = Wire(), Wire()
    network, hop = joined(model, a, b, seed=seed)
    numbers = iter(range(count))
    call = network.every(0.001, lambda now: a.outbox.append(numbered(next(numbers))), node=a)
    network.run_until((count - 1) / 1000)
    call.cancel()
    network.run_for(100.0)
    return network, b, hop.forward.link


# ---------------------------------------------------------------------- loss, order, copies


@pytest.mark.parametrize("loss", [0.005, 0.02, 0.3])
def test_independent_loss_is_binomial(loss: float) -> None:
    _, b, link = flooded(LinkModel(loss=loss))
    assert within(link.lost_packets, SAMPLES, loss)
    assert len(b.inbox) == SAMPLES - link.lost_packets
    # Independent: a loss follows a loss as often as anything does.
    got = {number_of(data) for data in b.inbox}
    lost = [n for n in range(SAMPLES - 1) if n not in got]
    assert within(sum(n + 1 not in got for n in lost), len(lost), loss)


def test_burst_loss_has_the_mean_and_the_bursts_of_its_model() -> None:
    burst = BurstLoss(enter=0.01, leave=0.2, bad_loss=0.9, good_loss=0.001)
    _, b, link = flooded(LinkModel(burst_loss=burst), count=60_000)
    assert link.lost_packets / 60_000 == pytest.approx(burst.mean_loss, rel=0.1)
    got = {number_of(data) for data in b.inbox}
    lost = [n for n in range(59_999) if n not in got]
    after_loss = sum(n + 1 not in got for n in lost) / len(lost)
    assert after_loss > 10 * burst.mean_loss  # about bad_loss · (1 - leave)


def test_certain_loss_and_no_loss() -> None:
    assert flooded(LinkModel(loss=1.0), count=100)[1].inbox == []
    assert len(flooded(LinkModel(burst_loss=BurstLoss(0.0, 0.0)), count=100)[1].inbox) == 100


@pytest.mark.parametrize(("jitter", "spread"), [(Jitter.UNIFORM, 1.0), (Jitter.NORMAL, 3.0)])
def test_jitter_spreads_the_delay_and_keeps_the_order(jitter: Jitter, spread: float) -> None:
    # Packets a second apart, so that none waits for the one before it.
    a, b = Wire(), Wire()
    network, _ = joined(LinkModel(delay_s=0.05, jitter_s=0.01, jitter=jitter), a, b)
    network.every(1.0, lambda now: a.outbox.append(b"x"), node=a)
    network.run_until(2000.5)
    delays = [at_s - round(at_s) for at_s in elapsed(network, b)]
    assert 0.05 - spread * 0.01 - 1e-9 <= min(delays) < 0.05 - 0.8 * spread * 0.01
    assert 0.05 + spread * 0.01 + 1e-9 >= max(delays) > 0.05 + 0.8 * spread * 0.01
    assert sum(delays) / len(delays) == pytest.approx(0.05, abs=0.001)
    _, dense, _ = flooded(LinkModel(delay_s=0.05, jitter_s=0.01, jitter=jitter), count=2000)
    assert [number_of(data) for data in dense.inbox] == list(range(2000))


def test_jitter_never_makes_a_packet_arrive_before_it_was_sent() -> None:
    network, b, _ = flooded(LinkModel(delay_s=0.001, jitter_s=0.05), count=500)
    assert all(at_s >= number_of(data) / 1000 for at_s, data in zip(elapsed(network, b), b.inbox, strict=True))


def test_reordering_holds_packets_back() -> None:
    network, b, link = flooded(LinkModel(delay_s=0.01, reorder=0.1, reorder_delay_s=0.0045))
    assert within(link.reordered_packets, SAMPLES, 0.1)
    late = 0
    for at_s, data in zip(elapsed(network, b), b.inbox, strict=True):
        delay_s = round(at_s - number_of(data) / 1000, 6)
        assert delay_s in (0.01, 0.0145)
        late += delay_s == 0.0145
    assert late == link.reordered_packets
    numbers = [number_of(data) for data in b.inbox]
    assert numbers != sorted(numbers)
    assert sorted(numbers) == list(range(SAMPLES))


def test_what_waited_for_jitter_comes_as_fast_as_the_rate_allows() -> None:
    model = LinkModel(rate_bps=80_000, delay_s=0.05, jitter_s=0.02, rate_after_jitter=True, queue_packets=10_000)
    network, b, _ = flooded(model, count=1000)
    at = list(elapsed(network, b))
    took_s = 8 * len(b.inbox[0]) / 80_000
    assert min(later - earlier for earlier, later in pairwise(at)) >= took_s - 1e-9
    together = elapsed(*flooded(replace(model, rate_after_jitter=False), count=1000)[:2])
    assert min(later - earlier for earlier, later in pairwise(together)) < took_s / 2


def test_one_that_is_not_held_back_overtakes() -> None:
    network, b, link = flooded(LinkModel(delay_s=0.01, reorder=0.1))
    delays = [round(at_s - number_of(data) / 1000, 6) for at_s, data in zip(elapsed(network, b), b.inbox, strict=True)]
    assert sorted(set(delays)) == [0.0, 0.01] and delays.count(0.0) == link.reordered_packets


def test_duplicates_arrive_twice_and_are_counted() -> None:
    _, b, link = flooded(LinkModel(duplicate=0.05))
    assert within(link.duplicate_packets, SAMPLES, 0.05)
    assert len(b.inbox) == SAMPLES + link.duplicate_packets == link.delivered_packets
    assert link.duplicate_bytes == 8 * link.duplicate_packets


def test_every_packet_is_accounted_for() -> None:
    model = LinkModel(
        rate_bps=60_000, delay_s=0.05, jitter_s=0.02, loss=0.1, reorder=0.1, reorder_delay_s=0.1, duplicate=0.1,
        queue_packets=10, blackouts=(Window(2.0, 4.0), Window(5.0, 5.5)),
    )  # fmt: skip
    network, _, link = flooded(model, count=9000)
    stats = link.stats(network.elapsed_ns)
    assert min(stats.lost_packets, stats.blackout_packets, stats.queue_drops, stats.duplicate_packets) > 10
    assert stats.sent_packets == 9000
    assert stats.sent_packets + stats.duplicate_packets == (
        stats.delivered_packets + stats.lost_packets + stats.blackout_packets + stats.queue_drops
    )


# ---------------------------------------------------------------------- queue and counters


def test_a_full_queue_drops_what_comes_last() -> None:
    a, b = Wire(), Wire()
    network, hop = joined(LinkModel(rate_bps=80_000, queue_packets=5), a, b)  # 100 bytes are 10 ms
    send_at(network, a, 1.0, *(numbered(n, 100) for n in range(8)))
    send_at(network, a, 1.0101, numbered(8, 100), numbered(9, 100))  # one has left by then
    network.run_until(1.005)
    assert hop.forward.backlog_packets == 5
    network.run_until(2.0)
    assert [number_of(data) for data in b.inbox] == [0, 1, 2, 3, 4, 8]
    assert hop.forward.stats.queue_drops == 4
    assert hop.forward.backlog_packets == 0


def test_utilisation_and_goodput_of_a_part_of_the_run() -> None:
    a, b = Ticker(0.01, size_bytes=100), Wire()
    model = LinkModel(rate_bps=160_000, overhead_bytes=25, rate_steps=(RateStep(10.0, 200_000),))
    network, hop = joined(model, a, b)
    network.run_until(10.0)
    first = hop.forward.stats
    network.run_until(20.0)
    second = hop.forward.stats.minus(first)
    assert first.utilisation == pytest.approx(100_000 / 160_000, rel=0.002)
    assert second.elapsed_s == 10.0
    assert second.capacity_bits == 2_000_000
    assert second.utilisation == pytest.approx(0.5, rel=0.002)
    assert second.goodput_bps == pytest.approx(80_000, rel=0.002)
    assert hop.backward.stats.utilisation == 0.0  # unlimited


def test_a_saturated_link_is_used_in_full_and_blackouts_are_no_capacity() -> None:
    a, b = Ticker(0.01, size_bytes=1000), Wire()
    model = LinkModel(rate_bps=400_000, queue_packets=10, blackouts=(Window(10.0, 20.0),))
    network, hop = joined(model, a, b)
    network.run_until(15.0)
    assert hop.forward.stats.capacity_bits == 4_000_000
    # 20 ms a packet: the one being sent when the link went away had not crossed it.
    assert hop.forward.stats.utilisation == pytest.approx(1.0, abs=0.003)
    network.run_until(30.0)
    assert hop.forward.stats.capacity_bits == 8_000_000
    assert hop.forward.stats.utilisation == pytest.approx(1.0, abs=0.003)
    assert hop.forward.stats.utilisation <= 1.0


# ---------------------------------------------------------------------- blackouts of datagrams


def test_a_blackout_loses_what_is_queued_under_way_or_sent() -> None:
    a, b = Wire(), Wire()
    model = LinkModel(rate_bps=80_000, delay_s=0.1, blackouts=(Window(1.0, 2.0),))  # 100 bytes are 10 ms
    network, hop = joined(model, a, b)
    send_at(network, a, 0.8, numbered(0, 100))  # arrives at 0.91
    send_at(network, a, 0.89, numbered(1, 100))  # would arrive exactly at 1.0
    send_at(network, a, 0.99, *(numbered(n, 100) for n in range(2, 80)))  # queued
    send_at(network, a, 1.0, numbered(90, 100))
    send_at(network, a, 1.999999999, numbered(91, 100))
    send_at(network, a, 2.0, numbered(92, 100))  # finds an empty queue
    network.run_until(3.0)
    assert [number_of(data) for data in b.inbox] == [0, 92]
    assert elapsed(network, b) == [0.91, 2.11]
    assert hop.forward.stats.blackout_packets == 81
    assert a.history == b.history == ["connected"]  # nothing tells a datagram port


def test_flapping() -> None:
    _, b, _ = flooded(LinkModel(flap=Flap(up_s=1.0, down_s=0.5, start_s=2.0)), count=8000)
    numbers = {number_of(data) for data in b.inbox}
    assert numbers == {n for n in range(8000) if n < 2000 or (n - 2000) % 1500 < 1000}


def test_an_arq_gets_everything_through_a_terrible_link() -> None:
    model = LinkModel(
        rate_bps=200_000, delay_s=0.05, jitter_s=0.02, loss=0.2, reorder=0.1, reorder_delay_s=0.1, duplicate=0.1,
        flap=Flap(1.0, 1.0),
    )  # fmt: skip
    sender, receiver = ArqSender(300), ArqReceiver()
    network, _ = joined(model, sender, receiver, backward=model)
    network.run_until_true(lambda: sender.done, within_s=600.0)
    assert receiver.numbers == set(range(300))
    assert sender.transmissions > 400


# ---------------------------------------------------------------------- streams


def test_a_stream_keeps_order_and_loses_nothing() -> None:
    model = LinkModel(rate_bps=2e6, delay_s=0.02, jitter_s=0.01, loss=0.02, queue_packets=1).as_stream()
    _, b, link = flooded(model)
    assert [number_of(data) for data in b.inbox] == list(range(SAMPLES))
    assert within(link.stalls, SAMPLES, 0.02)
    assert link.lost_packets == link.queue_drops == 0


def test_a_loss_in_a_stream_stalls_what_is_behind_it() -> None:
    a, b = Wire(), Wire()
    model = LinkModel(delay_s=0.05, loss=0.03, stall_s=0.2).as_stream()
    network, hop = joined(model, a, b, seed=5)
    network.every(0.01, lambda now: a.outbox.append(numbered(round(network.elapsed_s * 100))), node=a)
    network.run_until(20.0)
    delays = [round(at_s - number_of(data) / 100, 6) for at_s, data in zip(elapsed(network, b), b.inbox, strict=True)]
    assert min(delays) == 0.05
    assert max(delays) >= 0.05 + 0.3  # a round trip and the timer
    assert len(b.inbox) > 1900
    assert within(hop.forward.stats.stalls, 2000, 0.03)
    # Head of line: the packet behind a stalled one arrives with it.
    assert sum(x == y for x, y in zip(elapsed(network, b), elapsed(network, b)[1:], strict=False)) > 800


def test_a_large_write_is_charged_by_the_segment() -> None:
    a, b = Wire(), Wire()
    network, _ = joined(LinkModel(rate_bps=80_000, overhead_bytes=40).as_stream(), a, b)
    send_at(network, a, 1.0, bytes(1449))  # two segments
    network.run_until(2.0)
    assert elapsed(network, b) == [1.0 + (1449 + 80) * 8 / 80_000]


def test_a_short_blackout_freezes_a_stream() -> None:
    a, b = Wire(), Wire()
    model = LinkModel(
        rate_bps=80_000, delay_s=0.1, blackouts=(Window(1.0, 3.0), Window(5.0, 6.0)), disconnect_after_s=5.0
    ).as_stream()
    network, hop = joined(model, a, b)
    send_at(network, a, 0.95, numbered(0, 100))  # on the path: 40 ms of delay left
    send_at(network, a, 0.985, numbered(1, 100), numbered(2, 100))  # the second half serialised
    send_at(network, a, 2.0, numbered(3, 100))
    send_at(network, a, 5.5, numbered(4, 100))
    network.run_until(10.0)
    assert elapsed(network, b) == [3.06, 3.095, 3.105, 3.115, 6.11]
    assert [number_of(data) for data in b.inbox] == [0, 1, 2, 3, 4]
    assert a.history == ["connected"]
    assert hop.forward.stats.blackout_packets == 0


def test_a_long_blackout_breaks_a_stream_which_comes_back() -> None:
    a, b = Ticker(0.1), Wire()
    model = LinkModel(
        delay_s=0.05,
        blackouts=(Window(2.0, 4.0), Window(10.0, 30.0), Window(40.0, 50.0)),
        disconnect_after_s=5.0,
        reconnect_s=0.5,
    ).as_stream()
    network, hop = joined(model, a, b, backward=model)
    network.run_until(14.99)
    assert a.history == b.history == ["connected"]
    network.run_until(15.0)
    assert a.history == b.history == ["connected", "disconnected"]
    assert not is_up(hop)
    network.run_until(30.49)
    assert not is_up(hop)
    network.run_until(30.5)
    assert is_up(hop)
    network.run_until(60.0)
    assert a.history == b.history == ["connected", "disconnected"] * 2 + ["connected"]
    # What was under way is gone: sent in [9.95, 15) and again in [39.95, 45).
    assert hop.forward.stats.broken_packets == pytest.approx(2 * 50, abs=4)
    times = elapsed(network, b)
    assert not [at_s for at_s in times if 10.0 < at_s < 30.5 or 40.0 < at_s < 50.5]
    assert min(at_s for at_s in times if at_s > 20.0) == pytest.approx(30.55, abs=1e-6)


def test_a_blackout_of_one_direction_is_enough() -> None:
    a, b = Wire(), Wire()
    model = LinkModel(blackouts=(Window(1.0, 9.0),), disconnect_after_s=2.0).as_stream()
    network, hop = joined(PERFECT.as_stream(), a, b, backward=model)
    network.run_until(3.0)
    assert a.history == b.history == ["connected", "disconnected"]
    network.run_until(9.0 + max(model.reconnect_s, PERFECT.reconnect_s))
    assert is_up(hop)


def test_a_stream_that_starts_in_a_blackout_connects_when_the_path_is_there() -> None:
    a, b = Wire(), Wire()
    network, hop = joined(LinkModel(blackouts=(Window(0.0, 3.0),)).as_stream(), a, b)
    network.run_until(2.999)
    assert a.history == []
    network.run_until(3.0)
    assert is_up(hop) and a.history == b.history == ["connected"]


def test_deadlines_are_served_before_the_first_connection_and_of_a_new_node() -> None:
    class Clock(Ticker):
        """Runs from the start, connected or not."""

        def __init__(self, begin_s: float) -> None:
            super().__init__(0.1)
            self.begin_s = begin_s

        def connected(self, *, now: float) -> None:
            self.history.append("connected")

    network = Network(1)
    model = LinkModel(blackouts=(Window(0.0, 100.0),)).as_stream()
    old = SoloNode(Clock(network.start_s))
    network.join(old.port, old, Wire(), None, model, model)
    network.run_until(9.99)
    new = Clock(network.now)
    network.replace_node(old, SoloNode(new))
    network.run_until(20.0)
    assert isinstance(old.port, Clock)
    assert (old.port.sent, new.sent) == (100, 101)
    assert old.port.history == new.history == []


def test_a_reconnect_needs_the_path_for_its_whole_time() -> None:
    a, b = Wire(), Wire()
    model = LinkModel(
        blackouts=(Window(1.0, 5.0), Window(5.3, 6.0)), disconnect_after_s=2.0, reconnect_s=0.5
    ).as_stream()
    network, hop = joined(model, a, b)
    network.run_until(6.49)
    assert not is_up(hop)
    network.run_until(6.5)
    assert is_up(hop)


def test_flapping_breaks_a_hasty_stream_and_not_a_patient_one() -> None:
    for patience_s, broken in ((0.5, True), (2.0, False)):
        a, b = Wire(), Wire()
        model = LinkModel(flap=Flap(1.0, 1.0), disconnect_after_s=patience_s, reconnect_s=0.2).as_stream()
        network, _ = joined(model, a, b)
        network.run_until(20.0)
        assert ("disconnected" in a.history) is broken
        if broken:
            assert a.history.count("connected") == 10


def test_break_connection_loses_what_is_under_way() -> None:
    a, b = Wire(), Wire()
    network, hop = joined(LinkModel(delay_s=1.0, reconnect_s=2.0).as_stream(), a, b, backward=PERFECT.as_stream())
    send_at(network, a, 1.0, b"lost")
    send_at(network, a, 5.0, b"kept")
    network.at(1.5, lambda now: hop.break_connection())
    network.run_until(3.0)
    hop.break_connection()  # down already: nothing happens
    network.run_until(7.0)
    assert b.inbox == [b"kept"]
    assert elapsed(network, b) == [6.0]
    assert a.history == b.history == ["connected", "disconnected", "connected"]
    assert hop.forward.stats.broken_packets == 1


def test_break_connection_with_its_own_reconnect_time_in_datagram_mode() -> None:
    a, b = Wire(), Wire()
    network, hop = joined(LinkModel(delay_s=1.0), a, b)
    send_at(network, a, 1.0, b"lost")
    network.at(1.5, lambda now: hop.break_connection(reconnect_s=10.0))
    network.run_until(11.4)
    assert not is_up(hop)
    network.run_until(11.5)
    assert is_up(hop) and b.inbox == []


def test_nothing_is_asked_of_a_disconnected_port_but_its_deadlines_are_served() -> None:
    class Patient(Ticker):
        def disconnected(self, *, now: float) -> None:
            self.history.append("disconnected")

        def next_datagram(self, *, now: float) -> bytes | None:
            assert self.history[-1] == "connected"
            return super().next_datagram(now=now)

    a, b = Patient(0.1), Wire()
    network, hop = joined(PERFECT.as_stream(), a, b)
    network.at(1.05, lambda now: hop.break_connection(reconnect_s=5.0))
    network.run_until(6.04)
    assert a.sent == 61
    assert len(b.inbox) == 11
    network.run_until(6.05)
    assert len(b.inbox) == 62  # kept by the port and sent on reconnection, when the toy makes one more


# ---------------------------------------------------------------------- crashes


@pytest.mark.parametrize("stream", [True, False])
def test_a_crashed_relay_comes_back_as_a_new_object(stream: bool) -> None:
    model = LinkModel(delay_s=0.01, reconnect_s=0.5)
    model = model.as_stream() if stream else model
    old, new = Hub(2), Hub(2)
    alice, bob = Ticker(0.1), Wire()
    network = Network(1)
    for client, port in ((alice, old.wires[0]), (bob, old.wires[1])):
        network.join(client, None, port, old, model, model)
    network.at(10.0, lambda now: network.crash_node(old))
    network.at(15.0, lambda now: network.replace_node(old, new))
    network.run_until(20.0)
    silence = [at_s for at_s in elapsed(network, bob) if 10.01 <= at_s < 15.5]
    assert silence == []
    assert max(elapsed(network, bob)) > 19.9
    assert new.wires[0].inbox and old.wires[0].history == ["connected"]
    assert new.wires[0].history == ["connected"]
    # A stream's peer sees its connection break; a datagram's peer is told nothing.
    assert bob.history == (["connected", "disconnected", "connected"] if stream else ["connected"])
    broken = network.hops[0].forward.stats.broken_packets
    assert broken == (0 if stream else pytest.approx(55, abs=2))


def test_replacing_a_live_node_crashes_it_first() -> None:
    old, new, peer = Wire(), Ticker(0.1), Wire()
    network = Network(1)
    nodes = SoloNode(old), SoloNode(new)
    network.join(old, nodes[0], peer, None, PERFECT.as_stream(), PERFECT.as_stream())
    network.at(1.0, lambda now: network.replace_node(*nodes))
    network.run_until(3.0)
    assert peer.history == ["connected", "disconnected", "connected"]
    assert elapsed(network, peer)[0] == pytest.approx(1.5, abs=1e-6)
    network.crash_node(nodes[1])
    with pytest.raises(UsageError, match="gone already"):
        network.crash_node(nodes[1])
    with pytest.raises(UsageError, match="no port in the network"):
        network.crash_node(nodes[0])


def test_two_crashed_nodes_connect_when_both_are_back() -> None:
    first, second = SoloNode(Wire()), SoloNode(Wire())
    network = Network(1)
    hop = network.join(first.port, first, second.port, second, PERFECT.as_stream(), PERFECT.as_stream())
    network.run_until(1.0)
    network.crash_node(first)
    network.crash_node(second)
    network.replace_node(first, SoloNode(Wire()))
    network.run_until(5.0)
    assert not is_up(hop)
    network.replace_node(second, SoloNode(Wire()))
    network.run_until(6.0)
    assert is_up(hop)


def test_replacement_needs_a_port_for_each_joined_one() -> None:
    hub, port = Hub(2), Wire()
    network = Network(1)
    network.join(port, None, hub.wires[0], hub, PERFECT, PERFECT, name="up")
    with pytest.raises(UsageError, match=r"no new port for up\.b"):
        network.replace_node(hub, Hub(2), ports=[])


# ---------------------------------------------------------------------- the link alone


def test_a_link_can_be_asked_without_a_network() -> None:
    link = Link(LinkModel(rate_bps=8_000_000, delay_s=0.01, blackouts=(Window(1.0, 2.0),)), Random(1))
    assert link.send(1000, 0) == 11_000_000
    assert link.send(1000, 0) == 12_000_000
    assert link.send(1000, NS) == LOST
    assert link.send(1000, 2 * NS) == 2 * NS + 11_000_000
    assert link.backlog_packets(2 * NS) == 1
    assert link.stats(3 * NS).carried_bytes == 3000


@pytest.mark.parametrize(
    ("model", "t_s", "window_s"),
    [
        (LinkModel(blackouts=(Window(1, 2), Window(3, 4))), 0, (1, 2)),
        (LinkModel(blackouts=(Window(1, 2), Window(3, 4))), 2, (3, 4)),
        (LinkModel(flap=Flap(1, 2, 5)), 0, (6, 8)),
        (LinkModel(flap=Flap(1, 2, 5)), 7.9, (6, 8)),
        (LinkModel(flap=Flap(1, 2, 5)), 8, (9, 11)),
    ],
)
def test_link_and_model_agree_on_blackouts(model: LinkModel, t_s: float, window_s: tuple[float, float]) -> None:
    assert model.next_blackout(t_s) == window_s
    start_ns, end_ns = Link(model, Random(1)).blackout_after(round(t_s * NS))
    assert (start_ns, end_ns) == (window_s[0] * NS, window_s[1] * NS)
