"""What holds on any link, whatever its model."""

from dataclasses import replace
from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st

from sern_sim.links import LOST, NS, Link
from sern_sim.models import LinkMode, LinkModel, RateStep, Window
from sern_sim.network import Network
from sern_sim.ports import Direction
from tests.exploring import cases
from tests.sern_sim.strategies import link_models, rate_steps, windows
from tests.sern_sim.toys import ArqReceiver, ArqSender

RUN_S = 10.0
PURE = settings(max_examples=cases(80))

sendings = st.lists(
    st.tuples(st.integers(0, 300), st.integers(0, 3000)),  # milliseconds since the last packet, bytes
    min_size=1,
    max_size=120,
)


def _sent(model: LinkModel, packets: list[tuple[int, int]], seed: int) -> tuple[Link, list[tuple[int, int, int]]]:
    """(sent, arrives, bytes) of each packet on a link alone."""
    link = Link(model, Random(seed))
    t_ns = 0
    fates = []
    for gap_ms, size_bytes in packets:
        t_ns += gap_ms * 1_000_000
        fates.append((t_ns, link.send(size_bytes, t_ns), size_bytes))
    return link, fates


@PURE
@given(link_models(run_s=RUN_S), sendings, st.integers(0, 2**32))
def test_a_datagram_arrives_late_enough_and_never_in_a_blackout(
    model: LinkModel, packets: list[tuple[int, int]], seed: int
) -> None:
    link, fates = _sent(model, packets, seed)
    least_ns = max(0, round((model.delay_s - (3 if model.jitter == "normal" else 1) * model.jitter_s) * NS))
    for sent_ns, arrival_ns, _ in fates:
        if arrival_ns != LOST:
            assert arrival_ns >= sent_ns + least_ns
            assert link.blackout_after(sent_ns)[0] > arrival_ns
    stats = link.stats(max(fates[-1][0], *(arrival for _, arrival, _ in fates)))
    lost = stats.lost_packets + stats.blackout_packets + stats.queue_drops
    assert lost == sum(arrival == LOST for _, arrival, _ in fates)
    assert stats.utilisation <= 1.0 + 1e-9
    if not model.reorder:
        arrivals = [arrival for _, arrival, _ in fates if arrival != LOST]
        assert arrivals == sorted(arrivals)


@PURE
@given(link_models(mode=LinkMode.STREAM, run_s=RUN_S), sendings, st.integers(0, 2**32))
def test_a_stream_delivers_everything_in_order_while_it_lasts(
    model: LinkModel, packets: list[tuple[int, int]], seed: int
) -> None:
    link, fates = _sent(model, packets, seed)
    arrivals = [arrival for _, arrival, _ in fates]
    assert LOST not in arrivals
    assert arrivals == sorted(arrivals)
    for sent_ns, arrival_ns, _ in fates:
        # Every blackout in between adds its whole length.
        frozen_ns, t_ns = 0, sent_ns
        while (window := link.blackout_after(t_ns))[0] < arrival_ns:
            frozen_ns += window[1] - max(sent_ns, window[0])
            t_ns = window[1]
        least_ns = round((model.delay_s - 3 * model.jitter_s) * NS)
        assert arrival_ns - sent_ns >= frozen_ns + max(0, least_ns)
        start_ns, end_ns = link.blackout_after(arrival_ns - 1)
        assert not start_ns < arrival_ns < end_ns
    assert link.stats(arrivals[-1]).utilisation <= 1.0 + 1e-9


@PURE
@given(rate_steps(RUN_S), windows(RUN_S), sendings, st.sampled_from([50_000, 1_000_000]), st.sampled_from(LinkMode))
def test_serialisation_is_the_integral_of_the_rate(
    steps: tuple[RateStep, ...], gone: tuple[Window, ...], packets: list[tuple[int, int]], rate_bps: int, mode: LinkMode
) -> None:
    """Against the plain definition: a packet leaves when the capacity since it could start is its size."""
    model = LinkModel(
        rate_bps=rate_bps, rate_steps=steps, blackouts=gone if mode is LinkMode.STREAM else (), queue_packets=1000,
        mode=mode,
    )  # fmt: skip
    _, fates = _sent(model, packets, 0)
    busy_ns = 0
    for sent_ns, arrival_ns, size_bytes in fates:
        start_ns = max(sent_ns, busy_ns)
        enough_bits = model.capacity_bits(start_ns / NS, (arrival_ns + 10) / NS)
        too_few_bits = model.capacity_bits(start_ns / NS, (arrival_ns - 10) / NS)
        assert enough_bits >= 8 * size_bytes or model.blackout_at(arrival_ns / NS)
        assert too_few_bits <= 8 * size_bytes
        busy_ns = arrival_ns


@settings(PURE, max_examples=cases(40))
@given(st.sampled_from(LinkMode).flatmap(lambda mode: st.tuples(*[link_models(mode=mode, run_s=3.0)] * 2)), st.data())
def test_an_arq_gets_through_any_link_and_every_packet_is_accounted_for(
    links: tuple[LinkModel, LinkModel], data: st.DataObject
) -> None:
    up, down = (replace(model, flap=None, loss=min(model.loss, 0.2)) for model in links)
    sender, receiver = ArqSender(30, size_bytes=60, timeout_s=0.7), ArqReceiver()
    network = Network(data.draw(st.integers(0, 1000)))
    hop = network.join(sender, None, receiver, None, up, down)
    for at_s in data.draw(st.lists(st.integers(0, 30), max_size=3)):
        network.at(at_s / 10, lambda now: hop.break_connection())
    network.run_until_true(lambda: sender.done, within_s=3600.0)
    assert receiver.numbers == set(range(30))
    for direction in (hop.forward, hop.backward):
        network.run_until_true(lambda direction=direction: under_way(direction) == 0, within_s=36_000.0)  # type: ignore[misc]
        network.run_for(1.0)
        assert under_way(direction) == 0
        assert direction.stats.utilisation <= 1.0 + 1e-9


def under_way(direction: Direction) -> int:
    """Packets sent and not accounted for."""
    stats = direction.stats
    gone = stats.lost_packets + stats.blackout_packets + stats.broken_packets + stats.queue_drops
    return stats.sent_packets + stats.duplicate_packets - stats.delivered_packets - gone
