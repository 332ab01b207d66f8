"""What one call of the routing table has changed. Pure."""

from dataclasses import dataclass
from typing import Final, NamedTuple

from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, TopicName


class Match(NamedTuple):
    """The client receives the stream."""

    client: ClientName
    stream: StreamId


class Denied(NamedTuple):
    """The client named the topic, and the access rules forbid it. Of what it has only patterns for, nothing is said:
    it would learn what it may not see. `by`: the peer whose rules they are, where the topic comes from; empty: ours."""

    client: ClientName
    topic: TopicName
    by: ClientName = ClientName("")


@dataclass(frozen=True, slots=True)
class RouteChange:
    """What one call changed; every tuple is sorted and without duplicates.

    `updated` streams kept their id and got other properties: announce them again to their subscribers.
    `wanted` streams have a first subscriber, `unwanted` ones lost the last (removed streams are not listed there).
    """

    added: tuple[StreamId, ...] = ()
    updated: tuple[StreamId, ...] = ()
    removed: tuple[StreamId, ...] = ()
    matched: tuple[Match, ...] = ()
    unmatched: tuple[Match, ...] = ()
    wanted: tuple[StreamId, ...] = ()
    unwanted: tuple[StreamId, ...] = ()
    denied: tuple[Denied, ...] = ()

    def __bool__(self) -> bool:
        """True when the caller has anything to do."""
        return self != NO_CHANGE


NO_CHANGE: Final = RouteChange()


class RouteCollector:
    """Gathers one call's changes: routes are compared with how they were `before` it, so detours do not show."""

    def __init__(self) -> None:
        self.added: set[StreamId] = set()
        self.removed: set[StreamId] = set()
        self.denied: set[Denied] = set()
        self.before: dict[StreamId, tuple[ClientName, ...]] = {}

    def result(self, routes: dict[StreamId, tuple[ClientName, ...]]) -> RouteChange:
        matched: list[Match] = []
        unmatched: list[Match] = []
        wanted: list[StreamId] = []
        unwanted: list[StreamId] = []
        for stream, before in sorted(self.before.items()):
            after = routes.get(stream, ())
            if before == after:
                continue
            matched += [Match(client, stream) for client in set(after).difference(before)]
            unmatched += [Match(client, stream) for client in set(before).difference(after)]
            if not before:
                wanted.append(stream)
            elif not after and stream not in self.removed:
                unwanted.append(stream)
        return RouteChange(
            added=tuple(sorted(self.added)),
            removed=tuple(sorted(self.removed)),
            matched=tuple(sorted(matched)),
            unmatched=tuple(sorted(unmatched)),
            wanted=tuple(wanted),
            unwanted=tuple(unwanted),
            denied=tuple(sorted(self.denied)),
        )
