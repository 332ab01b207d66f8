"""What Prometheus is told of other relays, beside the links to them and the port."""

from collections.abc import Callable, Mapping
from typing import Protocol

from sern_core.vocabulary.types import ClientName
from sern_runtime.metrics import Metrics

Numbers = list[tuple[tuple[str, ...], float]]


class Relays(Protocol):
    """A relay's place among others (`sern_relay.fabric.RelayFabric`)."""

    unknown: int

    def reached(self) -> Mapping[ClientName, bool]:
        """Whether there is a session with each."""

    def clients(self) -> Mapping[ClientName, int]:
        """How many clients are at each."""

    def rules_differ(self) -> Mapping[ClientName, bool]:
        """Whether each has other access rules, of those that have said."""


class KeyRevocations(Protocol):
    """Keys that were revoked at other relays (`sern_relay.revocations.FabricRevocations`)."""

    taken: int

    @property
    def unkept(self) -> int:
        """Those that are not written down."""


def register_relays(
    metrics: Metrics, fabric: Callable[[], Relays | None], revocations: KeyRevocations, left_out: Callable[[], int]
) -> None:
    """Have `metrics` read them; None: the fabric is not there yet. `left_out`: revocations that were too many."""

    def by_relay(read: Callable[[Relays], Mapping[ClientName, int]]) -> Callable[[], Numbers]:
        def collect() -> Numbers:
            found = fabric()
            return [] if found is None else [((name,), float(value)) for name, value in read(found).items()]

        return collect

    metrics.gauge("sern_fabric_relay_up", "1 while there is a session with another relay.", ("relay",),
                  by_relay(lambda each: each.reached()))  # fmt: skip
    metrics.gauge("sern_fabric_relay_clients", "Clients at each other relay.", ("relay",),
                  by_relay(lambda each: each.clients()))  # fmt: skip
    metrics.gauge("sern_fabric_rules_differ", "1 while another relay has other access rules than this one.",
                  ("relay",), by_relay(lambda each: each.rules_differ()))  # fmt: skip
    metrics.counter("sern_fabric_unknown_total", "Datagrams of relays that are not there.",
                    read=lambda: [((), 0.0 if (found := fabric()) is None else float(found.unknown))])  # fmt: skip
    metrics.counter("sern_fabric_revocations_total", "Revocations of keys that other relays told, by outcome.",
                    ("outcome",), lambda: [
                        (("taken",), float(revocations.taken)), (("left_out",), float(left_out())),
                    ])  # fmt: skip
    metrics.gauge("sern_fabric_revocations_unkept", "Keys revoked at other relays that are not written down here.",
                  read=lambda: [((), float(revocations.unkept))])  # fmt: skip
