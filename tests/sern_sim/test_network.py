"""The virtual-time network: order of events, time, scripts, nodes, determinism."""

from collections.abc import Sequence

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_sim.events import EventLog, SimulationStuck, SimulationTimeoutError
from sern_sim.models import PERFECT, BurstLoss, Jitter, LinkModel, RateStep
from sern_sim.network import Network
from sern_sim.ports import Port, SoloNode
from tests.sern_sim.toys import (
    ArqReceiver,
    ArqSender,
    DirtyHub,
    Hub,
    Ticker,
    Wire,
    elapsed,
    joined,
    number_of,
    numbered,
    send_at,
)

ROUGH = LinkModel(
    rate_bps=400_000,
    delay_s=0.04,
    jitter_s=0.01,
    jitter=Jitter.UNIFORM,
    loss=0.05,
    burst_loss=BurstLoss(0.01, 0.2, 0.8, 0.01),
    reorder=0.05,
    reorder_delay_s=0.03,
    duplicate=0.02,
    queue_packets=20,
    overhead_bytes=28,
)


# ---------------------------------------------------------------------- timing


def test_a_packet_takes_its_serialisation_time_and_the_delay() -> None:
    a, b = Wire(), Wire()
    network, _ = joined(LinkModel(rate_bps=1_000_000, delay_s=0.025, overhead_bytes=28), a, b)
    send_at(network, a, 1.0, bytes(972), bytes(972), bytes(97))
    network.run_until(2.0)
    # 1000 bytes at 1 Mbit/s are 8 ms, 125 bytes 1 ms; packets queue behind each other.
    assert elapsed(network, b) == [1.033, 1.041, 1.042]


@pytest.mark.parametrize("streams", [False, True])
def test_hops_beside_each_other_share_the_bottleneck(streams: bool) -> None:
    a, b, c, d = Wire(), Wire(), Wire(), Wire()
    model = LinkModel(rate_bps=1_000_000, delay_s=0.025, overhead_bytes=28)
    model = model.as_stream() if streams else model
    network, hop = joined(model, a, b, backward=model)
    beside = network.join(c, None, d, None, model, model, name="beside", beside=hop)
    send_at(network, a, 1.0, bytes(972), bytes(972))
    send_at(network, c, 1.001, bytes(972))
    send_at(network, a, 1.002, bytes(972))
    network.run_until(2.0)
    assert elapsed(network, b) == [1.033, 1.041, 1.057]
    assert elapsed(network, d) == [1.049]
    send_at(network, a, 2.0, bytes(972), bytes(972))
    network.at(2.001, lambda _now: hop.break_connection())
    send_at(network, c, 2.002, bytes(972))
    network.run_until(2.1)
    assert elapsed(network, d)[-1] == 2.049  # what the broken one had sent is still ahead of it
    assert beside.forward.stats.carried_bytes == 2000


def test_links_that_share_a_bottleneck_are_of_one_rate() -> None:
    network, hop = joined(LinkModel(rate_bps=1_000_000), Wire(), Wire())
    other = LinkModel(rate_bps=2_000_000)
    with pytest.raises(UsageError, match="same rates"):
        network.join(Wire(), None, Wire(), None, other, other, beside=hop)


def test_a_rate_change_in_the_middle_of_a_packet_is_exact() -> None:
    a, b = Wire(), Wire()
    model = LinkModel(rate_bps=8_000, rate_steps=(RateStep(1.5, 80_000), RateStep(3.0, None)))
    network, _ = joined(model, a, b)
    send_at(network, a, 1.0, bytes(1000))  # half a second at 1 byte/ms, 500 bytes at 10 bytes/ms
    send_at(network, a, 2.99, bytes(1000))  # 10 ms at 10 bytes/ms, then unlimited
    network.run_until(4.0)
    assert elapsed(network, b) == [1.55, 3.0]


def test_no_rate_and_no_delay_deliver_at_the_same_instant() -> None:
    a, b = Wire(), Wire()
    network, _ = joined(PERFECT, a, b)
    send_at(network, a, 0.5, *(numbered(n) for n in range(1000)))
    network.run_until(0.5)
    assert elapsed(network, b) == [0.5] * 1000
    assert [number_of(data) for data in b.inbox] == list(range(1000))


def test_the_clock_has_an_offset_and_timers_never_fire_early() -> None:
    ticker, b = Ticker(0.02), Wire()  # Ticker asserts that now is not before its deadline
    network, _ = joined(LinkModel(delay_s=0.001), ticker, b)
    assert network.now >= 1e5
    network.run_until(10.0)
    assert network.now == pytest.approx(network.start_s + 10.0, abs=1e-9)
    assert elapsed(network, b) == pytest.approx([0.001 + 0.02 * n for n in range(len(b.inbox))], abs=1e-8)
    assert ticker.sent == 501
    assert len(b.inbox) == 500  # the last is under way


def test_now_never_goes_back() -> None:
    seen: list[float] = []

    class Watcher(Ticker):
        def receive(self, data: bytes, *, now: float) -> None:
            seen.append(now)

        def next_datagram(self, *, now: float) -> bytes | None:
            seen.append(now)
            return super().next_datagram(now=now)

    a, b = Watcher(0.0007), Watcher(0.0011)
    network, _ = joined(LinkModel(rate_bps=1e6, delay_s=0.003), a, b, backward=LinkModel(delay_s=1e-6))
    network.run_until(2.0)
    assert seen == sorted(seen)
    assert len(seen) > 5000


def test_equal_times_are_served_in_the_order_in_which_they_were_made() -> None:
    calls: list[int] = []
    network = Network(1)
    for n in range(50):
        network.at(1.0, lambda now, n=n: calls.append(n))  # type: ignore[misc]
    network.run_until(1.0)
    assert calls == list(range(50))


def test_deadlines_that_move_leave_no_trail_in_the_heap() -> None:
    class Restless(Wire):
        """Two deadlines, one near and one far that is pushed back all the time, as with ack and retransmission."""

        near_s = far_s = 0.0

        def connected(self, *, now: float) -> None:
            self.near_s, self.far_s = now + 0.01, now + 5.0

        def next_deadline(self) -> float:
            return min(self.near_s, self.far_s)

        def handle_timeout(self, *, now: float) -> None:
            self.near_s = now + (0.01 if self.near_s < self.far_s else 1.0)
            self.far_s = now + 5.0

    network, _ = joined(PERFECT, Restless(), Wire())
    network.run_until(60.0)
    assert len(network._heap) <= 2
    assert network.event_count < 6100


def test_an_hour_at_256_kbit_s_costs_a_bounded_number_of_events() -> None:
    model = LinkModel(rate_bps=256_000, delay_s=0.1, overhead_bytes=28, loss=0.01)
    sender, receiver = ArqSender(10**9, window=12, size_bytes=1172, timeout_s=3.0), ArqReceiver()
    network, hop = joined(model, sender, receiver, backward=model)
    network.run_until(3600.0)
    forward, backward = hop.forward.stats, hop.backward.stats
    assert forward.sent_packets > 75_000
    assert forward.utilisation > 0.8
    delivered = forward.delivered_packets + backward.delivered_packets
    # One event for each packet that arrives, and few timers besides.
    assert delivered < network.event_count < 1.2 * delivered


# ---------------------------------------------------------------------- scripts


def test_every_does_not_drift_and_can_be_cancelled() -> None:
    network = Network(1)
    times: list[float] = []
    call = network.every(0.1, lambda now: times.append(network.elapsed_s), first_s=0.05)
    network.run_until(1.0)
    call.cancel()
    network.run_for(1.0)
    assert times == pytest.approx([0.05 + 0.1 * n for n in range(10)], abs=1e-12)
    assert network.elapsed_s == 2.0


def test_a_call_may_schedule_another_and_cancel_itself() -> None:
    network = Network(1)
    times: list[float] = []

    def again(now: float) -> None:
        times.append(network.elapsed_s)
        if len(times) < 3:
            network.after(0.25, again)

    network.at(1.0, again)
    repeated = network.every(0.1, lambda now: repeated.cancel())
    network.run_until(3.0)
    assert times == [1.0, 1.25, 1.5]


def test_run_until_true_tells_how_long_it_took_or_what_did_not_happen() -> None:
    a, b = Wire(), Wire()
    network, _ = joined(LinkModel(delay_s=0.125), a, b)
    send_at(network, a, 1.0, b"x")
    assert network.run_until_true(lambda: b.inbox, within_s=5.0) == 1.125
    assert network.run_until_true(lambda: b.inbox, within_s=5.0) == 0.0
    with pytest.raises(SimulationTimeoutError, match=r"a second one: not within 2\.0 s, by 3\.125 s of the run"):
        network.run_until_true(lambda: len(b.inbox) > 1, within_s=2.0, what="a second one")


def test_a_condition_is_checked_after_events_of_every_kind_and_at_the_end() -> None:
    a, b = Wire(), Wire()
    network, hop = joined(LinkModel(delay_s=0.125).as_stream(), a, b)
    send_at(network, a, 1.0, b"x")
    network.at(1.1, lambda now: hop.break_connection(reconnect_s=100.0))
    assert network.run_until_true(lambda: hop.forward.stats.broken_packets, within_s=50.0) == 1.125
    assert network.run_until_true(lambda: network.elapsed_s > 20.0, within_s=30.0) == 30.0


def test_misuse_is_named() -> None:
    network = Network(1)
    a, b = Wire(), Wire()
    network.join(a, None, b, None, PERFECT, PERFECT)
    with pytest.raises(UsageError, match="joined already"):
        network.join(a, None, Wire(), None, PERFECT, PERFECT)
    with pytest.raises(UsageError, match="does not list this port"):
        network.join(Wire(), SoloNode(b), Wire(), None, PERFECT, PERFECT)
    with pytest.raises(UsageError, match="different modes"):
        network.join(Wire(), None, Wire(), None, PERFECT, PERFECT.as_stream())
    with pytest.raises(UsageError, match="clock reading"):
        network.run_until(network.now + 1.0)
    with pytest.raises(UsageError, match="period_s is 0"):
        network.every(0.0, print)
    with pytest.raises(UsageError, match="no port in the network"):
        network.at(1.0, print, node=Wire())
    network.run_until(5.0)
    with pytest.raises(UsageError, match=r"is over: the run is at 5\.0 s"):
        network.at(4.0, print)
    network.after(0.0, lambda now: network.run_for(1.0))
    with pytest.raises(UsageError, match="cannot run the network"):
        network.run_for(1.0)


# ---------------------------------------------------------------------- time that stands still


def test_a_deadline_that_stays_in_the_past_is_reported() -> None:
    class Stubborn(Wire):
        def next_deadline(self) -> float:
            return 3.0

        def handle_timeout(self, *, now: float) -> None:
            pass

    network = Network(1, max_events_per_instant=200)
    network.join(Stubborn(), None, Wire(), None, PERFECT, PERFECT, name="uplink")
    with pytest.raises(SimulationStuck, match=r"stuck at 0\.0{9} s after 200 events .*deadline uplink\.a") as caught:
        network.run_until(1.0)
    assert len(caught.value.events) == 12


def test_an_endless_exchange_without_delay_is_reported() -> None:
    class Echo(Wire):
        def receive(self, data: bytes, *, now: float) -> None:
            self.outbox.append(data)

    a = Echo()
    network = Network(1, max_events_per_instant=500)
    network.join(a, None, Echo(), None, PERFECT, PERFECT)
    send_at(network, a, 0.25, b"ping")
    with pytest.raises(SimulationStuck, match=r"stuck at 0\.250000000 s .*arrival hop0<"):
        network.run_until(1.0)


def test_a_port_that_never_stops_sending_is_reported() -> None:
    class Fountain(Wire):
        def next_datagram(self, *, now: float) -> bytes | None:
            return b"drop"

    network = Network(1, max_events_per_instant=500)
    network.join(Fountain(), None, Wire(), None, PERFECT, PERFECT)
    with pytest.raises(SimulationStuck, match=r"datagram of 4 bytes from hop0\.a"):
        network.run_until(1.0)


def test_a_hook_that_always_has_more_to_do_is_reported() -> None:
    wire = Wire()
    network = Network(1, max_events_per_instant=500)
    network.join(wire, SoloNode(wire, lambda now: True), Wire(), None, PERFECT, PERFECT)
    with pytest.raises(SimulationStuck, match="more to send after sending"):
        network.run_until(1.0)


def test_a_burst_at_one_instant_is_not_stuck() -> None:
    a, b = Wire(), Wire()
    network, _ = joined(LinkModel(rate_bps=None, delay_s=0.1), a, b)
    send_at(network, a, 0.5, *([b"x"] * 20_000))
    network.run_until(1.0)
    assert len(b.inbox) == 20_000


# ---------------------------------------------------------------------- nodes


def test_the_hook_runs_before_sending_and_again_until_it_has_nothing_to_do() -> None:
    """A codec needs this: the port asks for something, the application answers, the port sends in the same event."""
    wire, far = Wire(), Wire()
    requests = 3

    def answer(now: float) -> bool:
        nonlocal requests
        if not far.inbox and not wire.outbox and requests:
            requests -= 1
            wire.outbox.append(b"answer")
            return True
        return False

    network = Network(1)
    network.join(wire, SoloNode(wire, answer), far, None, LinkModel(delay_s=0.1), PERFECT)
    network.run_until(0.05)
    assert requests == 0
    network.run_until(1.0)
    assert elapsed(network, far) == [0.1] * 3


@pytest.mark.parametrize("kind", [Hub, DirtyHub])
def test_receiving_on_one_port_sends_on_the_others(kind: type[Hub]) -> None:
    hub = kind(20)
    clients = [Wire() for _ in hub.wires]
    network = Network(1)
    for port, client in zip(hub.wires, clients, strict=True):
        network.join(client, None, port, hub, LinkModel(delay_s=0.01), LinkModel(delay_s=0.02))
    network.run_until(1.0)
    hub.asked = 0
    send_at(network, clients[3], 1.0, b"hello")
    network.run_until(2.0)
    for index, client in enumerate(clients):
        assert elapsed(network, client) == ([] if index == 3 else [1.03])


def test_a_node_that_knows_its_dirty_ports_has_only_those_asked() -> None:
    hub = DirtyHub(200)
    network = Network(1)
    clients = [Wire() for _ in hub.wires]
    for port, client in zip(hub.wires, clients, strict=True):
        network.join(client, None, port, hub, PERFECT, PERFECT)
    network.run_until(1.0)

    def to_two(now: float) -> None:
        for port in hub.wires[:2]:
            port.outbox.append(b"x")
            hub.dirty.add(port)

    hub.asked = 0
    network.at(1.0, to_two)
    network.run_until(2.0)
    assert [len(client.inbox) for client in clients[:3]] == [1, 1, 0]
    assert hub.asked == 4  # each of two ports: one datagram, one None


def test_ports_may_join_while_the_network_runs() -> None:
    network = Network(1)
    hub = Hub(3)
    early, late = Wire(), Wire()
    network.join(early, None, hub.wires[0], hub, PERFECT, PERFECT)
    network.at(5.0, lambda now: network.join(late, None, hub.wires[1], hub, PERFECT, PERFECT))
    send_at(network, early, 4.0, b"before")
    send_at(network, early, 6.0, b"after")
    network.run_until(10.0)
    assert hub.wires[1].history == ["connected"]
    # The hub queued the first for its port before anyone was there.
    assert late.inbox == [b"before", b"after"]
    assert elapsed(network, late) == [5.0, 6.0]


# ---------------------------------------------------------------------- determinism


def _run(seed: int, *, start_s: float | None = None) -> tuple[str, int, Sequence[object]]:
    log = EventLog()
    network = Network(seed, start_s=start_s, log=log)
    sender, receiver = ArqSender(400), ArqReceiver()
    hop = network.join(sender, None, receiver, None, ROUGH, ROUGH)
    stream = network.join(Ticker(0.05), None, Wire(), None, ROUGH.as_stream(), ROUGH.as_stream())
    network.at(5.0, lambda now: stream.break_connection())
    network.run_until(60.0)
    return log.digest(), log.count, (hop.forward.stats, hop.backward.stats, stream.forward.stats)


def test_the_same_seed_is_the_same_run() -> None:
    first = _run(7)
    assert first[1] > 2000
    assert _run(7) == first
    assert _run(8)[0] != first[0]


@pytest.mark.parametrize("start_s", [0.0, 1.0, 86_400.000_000_001, 123_456.789, 131_071.999_999_999])
def test_a_run_does_not_depend_on_the_offset_of_the_clock(start_s: float) -> None:
    assert _run(7, start_s=start_s) == _run(7)


def test_the_log_tells_what_happened() -> None:
    log = EventLog(recent=3)
    network = Network(1, log=log)
    a, b = Wire(), Wire()
    network.join(a, None, b, None, LinkModel(delay_s=0.5), PERFECT, name="up")
    send_at(network, a, 1.0, b"four")
    network.run_until(2.0)
    assert [(event.elapsed_ns, *event[1:]) for event in log.recent] == [
        (1_000_000_000, "call", "", 0),
        (1_000_000_000, "send", "up.a", 4),
        (1_500_000_000, "receive", "up.b", 4),
    ]
    assert log.count == 5  # two ports were connected before


def test_toys_are_ports() -> None:
    ports: list[Port] = [Wire(), Ticker(1.0), ArqSender(1), ArqReceiver()]
    assert ports
