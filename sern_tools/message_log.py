"""Reading message logs: CSV files in which clients and relays write a line for whatever happens to a message there
(`sern_runtime/message_log.py` says what).

The baseline writes the same format, so that one analysis reads both. Columns (`HEADER`): `wall_ns` is the wall time
of the event; `stamp_ns` the wall time at which the origin took the message; `seq` counts per topic from 1; `crc32` is
of the body; `age_s` is what SERN believed the age to be at delivery (empty where unknown); `peer` is the other end of
the hop.
"""

import csv
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final, NamedTuple, TextIO

from sern_core.vocabulary.errors import ConfigError

HEADER: Final = ("event", "wall_ns", "topic", "class", "seq", "bytes", "stamp_ns", "crc32", "age_s", "reason", "peer")


class Event(StrEnum):
    OFFERED = "offered"
    REFUSED = "refused"
    DELIVERED = "delivered"
    EXPIRED = "expired"
    RECEIVED = "received"
    DROPPED = "dropped"
    DISCARDED = "discarded"
    HELD = "held"


class Offer(NamedTuple):
    wall_ns: int
    seq: int
    size_bytes: int
    crc32: int


class Delivery(NamedTuple):
    wall_ns: int
    seq: int
    size_bytes: int
    crc32: int
    stamp_ns: int
    age_s: float | None

    @property
    def latency_s(self) -> float:
        """The time from stamp to arrival, on one host, whose clock both ends share."""
        return (self.wall_ns - self.stamp_ns) / 1e9


@dataclass(slots=True)
class TopicLog:
    """What all who have to do with one topic wrote about it. `origin` names the log that holds its offers."""

    topic: str
    priority: str
    origin: str = ""
    offers: dict[int, Offer] = field(default_factory=dict)
    refused: set[int] = field(default_factory=set)
    expired: dict[int, str] = field(default_factory=dict)  # seq: reason
    deliveries: list[Delivery] = field(default_factory=list)  # in the order of arrival
    received: dict[str, set[int]] = field(default_factory=dict)  # by relay
    # By place and the other end of its hop: reasons by seq, and how many lines have each reason.
    dropped: dict[tuple[str, str], dict[int, str]] = field(default_factory=dict)
    discarded: dict[tuple[str, str], dict[int, str]] = field(default_factory=dict)
    held: dict[tuple[str, str], dict[int, str]] = field(default_factory=dict)
    lines: dict[Event, Counter[tuple[str, str]]] = field(default_factory=dict)  # place and reason

    @property
    def offered(self) -> int:
        return len(self.offers.keys() | self.refused)

    def drop_reasons(self) -> Counter[str]:
        return Counter(self.expired.values())


def read_logs(files: Iterable[tuple[str, Path]]) -> dict[str, TopicLog]:
    """Merge the logs of several daemons, given as (name, file).

    Raises ConfigError with file and line for anything that is not a message log. A last line without its end is left
    out: a process that is killed while it writes leaves one.
    """
    topics: dict[str, TopicLog] = {}
    for client, path in files:
        try:
            text = path.read_text()
        except OSError as error:
            raise ConfigError(f"cannot read the message log: {error.strerror}", file=str(path)) from error
        lines = text.splitlines()
        if lines and not text.endswith("\n"):
            lines.pop()
        if not lines or tuple(lines[0].split(",")) != HEADER:
            raise ConfigError(f"not a message log: the first line is {','.join(HEADER)!r}", file=str(path), line=1)
        for number, row in enumerate(csv.reader(lines[1:]), start=2):
            try:
                _take(topics, client, row)
            except ValueError as error:
                raise ConfigError(f"not a line of a message log ({error})", file=str(path), line=number) from error
    return topics


def _take(topics: dict[str, TopicLog], client: str, row: list[str]) -> None:
    event, wall_ns, topic, priority, seq_text, size, stamp_ns, crc, age, reason, peer = row
    log = topics.get(topic)
    if log is None:
        log = topics[topic] = TopicLog(topic, priority)
    seq = int(seq_text)
    match Event(event):
        case Event.OFFERED:
            log.origin = client
            log.offers[seq] = Offer(int(wall_ns), seq, int(size), int(crc))
        case Event.REFUSED:
            log.origin = client
            log.refused.add(seq)
        case Event.EXPIRED:
            log.expired[seq] = reason
            log.lines.setdefault(Event.EXPIRED, Counter())[client, reason] += 1
        case Event.RECEIVED:
            log.received.setdefault(client, set()).add(seq)
        case Event.DROPPED | Event.DISCARDED | Event.HELD as kind:
            table = {Event.DROPPED: log.dropped, Event.DISCARDED: log.discarded, Event.HELD: log.held}[kind]
            table.setdefault((client, peer), {})[seq] = reason
            log.lines.setdefault(kind, Counter())[client, reason] += 1
        case Event.DELIVERED:
            log.deliveries.append(
                Delivery(int(wall_ns), seq, int(size), int(crc), int(stamp_ns), float(age) if age else None)
            )


class MessageLog:
    """Writes the format: for the baseline; SERN's clients have their own writer of the same lines."""

    def __init__(self, path: Path) -> None:
        self._file: TextIO = path.open("w", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(HEADER)

    def offered(self, topic: str, priority: str, offer: Offer) -> None:
        row = (Event.OFFERED, offer.wall_ns, topic, priority, offer.seq, offer.size_bytes, offer.wall_ns, offer.crc32)
        self._writer.writerow((*row, "", "", ""))

    def delivered(self, topic: str, priority: str, delivery: Delivery) -> None:
        wall_ns, seq, size, crc, stamp_ns, _ = delivery
        self._writer.writerow((Event.DELIVERED, wall_ns, topic, priority, seq, size, stamp_ns, crc, "", "", ""))

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self._file.close()
