"""What nobody at the far side wants is not taken from the middleware.

A bridge subscribes to every topic that it offers. While one of them is not wanted, an endpoint has nothing open for it
at its middleware, unless it is latched: the last messages of such a topic must be there for whoever comes.
"""

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Final, Generic, Protocol, TypeVar

from sern_client.endpoints.base import Difference, Sink
from sern_client.endpoints.common.saying import SayOnce
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import TopicName

RETRY_S: Final = 1.0
"""What the middleware refused is asked for again after so long."""


class Taking(Protocol):
    """A subscription of the bridge, and what the middleware gives for it."""

    name: TopicName
    wanted: bool

    def refresh(self) -> None:
        """Have at the middleware what is to be there now, or nothing. ConfigError where it gives none."""
        ...

    @property
    def lacking(self) -> bool:
        """Whether something is to be there and is not."""
        ...

    def close(self) -> None: ...


Receive = Callable[[TopicInfo, Callable[[bytes, int], None]], Callable[[], None]]
"""`end = receive(info, arrived)`: have `arrived(body, stamp_ns)` called on the event loop with what is published, until
`end()`. ConfigError where the middleware refuses."""


class OnDemand:
    """A subscription that receives while its topic is wanted, or latched."""

    def __init__(self, info: TopicInfo, sink: Sink, receive: Receive, closed: "Callable[[OnDemand], None]") -> None:
        self.name = info.name
        self.wanted = True
        self._info = info
        self._sink = sink
        self._receive = receive
        self._on_close = closed
        self._closed = False
        self._end: Callable[[], None] | None = None

    def refresh(self) -> None:
        if not (self.wanted or self._info.latched) or self._closed:
            end, self._end = self._end, None
            if end is not None:
                end()
        elif self._end is None:
            end = self._end = self._receive(self._info, lambda body, stamp_ns: self._take(end, body, stamp_ns))

    @property
    def lacking(self) -> bool:
        return self._end is None and (self.wanted or self._info.latched)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self.refresh()
            self._on_close(self)

    def _take(self, end: Callable[[], None] | None, body: bytes, stamp_ns: int) -> None:
        if self._end is end:  # not what came before nobody wanted it
            self._sink(body, stamp_ns)


S = TypeVar("S", bound=Taking)


class Subscriptions(Generic[S]):
    """The open subscriptions of an endpoint, by topic."""

    def __init__(self, say_once: SayOnce) -> None:
        self._say_once = say_once
        self._open: dict[TopicName, list[S]] = {}
        self._asking: set[S] = set()

    def __iter__(self) -> Iterator[S]:
        return chain.from_iterable(self._open.values())

    def of(self, name: TopicName) -> Sequence[S]:
        return self._open.get(name, ())

    def add(self, subscription: S) -> S:
        """One that is wanted until `interest` says otherwise."""
        self._open.setdefault(subscription.name, []).append(subscription)
        self._refresh(subscription)
        return subscription

    def remove(self, subscription: S) -> None:
        """Forget one that is closed."""
        found = self._open.get(subscription.name, [])
        if subscription in found:
            found.remove(subscription)
            if not found:
                del self._open[subscription.name]

    def close(self) -> None:
        """Close all of them."""
        for subscription in list(self):
            subscription.close()

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Take a topic from now on, or no more: see `Endpoint.interest`."""
        for subscription in self.of(name):
            subscription.wanted = wanted
            self._refresh(subscription)

    def refresh(self, name: TopicName) -> None:
        """Those who publish a topic are not the ones from before."""
        for subscription in self.of(name):
            self._refresh(subscription)

    @property
    def names(self) -> Counter[TopicName]:
        """How many there are, by topic."""
        return Counter(subscription.name for subscription in self)

    def differences(self) -> list[Difference]:
        """The topics of which nothing is received though it should be."""
        lacking = dict.fromkeys(each.name for each in self if each.lacking)
        return [Difference(name, "nothing at the middleware takes it") for name in lacking]

    def _refresh(self, subscription: S) -> None:
        try:
            subscription.refresh()
        except ConfigError as error:
            self._say_once(f"{subscription.name} is not taken: {error}")
            # Some of what is refused is accepted a moment later: a reader right after the one before it was closed.
            if subscription not in self._asking:
                self._asking.add(subscription)
                asyncio.get_running_loop().call_later(RETRY_S, self._ask_again, subscription)

    def _ask_again(self, subscription: S) -> None:
        self._asking.discard(subscription)
        if subscription in self.of(subscription.name):
            self._refresh(subscription)
