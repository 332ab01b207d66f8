"""One action of another site at this one: its parts as they come and go, and when nodes here see it."""

import asyncio
import logging
from collections.abc import Callable, Iterator, Mapping
from math import inf
from typing import Final, Protocol

from sern_client.endpoints.base import (
    Publisher,
    PublishWithin,
    ServiceHandler,
    ServiceInfo,
    ServiceServer,
    publisher_within,
)
from sern_client.endpoints.common.saying import SayOnce
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import TopicName
from sern_runtime import clock
from sern_runtime.loop import Timer

INCOMPLETE_S: Final = 10.0
"""An action that lacks a part for so long is told of."""
GONE: Final = "its server is gone"

_log = logging.getLogger(__name__)


class Passing(Protocol):
    """The endpoint without actions of the other ROS."""

    def pass_topic(self, info: TopicInfo) -> Publisher:
        """Publish a topic at it. ConfigError where that cannot be."""
        ...

    def pass_service(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        """Serve a service at it. ConfigError where that cannot be."""
        ...


class Stage(Protocol):
    """How nodes here see an action: `prepare`, `begin`, then any calls, then `end`, again and again."""

    needed: frozenset[str]
    """The parts that it is made of."""

    @property
    def busy(self) -> bool:
        """Whether a goal is under way."""
        ...

    @property
    def pending(self) -> bool:
        """Whether something goes on that no goal here waits for."""
        ...

    def prepare(self, parts: "Mapping[str, Part]") -> Iterator[None]:
        """Find out how it is shown, in steps of some milliseconds. ConfigError, in one line without the action's name,
        where it cannot be."""
        ...

    def begin(self) -> None:
        """Show the action as was found out. ConfigError as `prepare`; nothing is open then."""
        ...

    def refresh(self, parts: "Mapping[str, Part]", away: str) -> None:
        """What there is of it now. `away`: why it takes no goal; empty: it does."""
        ...

    def message(self, kind: str, body: bytes) -> None: ...

    def end(self) -> None: ...

    async def stop(self) -> None:
        """Return when nothing goes on any more; after the last `end`."""
        ...


class Part:
    """A topic or service of the action, as the bridge holds it: its `Publisher` or `ServiceServer`.

    `kind`: the last part of its name. `handler`: that of a service. Where the action is not converted, it passes.
    """

    def __init__(
        self, owner: "Crossing", kind: str, info: TopicInfo | ServiceInfo, handler: ServiceHandler | None = None
    ) -> None:
        self.kind = kind
        self.info = info
        self.handler = handler
        self._owner = owner
        self._passed: Publisher | ServiceServer | None = None
        self._publish: PublishWithin | None = None
        self._closed = False

    @property
    def passes(self) -> bool:
        """Whether it is at the endpoint as any other."""
        return self._passed is not None

    def pass_on(self, to: Passing) -> None:
        """Pass on to `to` from now on; say so where that cannot be."""
        if self._passed is not None or self._closed:
            return
        try:
            if isinstance(self.info, TopicInfo):
                publisher = to.pass_topic(self.info)
                self._passed, self._publish = publisher, publisher_within(publisher)
            elif self.handler is not None:
                self._passed = to.pass_service(self.info, self.handler)
        except ConfigError as error:
            _log.error("%s is not to be had here: %s", self.info.name, error)

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self.publish_within(body, stamp_ns, inf)

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        if self._publish is not None:
            self._publish(body, stamp_ns, left_s)
        elif not self._closed:
            self._owner.message(self.kind, body)

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._owner.part_closed(self)
        if self._passed is not None:
            self._passed.close()


class Crossing:
    """An action that one rule of `use` is about. `said`: where what is wrong is told. `gone` is called when nothing is
    left of it."""

    def __init__(self, name: TopicName, stage: Stage, to: Passing, said: SayOnce, gone: Callable[[], None]) -> None:
        self.name = name
        self.stage = stage
        self.active = False
        """Whether nodes here see it."""
        self._to = to
        self._said = said
        self._gone = gone
        self._parts: dict[str, list[Part]] = {}  # of each kind, the newest last
        self._shown: tuple[object, ...] = ()  # what the parts were that nodes here see it by, or soon will
        self._preparing: Iterator[None] | None = None
        self._failed = False
        self._closed = False
        self._settling = False
        self._incomplete = Timer(self._say_incomplete)

    def __iter__(self) -> Iterator[Part]:
        for parts in self._parts.values():
            yield from parts

    def open(self, kind: str, info: TopicInfo | ServiceInfo, handler: ServiceHandler | None = None) -> Part:
        """A part is there."""
        part = Part(self, kind, info, handler)
        self._parts.setdefault(kind, []).append(part)
        if self._failed:
            part.pass_on(self._to)
        self.settle_soon()
        return part

    def part_closed(self, part: Part) -> None:
        self._parts[part.kind].remove(part)
        if not self._parts[part.kind]:
            del self._parts[part.kind]
        self.settle_soon()

    def message(self, kind: str, body: bytes) -> None:
        """A message of one of its topics. Before nodes here see the action they have no goal that it could be about."""
        if self.active:
            self.stage.message(kind, body)

    def settle_soon(self) -> None:
        """Not from within the bridge, which is in the middle of something."""
        if not self._settling and not self._closed:
            self._settling = True
            asyncio.get_running_loop().call_soon(self._settle)

    def close(self) -> None:
        self._closed = True
        self._incomplete.close()
        self._end()

    async def stop(self) -> None:
        """Return when nothing goes on any more; after `close`."""
        await self.stage.stop()

    def _settle(self) -> None:
        self._settling = False
        if self._closed:
            return
        parts = {kind: each[-1] for kind, each in self._parts.items()}
        if not parts:
            self._failed = False
        complete = self.stage.needed <= parts.keys()
        self._watch_for_the_rest(bool(parts) and not complete and not self.active and not self._failed)
        if complete and not self._failed:
            self._show(parts)
        self.stage.refresh(parts, "" if complete else GONE)
        if self.active and not complete and not self.stage.busy:
            self._end()
        if not (parts or self.active or self.stage.pending):
            self._closed = True
            self._incomplete.close()
            self._gone()

    def _show(self, parts: Mapping[str, Part]) -> None:
        shown = tuple((part.info.type_name, part.info.definition) for _, part in sorted(parts.items()))
        if self.active and (shown == self._shown or self.stage.busy):
            return
        if self.active:  # another server, with another type; what served the first ends before
            self._end()
            self.settle_soon()
            return
        if self._preparing is None or shown != self._shown:
            self._shown = shown
            self._preparing = self.stage.prepare(parts)
        try:
            if next(self._preparing, self) is not self:
                self.settle_soon()
                return
            self._preparing = None
            self.stage.begin()
        except ConfigError as error:
            self._preparing = None
            self._failed = True
            self._said(f"action {self.name} is not converted: {error}")
            for part in list(self):
                part.pass_on(self._to)
            return
        self.active = True

    def _end(self) -> None:
        if self.active:
            self.active = False
            self.stage.end()

    def _watch_for_the_rest(self, lacking: bool) -> None:
        if not lacking:
            self._incomplete.arm(None)
        elif self._incomplete.deadline_s is None:
            self._incomplete.arm(clock.now() + INCOMPLETE_S)

    def _say_incomplete(self) -> None:
        lacking = ", ".join(sorted(self.stage.needed - self._parts.keys()))
        self._said(
            f"action {self.name} is not there yet: nothing has come of its {lacking}; see that its server runs, and "
            "that the relay's access rules let this site have them"
        )
