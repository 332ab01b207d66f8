"""Metrics that both daemons have: their links, what goes out over them, what arrives, and how old it is."""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Final

from sern_core.bodies.codecs import Coder
from sern_core.link.link import Link
from sern_core.link.view import LinkView
from sern_core.vocabulary.ledger import LOSSES, NO_DROPS, ReceiveLedger, SendCounters
from sern_core.vocabulary.types import CLASS_LABELS, DropReason
from sern_runtime import clock
from sern_runtime.metrics import LATENCY_EDGES_S, Histogram, HistogramCounts, Labels, Metrics

# An alert looks for the LOSSES: they have rows at 0 from the start on, so that `increase()` sees the first message. The
# others have a row from their first message on: twenty rows for each topic of each link are too many to write.
RECEIVED_LOSSES: Final = (DropReason.LOST, DropReason.UNDECODABLE, DropReason.FAULT)
"""The same for what arrives."""


def _by_reason(drops: Mapping[DropReason, int], always: Sequence[DropReason]) -> Iterator[tuple[str, float]]:
    for reason in always:
        yield reason.value, float(drops[reason])
    if drops is not NO_DROPS:
        for reason, count in drops.items():
            if count and reason not in always:
                yield reason.value, float(count)


class AgeHistograms:
    """Age of delivered messages at delivery, by class."""

    def __init__(self) -> None:
        self.by_class = tuple(Histogram(LATENCY_EDGES_S) for _ in CLASS_LABELS)

    def observe(self, priority: int, age_s: float) -> None:
        self.by_class[priority].observe(age_s)

    def read(self) -> Iterable[tuple[Labels, HistogramCounts]]:
        for label, histogram in zip(CLASS_LABELS, self.by_class, strict=True):
            yield (label,), histogram.snapshot()


def _capacity(link: LinkView) -> float | None:
    return None if link.rate_bps is None else link.rate_bps / 8


def register_links(
    metrics: Metrics,
    links: Callable[[], Collection[Link]],
    given_up: Callable[[], Iterable[tuple[str, SendCounters]]] = tuple,
) -> None:
    """State of every link and the fate of every message offered to it.

    `given_up`: peers whose links are gone, and counters of what they lost by that; their series go on with it.
    """

    def per_link(read: Callable[[LinkView], float | None]) -> Callable[[], list[tuple[Labels, float]]]:
        def collect() -> list[tuple[Labels, float]]:
            now = clock.now()
            values = [((link.peer,), read(link.observe(now=now))) for link in links()]
            return [(labels, value) for labels, value in values if value is not None and math.isfinite(value)]

        return collect

    def per_class(index: int) -> Callable[[], list[tuple[Labels, float]]]:
        def collect() -> list[tuple[Labels, float]]:
            rows: list[tuple[Labels, float]] = []
            for link in links():
                for label, cell in link.queued().items():
                    rows.append(((link.peer, label), float(cell[index])))
            return rows

        return collect

    # A list for each link: links and topics come and go while the next is waited for.
    def per_topic(read: str) -> Callable[[], Iterator[tuple[Labels, float]]]:
        def collect() -> Iterator[tuple[Labels, float]]:
            for link in tuple(links()):
                yield from [
                    ((link.peer, counters.topic, CLASS_LABELS[counters.priority]), float(getattr(counters, read)))
                    for counters in link.counters.values()
                ]

        return collect

    def drops() -> Iterator[tuple[Labels, float]]:
        for link in tuple(links()):
            yield from [
                ((link.peer, counters.topic, CLASS_LABELS[counters.priority], reason), count)
                for counters in link.counters.values()
                for reason, count in _by_reason(counters.by_reason, LOSSES)
            ]
        yield from [
            ((peer, counters.topic, CLASS_LABELS[counters.priority], reason.value), float(counters.by_reason[reason]))
            for peer, counters in given_up()
            for reason in LOSSES
        ]

    def unconfirmed() -> Iterator[tuple[Labels, float]]:
        yield from per_topic("reliable_unconfirmed")()
        yield from [
            ((peer, counters.topic, CLASS_LABELS[counters.priority]), float(counters.reliable_unconfirmed))
            for peer, counters in given_up()
        ]

    gauge, counter = metrics.gauge, metrics.counter
    peer = ("peer",)
    gauge("sern_link_up", "1 while a session exists and the path answers.", peer,
          per_link(lambda link: float(link.up)))  # fmt: skip
    gauge("sern_link_capacity_bytes_per_second", "Estimated capacity of the link.", peer,
          per_link(_capacity))  # fmt: skip
    gauge("sern_link_window_bytes", "Bytes that may be in flight.", peer,
          per_link(lambda link: link.window_bytes))  # fmt: skip
    gauge("sern_link_inflight_bytes", "Bytes sent and not yet acknowledged.", peer,
          per_link(lambda link: float(link.inflight_bytes)))  # fmt: skip
    gauge("sern_link_rtt_seconds", "Smoothed round-trip time.", peer,
          per_link(lambda link: link.srtt_s))  # fmt: skip
    gauge("sern_link_rtprop_seconds", "Round-trip time of the empty path.", peer,
          per_link(lambda link: link.rtprop_s))  # fmt: skip
    gauge("sern_link_clock_offset_seconds", "Peer's monotonic clock minus ours.", peer,
          per_link(lambda link: link.clock_offset_s))  # fmt: skip
    gauge("sern_link_clock_error_seconds", "Bound of the error of the clock offset.", peer,
          per_link(lambda link: link.clock_error_s))  # fmt: skip
    gauge("sern_link_queue_messages", "Messages waiting for the link, by class.", ("peer", "class"), per_class(0))
    gauge("sern_link_queue_bytes", "Bytes waiting for the link, by class.", ("peer", "class"), per_class(1))
    topic = ("peer", "topic", "class")
    counter("sern_messages_offered_total", "Messages offered to a link.", topic, per_topic("offered"))
    counter("sern_messages_delivered_total", "Messages that the peer has (reliable: delivered to the far end).",
            topic, per_topic("delivered"))  # fmt: skip
    counter("sern_reliable_unconfirmed_total", "Reliable messages sent whole and given up unconfirmed; perhaps lost.",
            topic, unconfirmed)  # fmt: skip
    counter("sern_messages_refused_total", "Messages refused to their source: a reliable queue was full.",
            topic, per_topic("refused"))  # fmt: skip
    counter("sern_bytes_offered_total", "Bytes offered to a link.", topic, per_topic("offered_bytes"))
    counter("sern_bytes_delivered_total", "Bytes that the peer has.", topic, per_topic("delivered_bytes"))
    counter("sern_messages_dropped_total", "Messages dropped, by reason.", (*topic, "reason"), drops)
    counter("sern_stray_fragments_total", "Fragments of streams that were not announced.", peer,
            per_link(lambda link: float(link.strays)))  # fmt: skip


def register_codecs(metrics: Metrics, coder: Coder) -> None:
    """What was compressed and decompressed here, and what it took."""

    def encoded(read: str) -> Callable[[], list[tuple[Labels, float]]]:
        return lambda: [((str(mode),), float(getattr(counters, read))) for mode, counters in coder.encoded.items()]

    def decoded(read: str) -> Callable[[], list[tuple[Labels, float]]]:
        return lambda: [((c.name.lower(),), float(getattr(counters, read))) for c, counters in coder.decoded.items()]

    counter = metrics.counter
    mode, codec = ("mode",), ("codec",)
    counter("sern_encoded_messages_total", "Message bodies encoded, those that gained nothing included.", mode,
            encoded("messages"))  # fmt: skip
    counter("sern_encoded_raw_bytes_total", "Bytes of bodies before encoding.", mode, encoded("raw_bytes"))
    counter("sern_encoded_bytes_total", "Bytes of the same bodies after it.", mode, encoded("encoded_bytes"))
    counter("sern_encode_seconds_total", "Time spent encoding.", mode, encoded("elapsed_s"))
    counter("sern_decoded_messages_total", "Message bodies decoded.", codec, decoded("messages"))
    counter("sern_decoded_raw_bytes_total", "Bytes of bodies after decoding.", codec, decoded("raw_bytes"))
    counter("sern_decoded_bytes_total", "Bytes of the same bodies before it.", codec, decoded("encoded_bytes"))
    counter("sern_decode_seconds_total", "Time spent decoding.", codec, decoded("elapsed_s"))
    counter("sern_undecodable_total", "Message bodies that could not be decoded.",
            read=lambda: [((), float(coder.undecodable))])  # fmt: skip


def register_received(metrics: Metrics, received: ReceiveLedger, ages: AgeHistograms) -> None:
    """What arrives, how old it is, and what was dropped on arrival."""

    def delivered(read: str) -> Callable[[], list[tuple[Labels, float]]]:
        def collect() -> list[tuple[Labels, float]]:
            return [((c.topic, CLASS_LABELS[c.priority]), float(getattr(c, read))) for c in received.topics.values()]

        return collect

    def information_age() -> list[tuple[Labels, float]]:
        now = clock.now()
        rows: list[tuple[Labels, float]] = []
        for counters in received.topics.values():
            age_s = counters.age_of_information_s(now)
            if age_s is not None:
                rows.append(((counters.topic, CLASS_LABELS[counters.priority]), age_s))
        return rows

    def drops() -> list[tuple[Labels, float]]:
        return [
            ((c.topic, CLASS_LABELS[c.priority], reason), count)
            for c in received.topics.values()
            for reason, count in _by_reason(c.by_reason, RECEIVED_LOSSES)
        ]

    topic = ("topic", "class")
    counter = metrics.counter
    counter("sern_received_messages_total", "Messages that arrived and had their turn.", topic, delivered("delivered"))
    counter("sern_received_bytes_total", "Bytes that arrived.", topic, delivered("delivered_bytes"))
    counter("sern_received_dropped_total", "Messages dropped on arrival, by reason.", (*topic, "reason"), drops)
    metrics.gauge("sern_topic_age_seconds", "Age of information: how old the freshest sample is now.", topic,
                  information_age)  # fmt: skip
    metrics.histogram("sern_message_age_seconds", "Age of messages when delivered, by class.", LATENCY_EDGES_S,
                      ("class",), ages.read, known=lambda: [(label,) for label in CLASS_LABELS])  # fmt: skip
