"""What topics would offer at each level of their summaries, from what they offer now and what a summary was seen to be.

A topic counts only while its messages and its summary both go somewhere: else its rule decides, as ever.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from typing import Final, NamedTuple, Protocol

from sern_core.adaptation.model import Configuration, Levels
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
    """What one channel is offered: messages an interval, their mean size, processor time of making one."""

    channel: OutChannel
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


def offers_by_level(offers: Sequence[Offer], items: Sequence[Summarised]) -> Iterator[tuple[Levels, list[Offer]]]:
    """Every level there is to choose, with what would be offered at it."""
    by_source: dict[OutChannel, list[Summarised]] = defaultdict(list)
    for item in items:
        by_source[item.source].append(item)
    theirs = {channel for item in items for channel in (item.source, item.channel)}
    others = [offer for offer in offers if offer.channel not in theirs]
    now = {offer.channel: offer for offer in offers}
    classes = {source.spec.priority for source in by_source}
    for level in product(*((False, True) if priority in classes else (False,) for priority in CLASSES)):
        found = list(others)
        for source, summaries in by_source.items():
            # Each message goes to the source or to every summary of it: so often the topic ticks.
            own = max(now[s.channel].per_interval if s.channel in now else 0.0 for s in summaries)
            rate = own if any(s.channel is source for s in summaries) else own + _rate(now, source)
            found += _at(level[source.spec.priority], source, summaries, rate)
        yield level, found


def _rate(now: dict[OutChannel, Offer], channel: OutChannel) -> float:
    return now[channel].per_interval if channel in now else 0.0


def _at(summarised: bool, source: OutChannel, summaries: list[Summarised], rate: float) -> Iterator[Offer]:
    if rate <= 0.0:
        return
    if not summarised:
        yield Offer(source, rate, summaries[0].profile.raw_bytes)
        return
    for item in summaries:
        profile = item.profile
        yield Offer(item.channel, rate, profile.raw_bytes * profile.bytes_ratio, profile.seconds_per_message)


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
        """After the levels have been set; `items` are those that may be chosen."""
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
