"""The metrics of viewers, read at scrape."""

from collections.abc import Callable

from sern_client.endpoints.foxglove.door import Shared
from sern_client.endpoints.foxglove.frames import Fault
from sern_client.endpoints.foxglove.handshake import Turned
from sern_runtime.metrics import Metrics


def register_viewers(metrics: Metrics, shared: Shared, topics: Callable[[], int]) -> None:
    metrics.gauge("sern_foxglove_viewers", "Viewers that are connected.", (), lambda: [((), len(shared.viewers))])
    metrics.gauge("sern_foxglove_topics", "Topics that viewers can look at.", (), lambda: [((), topics())])
    metrics.counter(
        "sern_foxglove_refused_total",
        "Connections that were not let in, by why.",
        ("reason",),
        lambda: [((str(why),), shared.turned[why]) for why in Turned],
    )
    metrics.counter(
        "sern_foxglove_faults_total",
        "What viewers sent and should not have, by what was wrong with it.",
        ("fault",),
        lambda: [((str(fault),), shared.faults[fault]) for fault in Fault],
    )
    metrics.counter(
        "sern_foxglove_behind_total",
        "Times a viewer took less than what came.",
        (),
        lambda: [((), shared.falls_behind)],
    )
