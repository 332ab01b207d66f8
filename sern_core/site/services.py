"""Services and actions on the link: the names of their streams, their bodies, their rules. Pure.

A service `/jackal1/set_mode` travels as streams like any other: classes, lifespans, access rules and accounting hold.

| stream | from | meaning |
|---|---|---|
| `/jackal1/set_mode/_service` | the site that offers it | exists while the service does; names its type; no messages |
| `/jackal1/set_mode/_call/laptop` | the site `laptop` | its calls: `CALL` and the request |
| `/jackal1/set_mode/_reply/laptop` | the site that offers it | the answers: `REPLY`, then response or error text |
"""

import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

from sern_core.topics.patterns import Pattern
from sern_core.vocabulary.types import ClientName, PriorityClass, TopicName

CALL: Final = struct.Struct("!Q")
"""Before a request: a number that the caller has not used before."""
REPLY: Final = struct.Struct("!QB")
"""Before a response: the number of the call, and 1 if what follows is an error text in UTF-8 instead."""
MAX_CALLS: Final = 64
"""Calls of one site that may be under way at one service."""

_PARTS: Final = re.compile(r"(?P<service>/.+)/_(?:(?P<offer>service)|(?P<kind>call|reply)/(?P<caller>[a-z][a-z0-9_]*))")


@dataclass(frozen=True, slots=True)
class ServiceRule:
    """Services that one site offers, or uses. `match`: local names where offered, global names where used."""

    match: Pattern
    timeout_s: float
    priority: PriorityClass = PriorityClass.STATE


class ServiceStream(NamedTuple):
    """What a stream of the table is: its service, `service`, `call` or `reply`, and whose (empty for `service`)."""

    service: TopicName
    kind: str
    caller: str


def parse(topic: TopicName) -> ServiceStream | None:
    """The parts of a global name of the table; None for a topic of the usual kind."""
    parts = _PARTS.fullmatch(topic)
    if parts is None:
        return None
    return ServiceStream(TopicName(parts["service"]), parts["offer"] or parts["kind"], parts["caller"] or "")


def offer_name(service: TopicName) -> TopicName:
    return TopicName(f"{service}/_service")


def call_name(service: TopicName, caller: ClientName) -> TopicName:
    return TopicName(f"{service}/_call/{caller}")


def reply_name(service: TopicName, caller: ClientName) -> TopicName:
    return TopicName(f"{service}/_reply/{caller}")


def find(rules: Iterable[ServiceRule], name: TopicName) -> ServiceRule | None:
    """The first rule that matches."""
    return next((rule for rule in rules if rule.match.fullmatch(name)), None)


def subscriptions(
    client: ClientName, namespace: str, *, offer: Iterable[ServiceRule], use: Iterable[ServiceRule]
) -> tuple[str, ...]:
    """The patterns that a client must subscribe to for these rules. `namespace` is normal."""
    prefix = "" if namespace == "/" else namespace
    found = [f"{prefix}(?:{rule.match.pattern})/_call/[a-z0-9_]+" for rule in offer]
    for rule in use:
        found += [f"(?:{rule.match.pattern})/_service", f"(?:{rule.match.pattern})/_reply/{client}"]
    return tuple(found)
