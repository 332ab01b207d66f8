"""Errors that nobody expects, raised on purpose at the n-th call of something, while a world runs."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from sern_core.link.control_reader import ControlReader
from sern_core.link.handler import LinkHandler
from sern_core.link.housekeeping import Housekeeping
from sern_core.link.streams_out import StreamsOut
from sern_core.objects.registry import ObjectRegistry
from sern_core.path.congestion.hybrid import HybridWindow
from sern_core.path.flight import Flight
from sern_core.relay.forwarding import Forwarding
from sern_core.relay.hub_link_handler import HubLinkHandler
from sern_core.site.client import ClientCore
from sern_core.stream.in_stream import InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.scheduler import Scheduler
from tests.world import SimClient, SimHub


class Injected(Exception):  # noqa: N818  (no error of the program)
    """Raised where a test wants it."""


CALLBACKS = [name for name in vars(LinkHandler) if name.startswith("on_") and name != "on_fault"]
HUB_EVENTS = (
    "client_up",
    "client_down",
    "stream_added",
    "stream_removed",
    "message",
    "refused",
    "lane_asked",
    "lane_closed",
)
CLIENT_EVENTS = (
    "link_up",
    "link_down",
    "stream_opened",
    "stream_closed",
    "message",
    "expired",
    "skipped",
    "send_dropped",
    "wanted",
)
Place = tuple[type, str]
HANDLERS: list[Place] = [
    *((HubLinkHandler, name) for name in CALLBACKS),
    *((ClientCore, name) for name in CALLBACKS),
    *((SimHub, name) for name in HUB_EVENTS),
    *((SimClient, name) for name in CLIENT_EVENTS),
]
RECORDS: list[Place] = [(SimClient, "send_dropped"), (SimClient, "expired"), (SimClient, "skipped")]
"""Where the tests learn what was reported: these raise only after they have taken it down."""
"""Where the core calls its owner, and the owner its shell."""
INSIDE: list[Place] = [
    (Forwarding, "forward"),
    (InStream, "fragment"),
    (HybridWindow, "on_ack"),
    (HybridWindow, "on_sent"),
    (Flight, "acked"),
    (Scheduler, "pick"),
    (Scheduler, "charge"),
    (ControlReader, "handle"),
    (StreamsOut, "control_sent"),
    (Housekeeping, "sweep"),
    (OutChannel, "submit"),
    (ObjectRegistry, "observe"),
]
"""Inside the core: no call of these is expected to fail, and none may do lasting harm."""


class Faults:
    """Counts the calls of some places, and raises at one of them, before or after it has done its work."""

    def __init__(self, at: tuple[Place, int] | None = None, *, after: bool = False) -> None:
        self.calls: Counter[Place] = Counter()
        self.raised = 0
        self.armed = True
        self._at = at
        self._after = after

    @contextmanager
    def __call__(self, places: list[Place]) -> Iterator["Faults"]:
        with ExitStack() as stack:
            for place in places:
                owner, name = place
                stack.enter_context(patch.object(owner, name, self._wrap(place, getattr(owner, name))))
            yield self

    def _wrap(self, place: Place, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            if not self.armed:
                return original(*args, **kwargs)
            self.calls[place] += 1
            hit = self._at == (place, self.calls[place])
            if hit and not self._after:
                self.raised += 1
                raise Injected(f"{place[0].__name__}.{place[1]}")
            result = original(*args, **kwargs)
            if hit:
                self.raised += 1
                raise Injected(f"{place[0].__name__}.{place[1]}")
            return result

        return call
