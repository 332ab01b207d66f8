"""What is wrong now, in words: the page's first lines. Pure.

Of topics that suffer from one cause there is one alert, that of a robot that is gone included: a person reads who and
why, and not the same words fifty times.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from sern_runtime.watching.state import LinkLine, View
from sern_runtime.watching.why import BAD, NO_LINK, WARN, span

LOSS: Final = 0.05
"""A share of packets lost that is worth a word."""
NAMED: Final = 3
"""Topics that an alert names."""
_RATE: Final = re.compile(r"^[0-9.]+/s ")
_NUMBERS: Final = re.compile(r"[0-9]+(?:\.[0-9]+)?")


@dataclass(frozen=True, slots=True)
class Alert:
    """`key` is the same as long as it is about the same. `topics`: some of those that it is about; `count`: all."""

    level: str
    key: str
    text: str
    topics: tuple[str, ...] = ()
    count: int = 0


def alerts(view: View) -> tuple[Alert, ...]:
    """The worst first."""
    links = [alert for line in view.links for alert in _of_link(line, relay=view.role == "relay")]
    links += [alert for line in view.peers for alert in _of_link(line, relay=True)]
    noted = [Alert(level, f"note {_blank(text)}", text) for level, text in view.notes if level in (BAD, WARN)]
    found = _with_topics([*links, *noted], view)
    return tuple(sorted(found, key=lambda alert: (alert.level != BAD, alert.key)))


def _of_link(line: LinkLine, *, relay: bool) -> Iterator[Alert]:
    """`relay`: a robot or a site is at the other end; else our relay is."""
    why = f": {line.why}" if line.why else ""
    how_long = "" if line.since_s is None else f" for {span(line.since_s)}"
    match line.state:
        case "silent":
            heard = "" if line.heard_s is None else f", last heard {span(line.heard_s)} ago"
            yield Alert(BAD, f"link {line.peer}", f"{line.peer} does not answer{heard}")
        case "connected":
            if line.loss is not None and line.loss >= LOSS:
                yield Alert(WARN, f"loss {line.peer}", f"{line.peer}: {line.loss:.0%} of the packets are lost")
        case _ if not relay:
            yield Alert(BAD, f"link {line.peer}", f"there is no link to the relay{how_long}{why}")
        case "away":
            yield Alert(BAD, f"link {line.peer}", f"{line.peer} is gone{how_long}{why}")
        case _:
            return


def of_link(why: str) -> bool:
    """Whether these words about a topic are about a link that is down, and so about all topics behind it."""
    return _peer_of(why) is not None


def _peer_of(why: str) -> str | None:
    """Whose link is down by these words about a topic; empty: the relay's. None: they are about something else."""
    if why == NO_LINK:
        return ""
    for words in (" is gone", " does not answer"):
        name, found, _ = why.partition(words)
        if found and " " not in name:
            return name
    return None


def _with_topics(found: list[Alert], view: View) -> list[Alert]:
    """The alerts, with those of topics; topics whose cause is told already are counted with it."""
    relay = view.links[0].peer if view.role == "client" and view.links else ""
    by_key = {alert.key: alert for alert in found}
    for line in view.topics:
        if line.level not in (BAD, WARN):
            continue
        peer = _peer_of(line.why)
        cause = line.why.partition(": ")[0]
        key = f"topics {_blank(cause)}" if peer is None else f"link {peer or relay}"
        known = by_key.get(key)
        if known is None:
            text = f"{line.topic}: {line.why}" if peer is None else line.why
            by_key[key] = Alert(line.level, key, text, (line.topic,), 1)
            continue
        level = BAD if BAD in (known.level, line.level) else WARN
        text = _RATE.sub("", cause) if peer is None else known.text
        by_key[key] = Alert(level, key, text, (*known.topics, line.topic)[:NAMED], known.count + 1)
    return list(by_key.values())


def _blank(text: str) -> str:
    """A text without its numbers: it stays the same while they change."""
    return _NUMBERS.sub("#", text)
