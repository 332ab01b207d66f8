"""What topics would offer at each level of their summaries, from what they offer now and what a summary was seen to be.

A topic counts only while its messages and its summary both go somewhere: else its rule decides, as ever.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from typing import Final, NamedTuple, Protocol

from sern_core.adaptation.model import Configuration, Levels
from sern_core.link.view import TopicView
from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.spec import SummaryLevel, SummaryProfile
from sern_core.vocabulary.types import CLASSES

PROBE_INTERVALS: Final = 5
PROBE_INTERVALS_MAX: Final = 30
PROBE_SHARE: Final = 0.1


class Summarised(Protocol):
    """One summary of one topic, as the adaptation sees it."""

    @property
    def adapt(self) -> bool:
        """Whether its rule lets the level be chosen."""
        ...

    @property
    def source(self) -> OutChannel:
        """Where raw messages go."""
        ...

    @property
    def channel(self) -> OutChannel:
        """Where summaries go, the same one for a summary in place."""
        ...

    @property
    def level(self) -> SummaryLevel: ...

    @property
    def level_by_rule(self) -> SummaryLevel: ...

    @property
    def profile(self) -> SummaryProfile: ...

    @property
    def cpu_s(self) -> float:
        """Processor time spent so far."""
        ...

    def set_level(self, level: SummaryLevel) -> None: ...


class Offer(NamedTuple):
    """What one stream is offered: messages an interval, their mean size, processor time of making one."""

    view: TopicView
    per_interval: float
    mean_bytes: float
    prepare_s: float = 0.0


def chosen(items: Iterable[Summarised]) -> list[Summarised]:
    """Those whose level may be chosen now."""
    return [
        item
        for item in items
        if item.adapt
        and item.profile.messages
        and all(channel.wanted and channel.ready for channel in (item.source, item.channel))
    ]


def level_of(items: Sequence[Summarised]) -> Levels:
    """What is in force."""
    summarised = {item.source.spec.priority for item in items if item.level is SummaryLevel.SUMMARY}
    return tuple(priority in summarised for priority in CLASSES)


def offers_by_level(
    offers: Sequence[Offer], items: Sequence[Summarised], views: Iterable[TopicView]
) -> Iterator[tuple[Levels, list[Offer]]]:
    """Every level there is to choose, with what would be offered at it. `views` are of all streams that are wanted."""
    known = {view.stream.id: view for view in views}
    items = [item for item in items if {item.source.stream.id, item.channel.stream.id} <= known.keys()]
    by_source: dict[OutChannel, list[Summarised]] = defaultdict(list)
    for item in items:
        by_source[item.source].append(item)
    theirs = {channel.stream.id for item in items for channel in (item.source, item.channel)}
    others = [offer for offer in offers if offer.view.stream.id not in theirs]
    rates = {offer.view.stream.id: offer.per_interval for offer in offers}
    classes = {source.spec.priority for source in by_source}
    for level in product(*((False, True) if priority in classes else (False,) for priority in CLASSES)):
        found = list(others)
        for source, summaries in by_source.items():
            # Each message goes to the source or to every summary of it: so often the topic ticks.
            own = max(rates.get(item.channel.stream.id, 0.0) for item in summaries)
            in_place = any(item.channel is source for item in summaries)
            rate = own if in_place else own + rates.get(source.stream.id, 0.0)
            if rate <= 0.0:
                continue
            if not level[source.spec.priority]:
                found.append(Offer(known[source.stream.id], rate, summaries[0].profile.raw_bytes))
                continue
            for item in summaries:
                nbytes = item.profile.raw_bytes * item.profile.bytes_ratio
                found.append(Offer(known[item.channel.stream.id], rate, nbytes, item.profile.seconds_per_message))
        yield level, found


def apply_levels(items: Iterable[Summarised], configuration: Configuration) -> None:
    """Set what is chosen; where nothing may be chosen, what the rule says. From each topic's next message on."""
    items = [item for item in items if item.adapt]
    free = chosen(items)
    for item in items:
        level = item.level_by_rule
        if configuration.summaries is not None and any(item is one for one in free):
            summarised = configuration.summaries[item.source.spec.priority]
            level = SummaryLevel.SUMMARY if summarised else SummaryLevel.RAW
        if item.level is not level:
            item.set_level(level)


class RawProbe:
    """Sends one raw message now and then while its summaries go.

    They fill no link, so nobody would see that it has become a better one. A probe takes PROBE_SHARE of what the link
    is believed to carry, in the mean, but they are PROBE_INTERVALS apart at least and PROBE_INTERVALS_MAX at
    most.
    """

    def __init__(self, interval_s: float) -> None:
        self._least_s, self._most_s = PROBE_INTERVALS * interval_s, PROBE_INTERVALS_MAX * interval_s
        self._due_s: dict[OutChannel, float] = {}
        self._under_way: list[tuple[Summarised, int]] = []

    def start(self, items: Sequence[Summarised], capacity_bps: float | None, *, now: float) -> None:
        """Takes over levels that have been set; `items` are those that may be chosen."""
        summarised = [item for item in items if item.level is SummaryLevel.SUMMARY]
        for gone in self._due_s.keys() - {item.source for item in summarised}:
            del self._due_s[gone]
        for item in summarised:
            raw_s = 8.0 * item.profile.raw_bytes / max(capacity_bps or 0.0, 1.0)
            due_s = self._due_s.setdefault(
                item.source, now + min(max(self._least_s, raw_s / PROBE_SHARE), self._most_s)
            )
            if now >= due_s and capacity_bps:
                source = item.source
                self._under_way.append((item, source.counters.offered))
                source.adapt(share=1.0, depth_max=source.depth)  # until the next interval
                source.probe_from_seq = source.next_seq
                item.set_level(SummaryLevel.RAW)
        for item, _ in self._under_way:
            self._due_s.pop(item.source, None)

    def finish(self) -> None:
        """Back to summaries where a message has gone; to be called often."""
        waiting = []
        for item, offered in self._under_way:
            if item.source.counters.offered > offered:
                item.set_level(SummaryLevel.SUMMARY)
            else:
                waiting.append((item, offered))
        self._under_way = waiting

    def abort(self) -> None:
        """What was begun is over, before levels are read or set."""
        for item, _ in self._under_way:
            item.set_level(SummaryLevel.SUMMARY)
        self._under_way.clear()
