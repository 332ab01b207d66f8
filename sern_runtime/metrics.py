"""Prometheus metrics collected from state when they are scraped.

The parts of SERN count in plain attributes and know nothing of Prometheus; at each scrape a callable reads them:

    metrics = Metrics(registry)
    metrics.counter("sern_link_drops_total", "Messages dropped, by reason.", ("client", "reason"),
                    lambda: [((client, reason), n) ...], known=lambda: [(client, reason) ...])

Rules kept here: every known label set exists at 0 from the first scrape (a counter that first appears at 1 never
fires an alert on `increase()`); label values come from configuration, anything else is added up under `other`; labels
whose values are few and ours (class, reason) always keep their values, so that an alert which looks for a reason finds
it however many topics there are; one callable that raises costs its own metric only, and `sern_metrics_failures_total`
says which. A callable that gives many numbers gives them from lists of its own, one after another (`yield from [...]`):
other work is done in between.
"""

import logging
import re
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Final, cast, overload

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample

from sern_core.vocabulary.errors import UsageError

Labels = tuple[str, ...]
Numbers = Iterable[tuple[Labels, float]]
Adding = Generator[None, None, dict[Labels, float]]
KnownLabels = Callable[[], Iterable[Labels]]

OTHER: Final = "other"
OPEN_LABELS: Final = frozenset({"client", "peer", "service", "topic"})
"""Labels whose values others choose. A metric that has none of them counts as one with open labels only."""
MAX_LABEL_SETS: Final = 6000
"""Sets of values of the open labels, such as pairs of peer and topic, that have rows of their own. What comes after is
added up under `other` in these labels; the closed ones keep their values."""
SLICE_ROWS: Final = 500
STEP_ROWS: Final = 2000
"""Rows that `exposition` writes, and that it reads and adds up, at a time: about 5 ms each."""

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


class _Names:
    """Which sets of open label values have rows of their own, for all metrics with the same open labels.

    A set stays what it was at its first scrape as long as it exists: a counter that came out of `other` above 0 would
    hide what happened since the scrape before.
    """

    def __init__(self) -> None:
        self._named: dict[object, bool] = {}
        self._before: dict[object, bool] = {}
        self._taken = 0

    def begin(self) -> None:
        """A scrape begins: what the one before did not meet is forgotten."""
        self._before, self._named = self._named, {}
        self._taken = sum(self._before.values())

    def own(self, values: object) -> bool:
        named = self._named.get(values)
        if named is None:
            named = self._before.get(values)
            if named is None:
                named = self._taken < MAX_LABEL_SETS
                self._taken += named
            self._named[values] = named
        return named


@dataclass(slots=True)
class _Definition:
    name: str
    help: str
    labels: Labels
    known: KnownLabels | None
    names: _Names
    allowed: Mapping[str, Callable[[], Collection[str]]] = field(default_factory=dict)
    open: tuple[int, ...] = ()  # positions
    values: Callable[[Labels], object] = tuple
    others: dict[Labels, tuple[float, float]] = field(default_factory=dict)
    """For counters, by the row under `other`: the sum at the last scrape, and what has left that sum before."""

    def __post_init__(self) -> None:
        self.open = tuple(n for n, label in enumerate(self.labels) if label in _open(self.labels))
        if self.open:
            self.values = itemgetter(*self.open)

    def guarded(self, labels: Labels, seen: Collection[Labels]) -> Labels:
        """These labels with every value that is not allowed, or open and one too many, replaced by `other`."""
        if len(labels) != len(self.labels):
            raise UsageError(f"{self.name} has the labels {self.labels}, got {labels}")
        kept = labels
        if self.allowed:
            kept = tuple(
                value if name not in self.allowed or value in self.allowed[name]() else OTHER
                for name, value in zip(self.labels, labels, strict=True)
            )
        if kept not in seen and self.open and not self.names.own(self.values(kept)):
            kept = tuple(OTHER if n in self.open else value for n, value in enumerate(kept))
        if kept is not labels and kept != labels:
            self.others.setdefault(kept, (0.0, 0.0))
        return kept

    def growing(self, sums: dict[Labels, float]) -> dict[Labels, float]:
        """The sums with those under `other` kept from falling when one of their parts is forgotten, which would look
        like a restart and count everything again. What is added in the same interval is hidden up to what left."""
        for labels, (last, gone) in self.others.items():
            now = sums.get(labels, 0.0)
            gone += max(0.0, last - now)
            self.others[labels] = now, gone
            sums[labels] = now + gone
        return sums


def _open(labels: Labels) -> Labels:
    return tuple(label for label in labels if label in OPEN_LABELS) or labels


class Metrics(Collector):
    """The metrics of one process, collected from callables. Registers itself and the process metrics.

    `allowed` restricts the values of a label: name -> callable that gives those configured now.
    """

    def __init__(self, registry: CollectorRegistry, *, process: bool = True) -> None:
        self.registry = registry
        self._sources: list[tuple[_Definition, Callable[[_Definition], Metric]]] = []
        self._failures: dict[str, int] = {}
        self._names: dict[Labels, _Names] = {}
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
            return self._family(CounterMetricFamily, definition, lambda: _sums(definition, read))

        self._add(_Definition(name, text, labels, known, self._named(labels), allowed or {}), collect)

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
            return self._family(GaugeMetricFamily, definition, lambda: _maxima(definition, read))

        self._add(_Definition(name, text, labels, known, self._named(labels), allowed or {}), collect)

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

        self._add(_Definition(name, text, labels, known, self._named(labels), allowed or {}), collect)

    def collect(self) -> Iterator[Metric]:
        """The families one after another, each to be read before the next. One scrape at a time."""
        for names in self._names.values():
            names.begin()
        for definition, collect in self._sources:
            try:
                yield collect(definition)
            except Exception:  # noqa: BLE001  (one broken reader must not take the other metrics away)
                self._failed(definition)
        family = CounterMetricFamily(
            "sern_metrics_failures_total", "Readings of a metric that failed; it is missing then.", labels=("metric",)
        )
        for name, failures in self._failures.items():
            family.add_metric((name,), failures)
        yield family

    def describe(self) -> Iterator[Metric]:
        """Nothing: registering must not read state that is not there yet."""
        return iter(())

    def _failed(self, definition: _Definition) -> None:
        self._failures[definition.name] += 1
        _log.warning("the metric %s could not be read", definition.name, exc_info=True)

    def _family(
        self,
        kind: type[CounterMetricFamily] | type[GaugeMetricFamily],
        definition: _Definition,
        add_up: Callable[[], Adding],
    ) -> Metric:
        family = kind(definition.name, definition.help, labels=definition.labels)
        rows = _Rows(definition.name, definition.labels, add_up, lambda: self._failed(definition))
        family.samples = cast("list[Sample]", rows)
        return family

    def _named(self, labels: Labels) -> _Names:
        return self._names.setdefault(_open(labels), _Names())

    def _add(self, definition: _Definition, collect: Callable[[_Definition], Metric]) -> None:
        if definition.name in self._failures:
            raise UsageError(f"the metric {definition.name} exists already")
        self._failures[definition.name] = 0
        self._sources.append((definition, collect))


class _Slice(Collector):
    """A family to be written, in whole or in part."""

    def __init__(self, family: Metric) -> None:
        self._family = family

    def collect(self) -> Iterator[Metric]:
        yield self._family


def exposition(registry: CollectorRegistry, encode: Callable[[Collector], bytes]) -> Iterator[bytes]:
    """What `encode` makes of the whole registry, in parts of SLICE_ROWS rows, so that its caller can do something else
    in between. One scrape at a time."""
    end = b""
    for family in registry.collect():
        rows = family.samples
        if isinstance(rows, _Rows):
            for _ in rows.steps():
                yield b""
        for first in range(0, max(1, len(rows)), SLICE_ROWS):
            family.samples = rows[first : first + SLICE_ROWS]
            text = encode(_Slice(family))
            if text.endswith(_END):  # OpenMetrics has it once
                text, end = text.removesuffix(_END), _END
            if first:  # the head of the family is written
                text = b"".join(line for line in text.splitlines(keepends=True) if not line.startswith(b"#"))
            yield text
    yield end


_END: Final = b"# EOF\n"


class _Rows(Sequence[Sample]):
    """The rows of a family: read and added up in steps, at the latest when they are looked at, and each made when it is
    written. Thousands of them take tens of milliseconds."""

    def __init__(self, name: str, names: Labels, add_up: Callable[[], Adding], failed: Callable[[], None]) -> None:
        self._name = name
        self._names = names
        self._add_up = add_up
        self._failed = failed
        self._values: list[tuple[Labels, float]] | None = None

    def steps(self) -> Iterator[None]:
        """Read what there is, a part in each step."""
        if self._values is None:
            try:
                values = yield from self._add_up()
            except Exception:  # noqa: BLE001  (counted and said)
                self._failed()
                values = {}
            self._values = list(values.items())

    def _all(self) -> list[tuple[Labels, float]]:
        for _ in self.steps():
            continue
        return self._values or []

    def __len__(self) -> int:
        return len(self._all())

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return [self._sample(*row) for row in self._all()[index]]
        return self._sample(*self._all()[index])

    def _sample(self, labels: Labels, value: float) -> Sample:
        return Sample(self._name, dict(zip(self._names, labels, strict=True)), value)


def _known(definition: _Definition) -> Iterable[Labels]:
    return () if definition.known is None else definition.known()


def _sums(definition: _Definition, read: Callable[[], Numbers]) -> Adding:
    sums = dict.fromkeys(_known(definition), 0.0)
    for count, (labels, value) in enumerate(read(), 1):
        key = definition.guarded(labels, sums)
        sums[key] = sums.get(key, 0.0) + value
        if not count % STEP_ROWS:
            yield
    return definition.growing(sums)


def _maxima(definition: _Definition, read: Callable[[], Numbers]) -> Adding:
    known = dict.fromkeys(_known(definition), 0.0)
    maxima: dict[Labels, float] = {}
    for count, (labels, value) in enumerate(read(), 1):
        key = definition.guarded(labels, maxima)
        maxima[key] = max(maxima.get(key, value), value)
        if not count % STEP_ROWS:
            yield
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
