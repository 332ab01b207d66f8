"""What a daemon has to tell to be watched: rows one at a time, since thousands in one go would hold the loop."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, Protocol

from sern_runtime.watching.history import Look
from sern_runtime.watching.state import TopicPart

Json = Mapping[str, Any]


class Adapting(NamedTuple):
    """The adaptation: /api/mmcf without its links, and a row of each with its last interval."""

    head: Json
    links: Iterator[Json]


class Told(Protocol):
    """One daemon. Rows have the shape that they have under /api; iterators outlive changes of what they go over."""

    def head(self) -> Json:
        """/api/clients without its rows: `name`, `role`, `time`, `refused_total`."""
        ...

    def clients(self) -> Iterator[Json]:
        """The rows of /api/clients."""
        ...

    def links(self) -> Iterator[Json]:
        """The rows of /api/link."""
        ...

    def topics(self) -> Iterator[TopicPart]:
        """The rows of /api/topics."""
        ...

    def objects(self) -> Iterator[str]:
        """The kind of each cross-reality object."""
        ...

    def adapting(self) -> Adapting | None:
        """The adaptation; None: there is none."""
        ...

    def looks(self, now: float) -> Iterator[Look]:
        """How each link is now."""
        ...
