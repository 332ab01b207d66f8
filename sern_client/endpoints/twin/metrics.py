"""The metrics of twins, read at scrape."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial

from sern_client.endpoints.twin.robot import RobotTwin
from sern_runtime.metrics import Metrics
from sern_twin.synchroniser import Twin


def register_twins(metrics: Metrics, robots: Mapping[str, RobotTwin], now: Callable[[], float]) -> None:
    def each(value: Callable[[Twin], float]) -> Iterator[tuple[tuple[str], float]]:
        for name, robot in robots.items():
            twin = robot.twin(now=now())
            if twin is not None:
                yield (name,), value(twin)

    def counted(count: Callable[[RobotTwin], int]) -> Iterator[tuple[tuple[str], float]]:
        for name, robot in robots.items():
            yield (name,), float(count(robot))

    gauges: tuple[tuple[str, str, Callable[[Twin], float]], ...] = (
        ("sern_twin_age_seconds", "Time since the last pose that was taken.", lambda twin: twin.age_s),
        ("sern_twin_error_meters", "How far the shown twin may be from its robot.", lambda twin: twin.error_m),
        (
            "sern_twin_outside_bound",
            "1 while a gap ended further off than was bounded, and what is shown is not back yet.",
            lambda twin: float(twin.outside),
        ),
    )
    for metric, text, value in gauges:
        metrics.gauge(metric, text, ("robot",), partial(each, value))
    metrics.counter(
        "sern_twin_poses_total",
        "Poses that came, by what became of them.",
        ("robot", "outcome"),
        lambda: [
            ((name, outcome), float(count)) for name, robot in robots.items() for outcome, count in robot.counts.items()
        ],
    )
    metrics.counter(
        "sern_twin_plans_refused_total",
        "Plans that could not be used, by why.",
        ("robot", "reason"),
        lambda: [((name, why), float(count)) for name, robot in robots.items() for why, count in robot.refused.items()],
    )
    counters: tuple[tuple[str, str, Callable[[RobotTwin], int]], ...] = (
        ("sern_twin_gaps_total", "Gaps in what was heard of the robot that have ended.", lambda robot: robot.gaps),
        (
            "sern_twin_gaps_violated_total",
            "Gaps that ended further off than was bounded: the robot did something else than was assumed.",
            lambda robot: robot.violated,
        ),
        (
            "sern_twin_stops_total",
            "Gaps after which the robot stood, and was to move.",
            lambda robot: robot.stops,
        ),
        (
            "sern_twin_snaps_total",
            "Times the shown twin was set to what is known, because it was too far off to be led there.",
            lambda robot: robot.snaps,
        ),
    )
    for metric, text, count in counters:
        metrics.counter(metric, text, ("robot",), partial(counted, count))
