"""Prometheus metrics collected from state when they are scraped.

The parts of SERN count in plain attributes and know nothing of Prometheus; at each scrape a callable reads them:

    metrics = Metrics(registry)
    metrics.counter("sern_link_drops_total", "Messages dropped, by reason.", ("client", "reason"),
                    lambda: [((client, reason), n) ...], known=lambda: [(client, reason) ...])

Rules kept here: every known label set exists at 0 from the first scrape (a counter that first appears at 1 never
fires an alert on `increase()`); label values come from configuration, anything else is added up under `other`; one
callable that raises costs its own metric only, and `sern_metrics_failures_total` says which.
"""

import logging
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from sern_core.errors import UsageError

Labels = tuple[str, ...]
Numbers = Iterable[tuple[Labels, float]]
KnownLabels = Callable[[], Iterable[Labels]]

OTHER: Final = "other"
MAX_LABEL_SETS: Final = 2000
"""Label sets of one metric, at most; what comes after that is added up under `other` in every label."""

LATENCY_EDGES_S: Final = (0.001, 0.0025, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
"""Histogram edges for ages and delays, 1 ms to 30 s, with one on each service level."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class HistogramCounts:
    """`counts[i]` observations at or below edge i and above the edge before; one more than edges (above the last)."""

    counts: Sequence[float]
    total: float  # sum of the observed values

    def __add__(self, other: "HistogramCounts") -> "HistogramCounts":
        pairs = zip(self.counts, other.counts, strict=True)
        return HistogramCounts([a + b for a, b in pairs], self.total + other.total)


class Histogram:
    """Counts observations between fixed edges, in plain Python; read by `Metrics.histogram` at scrape."""

    __slots__ = ("counts", "edges", "total")

    def __init__(self, edges: Sequence[float] = LATENCY_EDGES_S) -> None:
        self.edges = tuple(edges)
        self.counts = [0] * (len(self.edges) + 1)
        self.total = 0.0

    def observe(self, value: float) -> None:
        index = 0
        for edge in self.edges:  # few edges, and most values are small: faster than bisect's call
            if value <= edge:
                break
            index += 1
        self.counts[index] += 1
        self.total += value

    def snapshot(self) -> HistogramCounts:
        return HistogramCounts(tuple(self.counts), self.total)


@dataclass(slots=True)
class _Definition:
    name: str
    help: str
    labels: Labels
    known: KnownLabels | None
    allowed: Mapping[str, Callable[[], Collection[str]]] = field(default_factory=dict)

    def guarded(self, labels: Labels, seen: Collection[Labels]) -> Labels:
        """These labels with every value that is not allowed, or too many, replaced by `other`."""
        if len(labels) != len(self.labels):
            raise UsageError(f"{self.name} has the labels {self.labels}, got {labels}")
        if self.allowed:
            labels = tuple(
                value if name not in self.allowed or value in self.allowed[name]() else OTHER
                for name, value in zip(self.labels, labels, strict=True)
            )
        if labels not in seen and len(seen) >= MAX_LABEL_SETS:
            return (OTHER,) * len(self.labels)
        return labels


class Metrics(Collector):
    """The metrics of one process, collected from callables. Registers itself and the process metrics.

    `allowed` restricts the values of a label: name -> callable that gives those configured now.
    """

    def __init__(self, registry: CollectorRegistry, *, process: bool = True) -> None:
        self.registry = registry
        self._sources: list[tuple[_Definition, Callable[[_Definition], Metric]]] = []
        self._failures: dict[str, int] = {}
        registry.register(self)
        if process:
            ProcessCollector(registry=registry)

    def counter(
        self,
        name: str,
        text: str,
        labels: Labels = (),
        read: Callable[[], Numbers] = tuple,
        *,
        known: KnownLabels | None = None,
        allowed: Mapping[str, Callable[[], Collection[str]]] | None = None,
    ) -> None:
        """A value that only grows. `name` ends in `_total`. `known` label sets exist at 0 until `read` names them."""
        if not name.endswith("_total"):
            raise UsageError(f"the counter {name} must end in _total")

        def collect(definition: _Definition) -> Metric:
            return _family(CounterMetricFamily, definition, _sums(definition, read()))

        self._add(_Definition(name, text, labels, known, allowed or {}), collect)

    def gauge(
        self,
        name: str,
        text: str,
        labels: Labels = (),
        read: Callable[[], Numbers] = tuple,
        *,
        known: KnownLabels | None = None,
        allowed: Mapping[str, Callable[[], Collection[str]]] | None = None,
    ) -> None:
        """A value that goes up and down. Those that share `other` show their maximum: usually the worst of them."""

        def collect(definition: _Definition) -> Metric:
            return _family(GaugeMetricFamily, definition, _maxima(definition, read()))

        self._add(_Definition(name, text, labels, known, allowed or {}), collect)

    def histogram(
        self,
        name: str,
        text: str,
        edges: Sequence[float],
        labels: Labels = (),
        read: Callable[[], Iterable[tuple[Labels, HistogramCounts]]] = tuple,
        *,
        known: KnownLabels | None = None,
        allowed: Mapping[str, Callable[[], Collection[str]]] | None = None,
    ) -> None:
        """A distribution between fixed `edges` (ascending). See `Histogram` for something to read from."""
        empty = HistogramCounts((0,) * (len(edges) + 1), 0.0)

        def collect(definition: _Definition) -> Metric:
            family = HistogramMetricFamily(definition.name, definition.help, labels=definition.labels)
            sets = dict.fromkeys(_known(definition), empty)
            for label_values, counts in read():
                key = definition.guarded(label_values, sets)
                sets[key] = sets.get(key, empty) + counts
            for key, counts in sets.items():
                family.add_metric(key, _cumulative(edges, counts.counts), counts.total)
            return family

        self._add(_Definition(name, text, labels, known, allowed or {}), collect)

    def collect(self) -> Iterator[Metric]:
        for definition, collect in self._sources:
            try:
                yield collect(definition)
            except Exception:  # noqa: BLE001  (one broken reader must not take the other metrics away)
                self._failures[definition.name] += 1
                _log.warning("the metric %s could not be read", definition.name, exc_info=True)
        family = CounterMetricFamily(
            "sern_metrics_failures_total", "Readings of a metric that failed; it is missing then.", labels=("metric",)
        )
        for name, failures in self._failures.items():
            family.add_metric((name,), failures)
        yield family

    def describe(self) -> Iterator[Metric]:
        """Nothing: registering must not read state that is not there yet."""
        return iter(())

    def _add(self, definition: _Definition, collect: Callable[[_Definition], Metric]) -> None:
        if definition.name in self._failures:
            raise UsageError(f"the metric {definition.name} exists already")
        self._failures[definition.name] = 0
        self._sources.append((definition, collect))


def _family(
    kind: type[CounterMetricFamily] | type[GaugeMetricFamily], definition: _Definition, values: dict[Labels, float]
) -> Metric:
    family = kind(definition.name, definition.help, labels=definition.labels)
    for label_values, value in values.items():
        family.add_metric(label_values, value)
    return family


def _known(definition: _Definition) -> Iterable[Labels]:
    return () if definition.known is None else definition.known()


def _sums(definition: _Definition, numbers: Numbers) -> dict[Labels, float]:
    sums = dict.fromkeys(_known(definition), 0.0)
    for labels, value in numbers:
        key = definition.guarded(labels, sums)
        sums[key] = sums.get(key, 0.0) + value
    return sums


def _maxima(definition: _Definition, numbers: Numbers) -> dict[Labels, float]:
    known = dict.fromkeys(_known(definition), 0.0)
    maxima: dict[Labels, float] = {}
    for labels, value in numbers:
        key = definition.guarded(labels, maxima)
        maxima[key] = max(maxima.get(key, value), value)
    return known | maxima


def _cumulative(edges: Sequence[float], counts: Sequence[float]) -> list[tuple[str, float]]:
    if len(counts) != len(edges) + 1:
        raise UsageError(f"{len(edges)} edges make {len(edges) + 1} counts, got {len(counts)}")
    running = 0.0
    buckets = []
    for edge, observed in zip((*(str(float(edge)) for edge in edges), "+Inf"), counts, strict=True):
        running += observed
        buckets.append((edge, running))
    return buckets


_NAME: Final = re.compile(r"(sern|process)_[a-z0-9]+(_[a-z0-9]+)*")
_LABEL: Final = re.compile(r"[a-z][a-z0-9_]*")
_NOT_BASE: Final = re.compile(
    r"_(ns|us|ms|nanoseconds|microseconds|milliseconds|minutes|hours|days|kb|mb|gb|kib|mib|kilobytes|megabytes"
    r"|bits|bps|kbps|mbps|percent|khz|mhz|hz|mm|cm|km|celsius_degrees|s|m)(_|$)"
)


def check_names(registry: CollectorRegistry) -> list[str]:
    """What is wrong with the metrics of a registry, one line each; empty when all is well.

    Prefix, `_total` on counters and on nothing else, base units (seconds, bytes, ratio), a help text that ends in a
    full stop, lower-case labels.
    """
    problems = []
    for family in registry.collect():
        name = family.name
        if not _NAME.fullmatch(name):
            problems.append(f"{name}: must begin with sern_ and be lower case with single underscores")
        if unit := _NOT_BASE.search(name):
            problems.append(f"{name}: {unit[1]} is not a base unit; use seconds, bytes, meters or ratio")
        if family.type != "counter" and name.endswith("_total"):
            problems.append(f"{name}: only a counter ends in _total")
        if not family.documentation.strip().endswith("."):
            problems.append(f"{name}: the help text must be a sentence ending in a full stop")
        problems += [
            f"{name}: the label {label} must be lower case"
            for label in sorted({label for sample in family.samples for label in sample.labels})
            if not _LABEL.fullmatch(label)
        ]
    return problems
