"""The metrics of what keeps durable topics, of client and relay alike."""

from typing import Protocol

from sern_runtime.durable.keeper import Keeps
from sern_runtime.metrics import Metrics


class Durable(Protocol):
    """Who has a keeper, once it has started."""

    damaged: int

    @property
    def keeper(self) -> Keeps | None: ...

    @property
    def problem(self) -> str | None: ...


def register_durable(metrics: Metrics, durable: Durable | None) -> None:
    """Have `metrics` read it; None: there is nothing, and all of them are 0."""

    def read(name: str) -> float:
        keeper = None if durable is None else durable.keeper
        return 0.0 if keeper is None else float(getattr(keeper, name))

    metrics.counter(
        "sern_durable_stored_total",
        "Messages of durable topics that were put on disk.",
        read=lambda: [((), read("messages"))],
    )
    metrics.counter(
        "sern_durable_commits_total",
        "Times that messages, one or many, were put on disk together.",
        read=lambda: [((), read("commits"))],
    )
    metrics.counter(
        "sern_durable_failures_total",
        "Times that the disk did not take them; it is tried again.",
        read=lambda: [((), read("failures"))],
    )
    metrics.gauge(
        "sern_durable_kept_bytes", "What is kept on disk of durable topics.", read=lambda: [((), read("kept_bytes"))]
    )
    metrics.gauge(
        "sern_durable_problem",
        "1 while nothing is put on disk, for the reason that is in the log.",
        read=lambda: [((), float(durable is not None and durable.problem is not None))],
    )
    metrics.counter(
        "sern_durable_damaged_total",
        "Damaged messages, pages and files that were found when the store was opened.",
        read=lambda: [((), float(0 if durable is None else durable.damaged))],
    )
