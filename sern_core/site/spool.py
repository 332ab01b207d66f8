"""Store and forward on the link: what a robot says that it has kept, what a site asks for, what it has by now. Pure.

A robot keeps messages under the seq that they have in their live stream, sent or not, so that a site knows by numbers
what it lacks: all bodies below are network order.

| stream (`sern_core.topics.spool_names`) | body |
|---|---|
| `T/_kept` | for each boot number of the robot a `SPAN`, the oldest first |
| `T/_fetch/SITE` | `REQUEST`, then runs of seqs as `RUN` |
| `T/_fetched/SITE` | `FETCHED` and the kept body; or `FETCHED` alone, of boot 0: the request of this number is done |
"""

import struct
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Final, NamedTuple

from sern_core.site.runs import Run, Runs
from sern_core.vocabulary.errors import WireError
from sern_core.wire import framing

SPAN: Final = struct.Struct("!QQQqqQQ?")
"""Boot number, first and last seq, first and last stamp, messages, bytes, and whether the live stream is reliable."""
REQUEST: Final = struct.Struct("!QQQqq")
"""Number of the request, the lowest that still counts, boot number, and from and to which stamp."""
RUN: Final = struct.Struct("!QQ")
FETCHED: Final = struct.Struct("!QQ")
"""Boot number and seq of the message that follows; or 0 and the number of the request that is done."""

MAX_SPANS: Final = 64
"""Boot numbers of which a robot tells, the newest."""
MAX_RUNS: Final = 128
"""Runs of one request."""
MAX_ASKED: Final = 1000
"""Numbers that one request is about at most."""
MAX_REQUESTS: Final = 3
"""Requests under way of a topic: while one is answered the next is there."""
MAX_HAD_RUNS: Final = 200_000
"""Runs that are remembered of a stream; beyond it the oldest gaps are given up."""
EVER: Final = (-(2**63), 2**63 - 1)
"""Every stamp there is, in nanoseconds."""
MAX_UNKNOWN_RUNS: Final = 1000
"""The same while no robot has said that it keeps the topic."""
SETTLE_S: Final = 10.0
"""What a robot has kept may still come live for so long; it is not asked for before."""


class Span(NamedTuple):
    """What there is of one boot number. Not every seq of it need be there."""

    boot: int
    first: int
    last: int
    first_ns: int
    last_ns: int
    messages: int
    nbytes: int
    reliable: bool


class Request(NamedTuple):
    """Messages that a site asks for. Requests below `oldest` do not count any more."""

    number: int
    oldest: int
    boot: int
    from_ns: int
    to_ns: int
    runs: tuple[Run, ...]


def encode_report(spans: Sequence[Span]) -> bytes:
    return b"".join(SPAN.pack(*span) for span in spans[-MAX_SPANS:])


def decode_report(body: bytes) -> tuple[Span, ...]:
    """Raises WireError."""
    if len(body) % SPAN.size or len(body) > MAX_SPANS * SPAN.size:
        raise WireError("what is said to be kept has a length that no report has")
    spans = tuple(Span(*fields) for fields in SPAN.iter_unpack(body))
    for span in spans:
        if not 1 <= span.first <= span.last <= framing.MAX_SEQ or not span.boot:
            raise WireError(f"messages {span.first} to {span.last} are said to be kept")
    if len({span.boot for span in spans}) < len(spans):
        raise WireError("one process is said to have kept messages twice")
    return spans


def encode_request(request: Request) -> bytes:
    head = REQUEST.pack(request.number, request.oldest, request.boot, request.from_ns, request.to_ns)
    return head + b"".join(RUN.pack(*run) for run in request.runs)


def decode_request(body: bytes) -> Request:
    """Raises WireError."""
    rest = len(body) - REQUEST.size
    if rest < RUN.size or rest % RUN.size or rest > MAX_RUNS * RUN.size:
        raise WireError("a request has a length that none has")
    runs = tuple(RUN.iter_unpack(body[REQUEST.size :]))
    below = 0
    for first, last in runs:
        if not below < first <= last <= framing.MAX_SEQ:
            raise WireError("the runs of a request must rise")
        below = last
    number, oldest, boot, from_ns, to_ns = REQUEST.unpack_from(body)
    return Request(number, oldest, boot, from_ns, to_ns, runs)


class Window(NamedTuple):
    """Somebody wants the messages of these stamps, or all of them (`ALWAYS`)."""

    from_ns: int
    to_ns: int


ALWAYS: Final = Window(*EVER)


class Missing(NamedTuple):
    """What a robot has and a site lacks, at most: of a stream of which not every message was kept it may be less."""

    messages: int
    nbytes: int


class TopicFetch:
    """What one site has of one topic that a robot keeps, and what it asks for next.

    `first_number`: of the first request; numbers of other processes of this site must be others. Call `reported` with
    what the robot says, `have` with what is safely recorded here, `accept` with what comes as fetched.
    """

    def __init__(self, first_number: int) -> None:
        self.spans: dict[int, Span] = {}
        self.given_up = 0
        """Messages that are not asked for, because too many gaps would have to be remembered."""
        self.gone = 0
        """Messages that the robot had said to have, and had no more when it was asked."""
        self._had: dict[int, Runs] = {}
        self._live: int | None = None  # boot number of the live stream
        self._came: dict[int, Runs] = {}  # as fetched, and not recorded yet
        self._seen: list[tuple[float, dict[int, int]]] = []  # when it was said what the last seqs were
        self._asked: dict[int, Request] = {}
        self._torn: set[int] = set()  # requests of whose answer something was lost
        self._tried: dict[Window, dict[int, Runs]] = {}
        self._number = first_number

    # --- what is known ----------------------------------------------------------------------------------------------

    def reported(self, spans: Collection[Span], *, now: float) -> None:
        """The robot says what it has kept; what it no longer has need not be remembered."""
        self.spans = {span.boot: span for span in spans}
        self._seen.append((now, {span.boot: span.last for span in spans}))
        if len(self._seen) > 1 and now - self._seen[1][0] >= SETTLE_S:
            del self._seen[0]  # the second is old enough by now
        for boot in [boot for boot in self._had if boot not in self.spans and boot != self._live]:
            del self._had[boot]
        for boot, span in self.spans.items():
            if boot in self._had:
                self._had[boot].remove_below(span.first)

    def began(self, boot: int) -> None:
        """The live stream is of this boot number."""
        self._live = boot

    def have(self, boot: int, first: int, last: int) -> None:
        """These are recorded here, however they came."""
        had = self._had.setdefault(boot, Runs())
        had.add(first, last)
        if self.spans:
            self.given_up += had.shed(MAX_HAD_RUNS)
        else:
            had.shed(MAX_UNKNOWN_RUNS)

    def had(self) -> Iterator[tuple[int, Runs]]:
        """What is recorded here, by boot number."""
        return iter(self._had.items())

    def missing(self, window: Window = ALWAYS) -> Missing:
        """What lies in a window and is not here."""
        messages = nbytes = 0
        for span in self._spans(window):
            had = self._had.get(span.boot)
            lacking = span.last - span.first + 1 - (0 if had is None else had.within(span.first, span.last))
            lacking = min(lacking, span.messages)
            messages += lacking
            nbytes += lacking * span.nbytes // max(span.messages, 1)
        return Missing(messages, nbytes)

    def _spans(self, window: Window) -> list[Span]:
        return [s for s in self.spans.values() if s.first_ns <= window.to_ns and s.last_ns >= window.from_ns]

    # --- what is asked ----------------------------------------------------------------------------------------------

    @property
    def under_way(self) -> int:
        """Requests that are not done."""
        return len(self._asked)

    def ask(self, windows: Iterable[Window], *, now: float) -> Request | None:
        """The next request, the oldest messages first; None: there is nothing to ask for by now."""
        if len(self._asked) >= MAX_REQUESTS:
            return None
        for window in windows:
            for span in sorted(self._spans(window), key=lambda span: span.first_ns):
                runs = self._lacking(window, span, now)
                if runs:
                    number, self._number = self._number, (self._number + 1) % 2**63
                    oldest = min(self._asked, default=number)
                    request = Request(number, oldest, span.boot, window.from_ns, window.to_ns, runs)
                    self._asked[number] = request
                    return request
        return None

    def answered(self, window: Window, *, now: float) -> bool:
        """Whether everything of a window that the robot has told of was asked for, answered and recorded."""
        if not self.spans or any((r.from_ns, r.to_ns) == window for r in self._asked.values()) or self._came:
            return False
        return not any(self._lacking(window, span, now) for span in self._spans(window))

    def _lacking(self, window: Window, span: Span, now: float) -> tuple[Run, ...]:
        known = Runs()
        boot, upto = span.boot, self._settled(span, now)
        sources = [self._had.get(boot), self._came.get(boot), self._tried.get(window, {}).get(boot)]
        asked = [run for request in self._asked.values() if request.boot == boot for run in request.runs]
        for first, last in asked:
            known.add(first, last)
        runs: list[Run] = []
        room = MAX_ASKED
        for gap in _gaps(span.first, upto, [source for source in (*sources, known) if source is not None]):
            first, last = gap[0], min(gap[1], gap[0] + room - 1)
            runs.append((first, last))
            room -= last - first + 1
            if not room or len(runs) == MAX_RUNS:
                break
        return tuple(runs)

    def _settled(self, span: Span, now: float) -> int:
        """The last seq that cannot come live any more."""
        if span.boot != next(reversed(self.spans)):  # of a process that has ended
            return span.last
        if span.reliable and span.boot == self._live:  # in order, or not at all
            had = self._had.get(span.boot)
            return 0 if had is None else min(span.last, had.last)
        said = [last for at_s, lasts in self._seen if now - at_s >= SETTLE_S and (last := lasts.get(span.boot))]
        return min(span.last, max(said, default=0))

    def accept(self, boot: int, seq: int) -> bool:
        """A message came as fetched. False: it was not asked for, or it is here already."""
        came = self._came.setdefault(boot, Runs())
        if seq in came or (boot in self._had and seq in self._had[boot]):
            return False
        for request in self._asked.values():
            if request.boot == boot and any(first <= seq <= last for first, last in request.runs):
                came.add(seq, seq)
                return True
        return False

    def recorded(self, boot: int, seq: int) -> None:
        """A message that was accepted is safely recorded."""
        self.have(boot, seq, seq)
        self._not_under_way(boot, seq)

    def lost(self, boot: int, seq: int) -> None:
        """A message that was accepted could not be recorded: it may be asked for again."""
        self._not_under_way(boot, seq)
        for number, request in self._asked.items():
            if request.boot == boot and any(first <= seq <= last for first, last in request.runs):
                self._torn.add(number)

    def _not_under_way(self, boot: int, seq: int) -> None:
        came = self._came.get(boot)
        if came is not None:
            came.remove(seq)
            if not came:
                del self._came[boot]

    def torn(self) -> None:
        """Something of an answer was lost on its way: what it is cannot be told, so it is asked for again."""
        self._torn.update(self._asked)

    def done(self, number: int) -> bool:
        """A request is answered: what did not come is not there any more. False: there is no such request."""
        request = self._asked.pop(number, None)
        if request is None:
            return False
        torn = number in self._torn
        self._torn.discard(number)
        if torn:
            return True
        window = Window(request.from_ns, request.to_ns)
        if window == ALWAYS:
            came = self._came.get(request.boot, Runs())
            for first, last in request.runs:
                for gap in list(came.gaps(first, last)):
                    self.gone += self._missed(request.boot, *gap)
            return True
        tried = self._tried.setdefault(window, {}).setdefault(request.boot, Runs())
        for first, last in request.runs:
            tried.add(first, last)
        return True

    def _missed(self, boot: int, first: int, last: int) -> int:
        had = self._had.setdefault(boot, Runs())
        return had.add(first, last)

    def forget_requests(self) -> None:
        """Nobody will answer what was asked: the robot is another process, or has been silent for too long."""
        self._asked.clear()
        self._torn.clear()

    def forget_window(self, window: Window) -> None:
        """Nobody wants this window any more."""
        self._tried.pop(window, None)


def _gaps(first: int, last: int, sources: Sequence[Runs]) -> Iterator[Run]:
    """The runs from `first` to `last` that are in none of the sources."""
    if not sources:
        if first <= last:
            yield first, last
        return
    for low, high in sources[0].gaps(first, last):
        yield from _gaps(low, high, sources[1:])
