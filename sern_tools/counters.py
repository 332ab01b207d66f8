"""Reading the counters that daemons leave behind at exit, and that they tell over HTTP while they run."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sern_core.vocabulary.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Counters:
    """The counters of one topic at one daemon. `direction`: send or receive; at the relay onward, to one of its
    clients, or inward."""

    daemon: str
    direction: str
    offered: int = 0
    delivered: int = 0
    refused: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict)
    in_queue: int = 0
    in_flight: int = 0


def read_counters(files: Iterable[Path]) -> dict[str, list[Counters]]:
    """The summaries of several daemons, by global topic. ConfigError, naming the file, for anything else.

    A client has one entry a topic, of direction `send` or `receive`. The relay has one for each client it sends the
    topic to (`onward`) and one for what it received (`inward`).
    """
    found: dict[str, list[Counters]] = {}
    for path in files:
        try:
            document = json.loads(path.read_text())
            if "relay" in document:
                parts = [*(("onward", part) for part in document["links"].values()), ("inward", document["received"])]
                entries = [
                    (topic, document["relay"], way, values) for way, part in parts for topic, values in part.items()
                ]
            else:
                topics = document["topics"].items()
                entries = [(topic, document["client"], values["direction"], values) for topic, values in topics]
            for topic, daemon, direction, values in entries:
                found.setdefault(topic, []).append(_counters(daemon, direction, values))
        except OSError as error:
            raise ConfigError(f"cannot read the summary: {error.strerror}", file=str(path)) from error
        except (ValueError, KeyError, AttributeError, TypeError) as error:
            raise ConfigError(f"not a summary of a daemon ({type(error).__name__}: {error})", file=str(path)) from error
    return found


def _counters(daemon: str, direction: str, values: Mapping[str, Any]) -> Counters:
    """A receiver's entry has only what a receiver knows; the rest is 0."""
    return Counters(
        daemon,
        direction,
        offered=int(values.get("offered", 0)),
        delivered=int(values["delivered"]),
        refused=int(values.get("refused", 0)),
        dropped={str(reason): int(count) for reason, count in values["dropped"].items()},
        in_queue=int(values.get("in_queue", 0)),
        in_flight=int(values.get("in_flight", 0)),
    )
