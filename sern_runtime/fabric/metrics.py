"""What Prometheus is told of a fabric port."""

from collections.abc import Callable

from sern_runtime.fabric.port import FabricCounters, FabricDrop
from sern_runtime.metrics import Metrics


def register_fabric(metrics: Metrics, counters: Callable[[], FabricCounters | None]) -> None:
    """Have `metrics` read them; None: the port is not there yet."""

    def read(of: Callable[[FabricCounters], float]) -> float:
        found = counters()
        return 0.0 if found is None else float(of(found))

    def dropped() -> list[tuple[tuple[str, ...], float]]:
        found = counters()
        return [((reason.value,), float(0 if found is None else found.dropped[reason])) for reason in FabricDrop]

    metrics.gauge("sern_fabric_relays", "Other relays that are there.",
                  read=lambda: [((), read(lambda each: each.peers_up))])  # fmt: skip
    metrics.counter("sern_fabric_datagrams_total", "Datagrams to and from other relays.", ("direction",), lambda: [
        (("sent",), read(lambda each: each.sent)), (("received",), read(lambda each: each.received)),
    ])  # fmt: skip
    metrics.counter("sern_fabric_bytes_total", "Their bytes.", ("direction",), lambda: [
        (("sent",), read(lambda each: each.sent_bytes)), (("received",), read(lambda each: each.received_bytes)),
    ])  # fmt: skip
    metrics.counter("sern_fabric_dropped_total", "Datagrams that the fabric dropped, by reason.", ("reason",), dropped)
    metrics.counter("sern_fabric_send_seconds_total", "The time that all sends have held the event loop.",
                    read=lambda: [((), read(lambda each: each.send_block_s))])  # fmt: skip
    metrics.gauge("sern_fabric_send_block_max_seconds", "The longest that one send has held the event loop.",
                  read=lambda: [((), read(lambda each: each.send_block_max_s))])  # fmt: skip
