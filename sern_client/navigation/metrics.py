"""What Prometheus is told of a node that navigates."""

from typing import TYPE_CHECKING

from sern_client.navigation.node import NavigationNode
from sern_navigation.navigator import State
from sern_runtime.metrics import Metrics

if TYPE_CHECKING:
    from sern_client.navigation.perceiving import Perception


def register_navigation(metrics: Metrics, node: NavigationNode, perception: "Perception | None" = None) -> None:
    metrics.counter(
        "sern_perception_clouds_total",
        "Clouds whose points were to get classes, by what became of them.",
        ("outcome",),
        lambda: [] if perception is None else [((key,), float(count)) for key, count in perception.outcomes.items()],
    )
    metrics.gauge(
        "sern_navigation_state",
        "1 for what is done with the goal that is pursued, or was with the last one.",
        ("state",),
        lambda: [((state.value,), float(node.status.state is state)) for state in State],
    )
    metrics.counter(
        "sern_navigation_goals_total",
        "Goals that have ended, by how.",
        ("state",),
        lambda: [((state.value,), float(count)) for state, count in node.ended.items()],
    )
    metrics.counter(
        "sern_navigation_unused_total",
        "Messages and readings that counted nothing, by reason.",
        ("reason",),
        lambda: [((reason,), float(count)) for reason, count in node.counts().items()],
    )
    metrics.counter(
        "sern_navigation_twin_total",
        "Maps and updates of the twin that came, by what became of them.",
        ("outcome",),
        lambda: [((outcome,), float(count)) for outcome, count in node.twin.outcomes.items()],
    )
    metrics.counter(
        "sern_navigation_monitor_total",
        "Commands, by what the collision monitor did with them.",
        ("action",),
        lambda: [((action.value,), float(count)) for action, count in node.navigator.monitor.counts.items()],
    )
    metrics.gauge(
        "sern_navigation_cycle_seconds",
        "The slowest in a hundred of the last 1,000 control cycles.",
        read=lambda: [((), node.cycle_p99_s)],
    )
    metrics.counter(
        "sern_navigation_planner_restarts_total",
        "Times the process that plans ended, and was started again.",
        read=lambda: [((), float(node.planner.failures))],
    )
