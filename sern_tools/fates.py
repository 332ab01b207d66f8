"""What became of every message of a topic, by its seq, from the message logs of all daemons on its way. Pure.

    origin --> relay --> subscriber

Each message that was offered has one fate: it was delivered, refused, dropped at one place for one reason, or still
waited at one place at the end. What its sender could not know (`unconfirmed`) is decided by what the next place says of
the same seq. A message of which nobody says anything is a fault, and so is one of which two places say what cannot both
be true: there is no tolerance.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from sern_tools.message_log import TopicLog

UNCONFIRMED: Final = "unconfirmed"
MAY_HAVE_ARRIVED: Final = frozenset({UNCONFIRMED, "retention", "lifespan"})
"""Reasons for which the origin of a reliable stream gives up a message that a place further on may have had already."""


NO_DROP: Final = frozenset({"delivered", "refused", "waiting"})
"""What may become of a message that is no drop."""


class Fate(NamedTuple):
    place: str
    what: str  # delivered, refused, waiting, or the reason of its drop


@dataclass(frozen=True, slots=True)
class Route:
    """The way of a topic, by the names under which its daemons' logs were read."""

    origin: str
    relay: str
    subscriber: str


@dataclass(slots=True)
class Fates:
    """The fates of one topic's messages. `faults`: seq and what is wrong."""

    by_seq: dict[int, Fate] = field(default_factory=dict)
    faults: dict[int, str] = field(default_factory=dict)

    def dropped(self) -> Counter[str]:
        """Drops by reason, of messages that have no other fate."""
        return Counter(fate.what for fate in self.by_seq.values() if fate.what not in NO_DROP)

    @property
    def waiting(self) -> int:
        return sum(fate.what == "waiting" for fate in self.by_seq.values())

    @property
    def decided(self) -> Counter[Fate]:
        return Counter(self.by_seq.values())


class _Words:
    """What the logs say of the messages of a topic."""

    def __init__(self, log: TopicLog, route: Route) -> None:
        self.route = route
        self.refused = log.refused
        self.delivered = {delivery.seq for delivery in log.deliveries}
        self.sent = log.dropped.get((route.origin, route.relay), {})
        self.received = log.received.get(route.relay, set())
        self.stopped = log.discarded.get((route.relay, route.origin), {})
        self.forwarded = log.dropped.get((route.relay, route.subscriber), {})
        self.held = log.held.get((route.relay, route.subscriber), {})
        self.kept = log.held.get((route.relay, ""), {})
        self.taken = {**log.discarded.get((route.subscriber, route.relay), {}), **log.expired}


def fates(log: TopicLog, route: Route, *, reliable: bool) -> Fates:
    """The fate of every message that was offered."""
    words = _Words(log, route)
    found = Fates()
    offered = log.offers.keys() | log.refused
    for seq in sorted(offered):
        fate = _reliable(words, seq) if reliable else _best_effort(words, seq)
        if isinstance(fate, Fate):
            found.by_seq[seq] = fate
        else:
            found.faults[seq] = fate
    for seq in (words.delivered | words.received | words.sent.keys()) - offered:
        found.faults[seq] = "there is news of it, but it was never offered"
    return found


def _best_effort(words: _Words, seq: int) -> Fate | str:
    route = words.route
    sent, forwarded = words.sent.get(seq), words.forwarded.get(seq)
    if seq in words.refused:
        return _refused(words, seq)
    arrived = seq in words.received
    if (arrived or seq in words.delivered) and sent not in (None, UNCONFIRMED):
        return f"{route.origin} dropped it ({sent}), yet it arrived"
    if seq in words.delivered:
        if not arrived:
            return f"delivered, but {route.relay} never had it"
        if forwarded not in (None, UNCONFIRMED):
            return f"{route.relay} dropped it ({forwarded}), yet it was delivered"
        return Fate(route.subscriber, "delivered")
    if not arrived:
        return _first(
            (route.origin, None if sent == UNCONFIRMED else sent),
            (route.relay, words.stopped.get(seq)),
            (route.origin, sent),
        ) or f"{route.origin} knows that it arrived, but {route.relay} has no word of it"  # fmt: skip
    return _further(words, seq) or f"{route.relay} had it, and nobody knows what became of it"


def _further(words: _Words, seq: int) -> Fate | None:
    """What became of a message that the relay had."""
    route, forwarded, held = words.route, words.forwarded.get(seq), words.held.get(seq)
    return _first(
        (route.relay, None if forwarded == UNCONFIRMED else forwarded),
        (route.subscriber, words.taken.get(seq)),
        (route.relay, forwarded),
        (route.relay, "waiting" if held is not None else None),
        (route.relay, words.stopped.get(seq)),
        (route.relay, "waiting" if seq in words.kept else None),
    )


def _reliable(words: _Words, seq: int) -> Fate | str:
    """The origin learns every drop, whoever drops, but perhaps not the last word of those further on."""
    route, sent = words.route, words.sent.get(seq)
    if seq in words.refused:
        return _refused(words, seq)
    if seq in words.delivered:
        if seq not in words.received:
            return f"delivered, but {route.relay} never had it"
        if sent is not None and sent not in MAY_HAVE_ARRIVED:
            return f"{route.origin} reports it as dropped ({sent}), yet it was delivered"
        return Fate(route.subscriber, "delivered")
    return (
        _first((route.subscriber, words.taken.get(seq)))
        or (_further(words, seq) if seq in words.received else None)
        or _first((route.origin, sent), (route.relay, words.stopped.get(seq)))
        or f"nobody reports it, and {route.subscriber} does not have it"
    )


def _refused(words: _Words, seq: int) -> Fate | str:
    if seq in words.delivered or seq in words.received:
        return f"{words.route.origin} refused it, yet it arrived"
    return Fate(words.route.origin, "refused")


def _first(*words: tuple[str, str | None]) -> Fate | None:
    """The first of these places that has a word."""
    return next((Fate(place, what) for place, what in words if what is not None), None)
