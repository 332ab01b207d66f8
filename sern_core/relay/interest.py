"""What the relay's table of streams and interests is made of, what one client may hold in it, and what work costs."""

from collections import deque
from dataclasses import dataclass
from typing import Final

from sern_core.topics.patterns import MAX_CLIENT_PROGRAM, PatternError, PatternSet
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, TopicName

PEER_TIMES: Final = 64
"""A peer speaks for many clients: it may want so many times as much as one."""
UNIT_S: Final = 4e-9
"""What one instruction of a pattern's program costs for one character at most, roughly: the unit of what follows."""
NAME_UNITS: Final = 500
"""A look at one name, access included."""
ROUTE_UNITS: Final = 20_000
"""What follows from a route that comes or goes: a channel, its announcement, an answer to the origin."""
COMPILE_UNITS: Final = 200
"""Compiling, for each instruction of the program and each character of a pattern."""


class BadPatternError(RefusedError):
    """A client subscribes to something that is no pattern."""

    def __init__(self, pattern: str, problem: str) -> None:
        super().__init__("bad_pattern", f"pattern {pattern[:80]!r} {problem}")
        self.pattern = pattern


@dataclass(frozen=True, slots=True)
class RoutingLimits:
    """What one client may hold in the table; beyond it the client is refused by name."""

    max_streams: int = 2_000
    max_patterns: int = 256
    max_exact: int = 4_096
    max_program: int = MAX_CLIENT_PROGRAM
    """What all patterns of a client may need together, in instructions of RE2."""
    max_all_streams: int = 60_000
    """What all clients may have together: what fits into the channel numbers of one that takes everything."""
    slice_units: int = 2_000_000
    """Matching that is done in one go."""


class WorkMeter:
    """Counts what one call of the routing table costs, in units of `UNIT_S`."""

    __slots__ = ("units",)

    def __init__(self) -> None:
        self.units = 0


class Interest:
    """What one client wants; `topics` are the known global names that it wants and may have.

    `left` are names that have not been looked at since the interest or the access rules changed.
    """

    __slots__ = ("exact", "left", "patterns", "topics")

    def __init__(self, patterns: PatternSet, exact: set[TopicName]) -> None:
        self.patterns = patterns
        self.exact = exact
        self.topics: set[TopicName] = set()
        self.left: deque[TopicName] = deque()

    def wants(self, topic: TopicName) -> bool:
        return topic in self.exact or self.patterns.fullmatch(topic)


class Topic:
    """One global name: its streams by origin, and the clients that want it and may have it, origins included."""

    __slots__ = ("streams", "subscribers")

    def __init__(self) -> None:
        self.streams: dict[ClientName, StreamId] = {}
        self.subscribers: set[ClientName] = set()


def refused(error: PatternError, client: ClientName) -> RefusedError:
    if error.text is not None:
        return BadPatternError(error.text, str(error))
    return RefusedError("too_many_patterns", f"{client}: {error}")
