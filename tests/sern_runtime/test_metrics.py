"""Metrics read from state at scrape."""

import pytest
from prometheus_client import CollectorRegistry, Gauge, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from sern_core.vocabulary.errors import UsageError
from sern_runtime.metrics import (
    LATENCY_EDGES_S,
    MAX_LABEL_SETS,
    Histogram,
    HistogramCounts,
    Metrics,
    check_names,
)


def scrape(registry: CollectorRegistry) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    text = generate_latest(registry).decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.fixture
def registry() -> CollectorRegistry:
    return CollectorRegistry()


@pytest.fixture
def metrics(registry: CollectorRegistry) -> Metrics:
    return Metrics(registry, process=False)


def test_counters_exist_at_zero_and_follow_the_state(registry: CollectorRegistry, metrics: Metrics) -> None:
    drops: dict[tuple[str, ...], float] = {}
    metrics.counter(
        "sern_drops_total",
        "Messages dropped.",
        ("client", "reason"),
        drops.items,
        known=lambda: [("a", "lifespan"), ("a", "lost")],
    )
    lifespan = ("sern_drops_total", (("client", "a"), ("reason", "lifespan")))
    lost = ("sern_drops_total", (("client", "a"), ("reason", "lost")))
    values = scrape(registry)
    assert (values[lifespan], values[lost]) == (0, 0)
    drops["a", "lost"] = 4
    values = scrape(registry)
    assert (values[lifespan], values[lost]) == (0, 4)


def test_values_that_are_not_configured_are_added_up_under_other(registry: CollectorRegistry, metrics: Metrics) -> None:
    configured = {"/odom"}
    allowed = {"topic": lambda: configured}
    numbers = [(("/odom",), 1.0), (("/evil1",), 2.0), (("/evil2",), 5.0)]
    metrics.counter("sern_a_total", "A.", ("topic",), lambda: numbers, allowed=allowed)
    metrics.gauge("sern_b_seconds", "B.", ("topic",), lambda: numbers, allowed=allowed)
    values = scrape(registry)
    assert values["sern_a_total", (("topic", "/odom"),)] == 1
    assert values["sern_a_total", (("topic", "other"),)] == 7
    assert values["sern_b_seconds", (("topic", "other"),)] == 5
    configured.add("/evil1")
    assert scrape(registry)["sern_a_total", (("topic", "/evil1"),)] == 2


def test_label_sets_are_bounded(registry: CollectorRegistry, metrics: Metrics) -> None:
    count = MAX_LABEL_SETS + 500
    metrics.counter("sern_a_total", "A.", ("topic",), lambda: [((f"/t{n}",), 1.0) for n in range(count)])
    values = {labels: value for (name, labels), value in scrape(registry).items() if name == "sern_a_total"}
    assert len(values) == MAX_LABEL_SETS + 1
    assert values[("topic", "other"),] == 500
    assert sum(values.values()) == count


def test_histograms_are_cumulative(registry: CollectorRegistry, metrics: Metrics) -> None:
    ages = Histogram((0.01, 0.1, 1.0))
    for age_s in (0.001, 0.01, 0.05, 2.0, 3.0):
        ages.observe(age_s)
    metrics.histogram(
        "sern_age_seconds", "Age.", ages.edges, ("client",), lambda: [(("a",), ages.snapshot())], known=lambda: [("b",)]
    )
    values = scrape(registry)

    def bucket(client: str, edge: str) -> float:
        return values["sern_age_seconds_bucket", (("client", client), ("le", edge))]

    assert [bucket("a", edge) for edge in ("0.01", "0.1", "1.0", "+Inf")] == [2, 3, 3, 5]
    assert values["sern_age_seconds_count", (("client", "a"),)] == 5
    assert values["sern_age_seconds_sum", (("client", "a"),)] == pytest.approx(5.061)
    assert bucket("b", "+Inf") == 0


def test_edges_cover_what_the_service_levels_name() -> None:
    assert LATENCY_EDGES_S[0] == 0.001
    assert LATENCY_EDGES_S[-1] == 30.0
    assert list(LATENCY_EDGES_S) == sorted(LATENCY_EDGES_S)


def test_a_reader_that_fails_costs_only_its_metric(
    registry: CollectorRegistry, metrics: Metrics, caplog: pytest.LogCaptureFixture
) -> None:
    def broken() -> list[tuple[tuple[str, ...], float]]:
        raise RuntimeError("state is gone")

    metrics.gauge("sern_broken_seconds", "Broken.", (), broken)
    metrics.gauge("sern_fine_seconds", "Fine.", (), lambda: [((), 1.0)])
    metrics.histogram("sern_h_seconds", "H.", (1.0,), (), lambda: [((), HistogramCounts((1, 2, 3), 0.0))])
    values = scrape(registry)
    assert values["sern_fine_seconds", ()] == 1
    assert ("sern_broken_seconds", ()) not in values
    assert values["sern_metrics_failures_total", (("metric", "sern_broken_seconds"),)] == 1
    assert values["sern_metrics_failures_total", (("metric", "sern_h_seconds"),)] == 1
    assert values["sern_metrics_failures_total", (("metric", "sern_fine_seconds"),)] == 0
    assert "state is gone" in caplog.text


def test_misuse_is_refused(metrics: Metrics) -> None:
    with pytest.raises(UsageError, match="must end in _total"):
        metrics.counter("sern_drops", "Drops.")
    metrics.gauge("sern_a_seconds", "A.")
    with pytest.raises(UsageError, match="exists already"):
        metrics.gauge("sern_a_seconds", "A.")


def test_process_metrics_are_there_and_well_named() -> None:
    registry = CollectorRegistry()
    Metrics(registry)
    assert ("process_resident_memory_bytes", ()) in scrape(registry)
    assert check_names(registry) == []


@pytest.mark.parametrize(
    ("name", "text", "labels", "problem"),
    [
        ("sern_age_ms", "Age.", (), "ms is not a base unit"),
        ("sern_rate_bps", "Rate.", (), "bps is not a base unit"),
        ("sern_loss_percent", "Loss.", (), "percent is not a base unit"),
        ("sern_things_total", "Things.", (), "only a counter ends in _total"),
        ("age_seconds", "Age.", (), "must begin with sern_"),
        ("sern_Age_seconds", "Age.", (), "must begin with sern_ and be lower case"),
        ("sern_age_seconds", "Age", (), "must be a sentence"),
        ("sern_age_seconds", "Age.", ("Client",), "must be lower case"),
    ],
)
def test_bad_names_are_found(name: str, text: str, labels: tuple[str, ...], problem: str) -> None:
    registry = CollectorRegistry()
    gauge = Gauge(name, text, labels, registry=registry)
    if labels:
        gauge.labels("a").set(1)
    problems = check_names(registry)
    assert len(problems) == 1
    assert problem in problems[0]
