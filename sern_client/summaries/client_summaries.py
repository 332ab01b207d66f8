"""The summaries of one client.

A summary is a stream of its own, announced with the attributes `summary` (its kind) and `summary_of` (the topic). Two
kinds take the topic itself: a voxel-thinned cloud `in_place`, and patches, whose whole grids go out under the topic's
name. Every one has a level, `raw` or `summary`, that may be switched at any time: each message is sent once, as the
level was when it came, and the messages of a stream keep their order. With `level: auto` what the link carries
switches it (`Fit`).
"""

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from sern_client.summaries.makers import attributes_of, fits, patch_specs, summary_spec, work_of
from sern_client.summaries.source import Source, SummarisedTopic
from sern_client.summaries.topic_summary import PART, Send, TopicSummary
from sern_core.site.client import ClientCore
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.rate_cap import RateCap
from sern_core.summaries.grids import UPDATE_TYPE
from sern_core.summaries.patches import PatchMaker, PatchParams
from sern_core.summaries.spec import (
    STAND_IN,
    SummaryKind,
    SummaryLevel,
    SummarySpec,
)
from sern_core.topics.rules import ResolvedTopic, TopicRule
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.types import TopicName
from sern_runtime import clock, ros_types
from sern_runtime.metrics import Labels, Metrics
from sern_runtime.optional import OptionalParts

_log = logging.getLogger(__name__)


class Summaries:
    """The summaries of one client, and the thread they are made in. `close` once."""

    def __init__(self, sender: Callable[[OutChannel, TopicInfo], Send], parts: OptionalParts | None = None) -> None:
        """`sender(channel, info)` makes what puts messages of the type `info` into a channel. What fails is counted in
        `parts`, under PART."""
        self._sender = sender
        self._parts = parts or OptionalParts(PART)
        self._topics: list[SummarisedTopic] = []
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="summary")

    @property
    def topics(self) -> list[TopicSummary]:
        """Every summary there is now, for whoever adapts to the link."""
        return [output for topic in self._topics for output in topic.outputs]

    def open(
        self, core: ClientCore, info: TopicInfo, resolved: ResolvedTopic, rule: TopicRule | None, name: TopicName
    ) -> tuple[OutChannel, SummarisedTopic] | None:
        """Offer a topic under its global `name`, and the summaries that its rule asks for. None: it has none.

        UsageError when the topic cannot be offered; a summary that cannot is logged and left out.
        """
        specs = fits(info, resolved)
        if not specs:
            return None
        now = clock.now()
        spec = replace(resolved.spec, max_rate_hz=None)
        updates = spec
        patches = next((item.params for item in specs if isinstance(item.params, PatchParams)), None)
        attributes = None
        if patches is not None and rule is not None:
            spec, updates, patches = patch_specs(resolved.spec, patches, rule)
            attributes = attributes_of(SummaryKind.PATCHES, name)
        elif specs[0].shares_topic and specs[0] is not STAND_IN:  # which the topic seldom is
            attributes = attributes_of(specs[0].kind, name)
        info = replace(info, latched=spec.latched)
        channel = core.publish(replace(info, name=name), spec, attributes=attributes, now=now)
        raw = self._sender(channel, info)
        outputs: list[TopicSummary] = []
        for item in specs:
            own_spec = summary_spec(spec, item) if patches is None else updates
            own_info = self._info(info, item, TopicName(item.topic(name)), own_spec)
            own, send = channel, raw
            if own_info.name != name:
                try:
                    own = core.publish(own_info, own_spec, attributes=attributes_of(item.kind, name), now=now)
                except UsageError as error:
                    _log.error("%s: its %s cannot be offered as %s: %s", info.name, item.kind, own_info.name, error)
                    continue
                send = self._sender(own, own_info)
            maker = None if patches is None else PatchMaker(patches, info.encoding)
            outputs.append(
                TopicSummary(
                    info.name,
                    item,
                    (own,) if maker is None else (channel, own),
                    (send,) if maker is None else (raw, send),
                    work_of(item, info.encoding, maker),
                    core=core,
                    executor=self._executor,
                    source=channel,
                    maker=maker,
                    parts=self._parts,
                )
            )
        cap = RateCap(resolved.spec.max_rate_hz)
        topic = SummarisedTopic(core, channel, raw, outputs, cap)
        self._topics.append(topic)
        return channel, topic

    @staticmethod
    def _info(info: TopicInfo, item: SummarySpec, name: TopicName, spec: TopicSpec) -> TopicInfo:
        """What is said of a summary's stream."""
        if item.kind is SummaryKind.VOXEL:
            return replace(info, name=name)
        type_name = UPDATE_TYPE if item.kind is SummaryKind.PATCHES else item.kind.result_type
        return ros_types.topic_info(name, type_name, info.encoding, latched=spec.latched, reliable=info.reliable)

    def to_json(self, now: float) -> list[dict[str, object]]:
        """What /api/link says of them: what each topic is sent as, and for how long where the link has changed it."""
        return [
            {
                "topic": item.topic,
                "stream": item.stream,
                "kind": str(item.kind),
                "level": str(item.level),
                "by_link": item.by_link,
                "switches": 0 if item.fit is None else item.fit.switches,
                "since_s": None if item.fit is None or item.fit.changed_s is None else now - item.fit.changed_s,
            }
            for item in self.topics
        ]

    def forget(self, topic: Source) -> None:
        """The topic is gone and closed."""
        self._topics = [known for known in self._topics if known is not topic]

    def close(self) -> None:
        """What is being worked on comes to nothing; waits for it to end, which takes milliseconds."""
        self._topics.clear()
        self._executor.shutdown(wait=True, cancel_futures=True)


def register_summaries(metrics: Metrics, summaries: Summaries) -> None:
    """What the summaries of a client cost and save, by topic (local name) and kind."""

    def per_topic(read: Callable[[TopicSummary], float]) -> Callable[[], list[tuple[Labels, float]]]:
        return lambda: [((item.topic, str(item.kind)), read(item)) for item in summaries.topics]

    labels = ("topic", "kind")
    counters: tuple[tuple[str, str, Callable[[TopicSummary], float]], ...] = (
        ("messages", "Messages of which a summary was made.", lambda item: item.profile.messages),
        ("raw_bytes", "Bytes of those messages.", lambda item: item.bytes_in),
        ("bytes", "Bytes of their summaries.", lambda item: item.bytes_out),
        ("cpu_seconds", "Processor time of making them.", lambda item: item.cpu_s),
        ("undecodable", "Messages of which none could be made.", lambda item: item.undecodable),
    )
    for name, text, read in counters:
        metrics.counter(f"sern_summary_{name}_total", text, labels, per_topic(read))
    metrics.counter(
        "sern_summary_switches_total",
        "Times that what the link carries changed the level.",
        labels,
        per_topic(lambda item: 0.0 if item.fit is None else float(item.fit.switches)),
    )
    metrics.gauge(
        "sern_summary_level",
        "1 while summaries are sent, 0 while messages go as they come.",
        labels,
        per_topic(lambda item: float(item.level is SummaryLevel.SUMMARY)),
    )
