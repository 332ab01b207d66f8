"""The metrics of what keeps durable topics, of client and relay alike."""

from sern_runtime.durable.disk import Disk
from sern_runtime.metrics import Metrics


def register_durable(metrics: Metrics, disk: Disk | None) -> None:
    """Have `metrics` read it; None: there is nothing, and all of them are 0."""

    def read(name: str) -> float:
        keeper = None if disk is None else disk.keeper
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
        read=lambda: [((), float(disk is not None and disk.problem is not None))],
    )
    metrics.counter(
        "sern_durable_damaged_total",
        "Damaged messages, pages and files that were found when the store was opened.",
        read=lambda: [((), float(0 if disk is None else disk.damaged))],
    )
