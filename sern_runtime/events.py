"""What happened to a daemon's links, numbered, for /api/events: who came, was lost, was refused, took over.

Events are for programs what the log is for people, and bounded in memory: the last `MAX_EVENTS`, and apart from them
the last `MAX_REFUSED` of strangers at the door, who may come as often as they like and push nothing else out. Of one
cause (kind and about) `BURST` are kept in `INTERVAL_S`, of one kind `KIND_BURST`; how many were left out is an event
of kind `left_out` when the interval is over.

An event has a number that rises by one, `time` by the wall clock for people, `at_s` on the daemon's own clock, `kind`,
`about` (a client, a key, or empty), `text`, and what else is known by its name.
"""

import asyncio
import logging
import math
import secrets
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from heapq import merge
from typing import Any, Final

from sern_core.vocabulary.errors import UsageError
from sern_runtime import clock
from sern_runtime.http_routes import JsonParts, JsonQuery, closing_array

MAX_EVENTS: Final = 1000
MAX_REFUSED: Final = 250
INTERVAL_S: Final = 10.0
BURST: Final = 5
KIND_BURST: Final = 100
MAX_CAUSES: Final = 1000
MAX_CHARS: Final = 400
"""Characters of a text."""
MAX_WAIT_S: Final = 30.0
"""The longest that an answer may be waited for (`?wait_s=`)."""
REFUSED: Final = "refused"
LEFT_OUT: Final = "left_out"
TOO_LARGE: Final = "the answer is too large; ask for what came after a number: ?after=N"

Event = dict[str, Any]


def wall_text(at_s: float) -> str:
    """A time of the wall clock, in seconds since 1970, as the log writes it."""
    return f"{datetime.fromtimestamp(at_s, UTC):%Y-%m-%dT%H:%M:%S}.{math.floor(at_s % 1 * 1000):03d}Z"


class EventLog:
    """The events of one daemon. Call `tick` about once a second, and `close` when its HTTP server ends."""

    def __init__(self, *, wall: Callable[[], float] = time.time) -> None:
        self.boot = secrets.token_hex(8)
        """This process: numbers of another one mean nothing here."""
        self.last = 0
        """The number of the newest event."""
        self._wall = wall
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self._refused: deque[Event] = deque(maxlen=MAX_REFUSED)
        self._causes: dict[tuple[str, str], int] = {}  # events of this interval
        self._kinds: Counter[str] = Counter()
        self._left_out: Counter[str] = Counter()
        self._interval_began_s = clock.now()
        self._waiters: set[asyncio.Event] = set()
        self._closed = False

    def close(self) -> None:
        """Answer whoever waits."""
        self._closed = True
        self._wake()

    def add(self, kind: str, about: str = "", text: str = "", **details: object) -> None:
        """Something has happened. What is left out for its number is counted."""
        self.tick()
        cause = (kind, about)
        count = self._causes.get(cause, 0)
        crowded = cause not in self._causes and len(self._causes) >= MAX_CAUSES
        if crowded or count >= BURST or self._kinds[kind] >= KIND_BURST:
            self._left_out[kind] += 1
            return
        self._causes[cause] = count + 1
        self._kinds[kind] += 1
        self._append(kind, about, text, details)

    def say(
        self, log: logging.Logger, level: int, kind: str, about: str, words: str, *args: object, **details: object
    ) -> None:
        """Write a line of the log that is an event as well, in the same words: `words % args`."""
        log.log(level, words, *args, extra={"event": kind, "about": about}, stacklevel=2)
        self.add(kind, about, words % args if args else words, **details)

    def tick(self) -> None:
        """See whether the interval is over, and tell of what was left out in it."""
        now = clock.now()
        if now - self._interval_began_s < INTERVAL_S:
            return
        self._interval_began_s = now
        self._causes.clear()
        self._kinds.clear()
        left_out, self._left_out = self._left_out, Counter()
        for kind, count in left_out.items():
            self._append(LEFT_OUT, "", f"{count} more of kind {kind}", {"of_kind": kind, "count": count})

    def _append(self, kind: str, about: str, text: str, details: Mapping[str, object]) -> None:
        self.last += 1
        event = {
            "number": self.last,
            "time": wall_text(self._wall()),
            "at_s": clock.now(),
            "kind": kind,
            "about": about[:MAX_CHARS],
            "text": text[:MAX_CHARS],
            **details,
        }
        knock = kind == REFUSED or details.get("of_kind") == REFUSED
        (self._refused if knock else self._events).append(event)
        self._wake()

    def _wake(self) -> None:
        for waiter in self._waiters:
            waiter.set()

    # --- reading ----------------------------------------------------------------------------------------------------

    def after(self, number: int) -> list[Event]:
        """Those that are kept and came after `number`, the oldest first."""
        both = merge(self._events, self._refused, key=_number)
        return [event for event in both if event["number"] > number]

    async def wait(self, number: int, wait_s: float) -> None:
        """Return when there is one after `number`, or after `wait_s`."""
        if self.last > number or self._closed:
            return
        waiter = asyncio.Event()
        self._waiters.add(waiter)
        try:
            async with asyncio.timeout(wait_s):
                await waiter.wait()
        except TimeoutError:
            pass
        finally:
            self._waiters.discard(waiter)

    def view(self) -> JsonQuery:
        """The route of /api/events: `?after=N&boot=BOOT&wait_s=S`, all optional.

        `missed` counts events after N that are no longer kept. N of another `boot` counts as 0: those of this
        process are told from the first on. `wait_s`: the answer waits so long for an event after N.
        """

        def asked(query: Mapping[str, str]) -> int:
            after = _whole("after", query.get("after", "0"))
            return after if query.get("boot", self.boot) == self.boot else 0

        async def prepare(query: Mapping[str, str]) -> None:
            wait_s = _seconds(query.get("wait_s", "0"))
            if wait_s:
                await self.wait(asked(query), wait_s)

        def read(query: Mapping[str, str]) -> JsonParts:
            after = asked(query)
            found = self.after(after)
            head = {
                "boot": self.boot,
                "time": wall_text(self._wall()),
                "now_s": clock.now(),
                "last": self.last,
                "missed": max(0, self.last - after - len(found)),
            }
            return JsonParts(closing_array(head, "events", found), TOO_LARGE)

        return JsonQuery(("after", "boot", "wait_s"), read, prepare)


def _number(event: Event) -> int:
    number: int = event["number"]
    return number


def _whole(name: str, value: str) -> int:
    if not (value.isascii() and value.isdecimal() and len(value) <= 18):
        raise UsageError(f"{name} is {value[:80]!r}; a number of an earlier answer is needed")
    return int(value)


def _seconds(value: str) -> float:
    try:
        wait_s = float(value)
    except ValueError:
        wait_s = math.nan
    if not 0.0 <= wait_s <= MAX_WAIT_S:
        raise UsageError(f"wait_s is {value[:80]!r}; accepted: 0 to {MAX_WAIT_S:g}")
    return wait_s
