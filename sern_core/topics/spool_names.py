"""What store and forward calls its streams, and who has which part in one. Pure.

A topic `T` that a robot keeps travels beside its live stream as streams like any other:

| stream | from | meaning |
|---|---|---|
| `T/_kept` | the robot | exists while it keeps T; its one message says what there is of it |
| `T/_fetch/SITE` | the client `SITE` | what it asks for |
| `T/_fetched/SITE` | the robot | what it asked for |

No access rule names them: who may publish T is the robot in each, who may subscribe to T and have its earlier messages
(`replay`) is the site, and nobody sees what another one fetches.
"""

import re
from enum import StrEnum
from typing import Final, NamedTuple

from sern_core.vocabulary.types import ClientName, TopicName


class SpoolStreamKind(StrEnum):
    """The kinds of the table, by their word in the name."""

    KEPT = "_kept"
    FETCH = "_fetch"
    FETCHED = "_fetched"


class SpoolStream(NamedTuple):
    """What a stream of the table is: of which topic, which kind, and whose (empty for `_kept`)."""

    topic: TopicName
    kind: SpoolStreamKind
    site: ClientName


_PARTS: Final = re.compile(r"(?P<topic>/.+)/(?:(?P<kept>_kept)|(?P<kind>_fetch|_fetched)/(?P<site>[a-z][a-z0-9_]*))")


def parse(name: TopicName) -> SpoolStream | None:
    """The parts of a name of the table; None for a topic of the usual kind."""
    parts = _PARTS.fullmatch(name)
    if parts is None:
        return None
    kind = SpoolStreamKind(parts["kept"] or parts["kind"])
    return SpoolStream(TopicName(parts["topic"]), kind, ClientName(parts["site"] or ""))


def kept_name(topic: TopicName) -> TopicName:
    return TopicName(f"{topic}/_kept")


def fetch_name(topic: TopicName, site: ClientName) -> TopicName:
    return TopicName(f"{topic}/_fetch/{site}")


def fetched_name(topic: TopicName, site: ClientName) -> TopicName:
    return TopicName(f"{topic}/_fetched/{site}")


def robot_patterns(namespace: str) -> tuple[str, ...]:
    """What a robot subscribes to, to be asked. `namespace` is normal."""
    return (f"{'' if namespace == '/' else namespace}/.+/_fetch/[a-z0-9_]+",)


def site_patterns(site: ClientName, topics: tuple[str, ...]) -> tuple[str, ...]:
    """What a site subscribes to, to fetch the topics that these patterns match."""
    return tuple(f"(?:{topic})/{rest}" for topic in topics for rest in ("_kept", f"_fetched/{site}"))
