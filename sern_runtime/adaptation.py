"""Runs the adaptation of one or many links on the event loop, and tells what it does: /api/mmcf and metrics."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from sern_core.adaptation.adapter import SAMPLES, HopAdapter
from sern_core.adaptation.levels import Summarised
from sern_core.adaptation.report import adapter_json, step_json
from sern_core.bodies.codecs import Coder
from sern_core.link.link import Link
from sern_core.topics.rules import TopicRule
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import Message, TopicSpec
from sern_core.vocabulary.types import CLASS_LABELS, CLASSES
from sern_runtime import clock
from sern_runtime.config.adaptation import AdaptationSection
from sern_runtime.http_routes import JsonParts, JsonQuery, closing_array
from sern_runtime.metrics import Labels, Metrics
from sern_runtime.optional import BACKOFF_S, OptionalParts

HISTORY: Final = 60
"""Intervals that /api/mmcf tells of."""
PART: Final = "adaptation"
TOO_LARGE: Final = "the answer is too large; ask for fewer intervals: ?last=1"
TERMS: Final = ("latency", "unreliability", "compute", "bandwidth")

_log = logging.getLogger(__name__)


class Adaptation:
    """One `HopAdapter` a link that is there. `links` names them; `kick` is called after each decision."""

    def __init__(
        self,
        section: AdaptationSection,
        links: Callable[[], Collection[Link]],
        *,
        coder: Coder | None,
        kick: Callable[[], None],
        rules: Iterable[TopicRule] = (),
        summaries: Callable[[], Sequence[Summarised]] = list,
        parts: OptionalParts | None = None,
    ) -> None:
        """`rules` say of which classes summaries may be chosen, `summaries` are those there are now. What fails is
        counted in `parts`, under PART."""
        self._encodes = coder is not None
        self._parts = parts or OptionalParts(PART)
        self._resting: dict[Link, tuple[float, float]] = {}  # links whose adapter failed: until when, and the pause
        self._links = links
        self._coder = coder
        self._kick = kick
        self._summaries = summaries
        self._set(section, rules)
        self._adapters: dict[Link, HopAdapter] = {}
        self._history: dict[Link, deque[dict[str, Any]]] = {}

    def _set(self, section: AdaptationSection, rules: Iterable[TopicRule]) -> None:
        classes = {rule.priority for rule in rules if any(spec.adapt for spec in rule.summaries)}
        summarised = tuple(priority for priority in CLASSES if priority in classes)
        make_policy = section.make_policy(encodes=self._encodes, summarised=summarised)
        self._section, self._params = section, section.params(encodes=self._encodes)
        self._summarised, self._make_policy = summarised, make_policy

    def use(self, section: AdaptationSection, rules: Iterable[TopicRule]) -> None:
        """Choose by another section, or for other rules, from now on: every link is begun with anew where that changes
        anything. Raises ConfigError where the section cannot be used here; then all stays as it was."""
        before = (self._section, self._summarised)
        self._set(section, rules)
        if (self._section, self._summarised) != before:
            self.reset()

    async def run(self) -> None:
        """Adapt until cancelled. An interval that comes late is a longer one; none is made up for."""
        count = 0
        while True:
            await asyncio.sleep(self._params.interval_s / SAMPLES)
            count += 1
            self.tick(step=count % SAMPLES == 0)

    def tick(self, *, step: bool) -> None:
        now = clock.now()
        links = self._links()
        for gone in (self._adapters.keys() | self._resting.keys()) - set(links):
            self._adapters.pop(gone, None)
            self._history.pop(gone, None)
            self._resting.pop(gone, None)
        for link in links:
            until_s, pause_s = self._resting.get(link, (now, BACKOFF_S[0]))
            if now < until_s:
                continue
            try:
                self._tick(link, now, step=step)
            except Exception as error:  # noqa: BLE001  (of one link; it goes without adaptation for a while)
                self._parts.failed(PART, error)
                self._resting[link] = (now + pause_s, min(2.0 * pause_s, BACKOFF_S[1]))
                with self._parts.survive(PART):
                    self._leave(link, now)
        if step and links:
            self._kick()

    def _tick(self, link: Link, now: float, *, step: bool) -> None:
        adapter = self._adapters.get(link)
        if adapter is None:
            adapter = HopAdapter(
                link, self._make_policy(), self._params, coder=self._coder, now=now, summaries=self._summaries
            )
            self._adapters[link] = adapter
            link.watch_arrivals(self._guarded(adapter))
        adapter.sample(now=now)
        if step:
            self._step(adapter, now)

    def _guarded(self, adapter: HopAdapter) -> Callable[[TopicSpec, Message, float], None]:
        """What an adapter is told while a datagram is read: no fault of it may keep the rest from being read."""

        def arrived(spec: TopicSpec, message: Message, now: float) -> None:
            try:
                adapter.note_arrival(spec, message, now)
            except Exception as error:  # noqa: BLE001  (as above)
                self._parts.failed(PART, error)

        return arrived

    def _leave(self, link: Link, now: float) -> None:
        """Give a link's topics back what their rules say."""
        self._history.pop(link, None)
        adapter = self._adapters.pop(link, None)
        link.watch_arrivals(None)
        if adapter is not None:
            adapter.close(now=now)

    def reset(self) -> None:
        """Give back everything; the next tick begins anew."""
        for link in list(self._adapters):
            with self._parts.survive(PART):
                self._leave(link, clock.now())

    def _step(self, adapter: HopAdapter, now: float) -> None:
        done = adapter.step(now=now)
        self._history.setdefault(adapter.link, deque(maxlen=HISTORY)).append(step_json(done))
        if done.decision.switched:
            _log.info("%s: %s (%s)", adapter.link.peer, done.decision.chosen, done.decision.reason)

    def view(self) -> JsonQuery:
        """The route of /api/mmcf; `?last=N`: of each link the last N intervals alone."""

        def read(query: Mapping[str, str]) -> JsonParts:
            text = query.get("last", str(HISTORY))
            if not (text.isascii() and text.isdecimal() and int(text[:9]) <= HISTORY):
                raise UsageError(f"last is {text[:80]!r}; accepted: 0 to {HISTORY}")
            last = int(text)
            return JsonParts(closing_array(self.about(), "links", self.rows(last)), TOO_LARGE)

        return JsonQuery(("last",), read)

    def rows(self, last: int) -> Iterator[dict[str, Any]]:
        """A row for each link, with its last intervals, the oldest first; each made when it is asked for."""
        return (self._link_json(link, last) for link in tuple(self._adapters) if link in self._adapters)

    def to_json(self) -> dict[str, Any]:
        """What is in force, and the last intervals of each link, the oldest first, as /api/mmcf tells them."""
        return self.about() | {"links": [self._link_json(link, HISTORY) for link in self._adapters]}

    def _link_json(self, link: Link, last: int) -> dict[str, Any]:
        history = list(self._history.get(link, ()))
        return {**adapter_json(self._adapters[link]), "history": history[max(0, len(history) - last) :]}

    def about(self) -> dict[str, Any]:
        """What holds for all links."""
        weights, ranges = self._params.weights, self._params.ranges
        return {
            "policy": self._section.policy,
            "profile": self._section.profile if self._section.weights is None else "weights",
            "weights": dict(zip(TERMS, weights, strict=True)),
            "ranges": {
                "latency_max_s": ranges.latency_max_s,
                "compute_max": ranges.compute_max,
                "bandwidth": "capacity" if ranges.share_of_capacity else "fixed",
                "bandwidth_max_bps": ranges.bandwidth_max_bps,
            },
            "floors": dict(zip(CLASS_LABELS, self._section.floor_shares(), strict=True)),
            "interval_s": self._params.interval_s,
            "now_s": clock.now(),
        }

    def _by_peer(self) -> list[tuple[str, HopAdapter]]:
        return [(link.peer, adapter) for link, adapter in self._adapters.items()]

    # --- metrics ----------------------------------------------------------------------------------------------------

    def register(self, metrics: Metrics) -> None:
        """Every term of the cost, measured and predicted, and what is in force."""

        def measured() -> list[tuple[Labels, float]]:
            return [
                ((peer, name), value)
                for peer, adapter in self._by_peer()
                if adapter.last is not None and adapter.last.terms is not None
                for name, value in zip(TERMS, adapter.last.terms, strict=True)
            ]

        def predicted() -> list[tuple[Labels, float]]:
            return [
                ((peer, name), value)
                for peer, adapter in self._by_peer()
                if adapter.last is not None and (found := adapter.last.decision.prediction) is not None
                for name, value in zip(TERMS, found.terms, strict=True)
            ]

        def costs() -> list[tuple[Labels, float]]:
            return [
                ((peer,), adapter.last.cost)
                for peer, adapter in self._by_peer()
                if adapter.last is not None and adapter.last.cost is not None
            ]

        def predicted_costs() -> list[tuple[Labels, float]]:
            return [
                ((peer,), found.cost)
                for peer, adapter in self._by_peer()
                if adapter.last is not None and (found := adapter.last.decision.prediction) is not None
            ]

        def errors() -> list[tuple[Labels, float]]:
            return [
                ((peer,), adapter.prediction_error)
                for peer, adapter in self._by_peer()
                if adapter.prediction_error is not None
            ]

        def shares() -> list[tuple[Labels, float]]:
            return [
                ((peer, label), share)
                for peer, adapter in self._by_peer()
                for label, share in zip(CLASS_LABELS, adapter.policy.active.rates, strict=True)
            ]

        def limits() -> list[tuple[Labels, float]]:
            return [
                ((peer, label), float(limit))
                for peer, adapter in self._by_peer()
                for label, limit in zip(CLASS_LABELS, adapter.policy.active.queues, strict=True)
            ]

        def modes() -> list[tuple[Labels, float]]:
            return [
                ((peer, mode), float(adapter.policy.active.codec == mode))
                for peer, adapter in self._by_peer()
                for mode in self._params.modes
            ]

        def copies() -> list[tuple[Labels, float]]:
            return [((peer,), float(a.policy.active.redundancy)) for peer, a in self._by_peer()]

        def levels() -> list[tuple[Labels, float]]:
            return [
                ((peer, CLASS_LABELS[priority]), float(chosen[priority]))
                for peer, adapter in self._by_peer()
                if (chosen := adapter.policy.active.summaries) is not None
                for priority in self._summarised
            ]

        def switches() -> list[tuple[Labels, float]]:
            return [((peer,), float(a.switches)) for peer, a in self._by_peer()]

        gauge = metrics.gauge
        gauge("sern_mmcf_cost", "Cost of the last interval, 0 to 1.", ("peer",), costs)
        gauge(
            "sern_mmcf_term", "A term of the cost as measured, 0 to 1, before its weight.", ("peer", "term"), measured
        )
        gauge("sern_mmcf_predicted_cost", "Cost predicted for the interval that runs.", ("peer",), predicted_costs)
        gauge("sern_mmcf_predicted_term", "A term predicted for the interval that runs.", ("peer", "term"), predicted)
        gauge("sern_mmcf_prediction_error", "Measured less predicted cost of the last interval.", ("peer",), errors)
        gauge(
            "sern_mmcf_rate_share", "Share of a class's best-effort messages that is let in.", ("peer", "class"), shares
        )
        gauge("sern_mmcf_queue_limit_messages", "Queue limit of a class, a topic.", ("peer", "class"), limits)
        gauge("sern_mmcf_codec", "1 for the compression mode in force.", ("peer", "mode"), modes)
        gauge("sern_mmcf_redundancy", "1 while class control may be sent twice.", ("peer",), copies)
        gauge(
            "sern_mmcf_summarised",
            "1 while topics of a class that may be are sent as summaries.",
            ("peer", "class"),
            levels,
        )
        metrics.counter("sern_mmcf_switches_total", "Times another configuration was chosen.", ("peer",), switches)
