"""Says, once and by name, that the datagram lane was wanted and does not come up, or that it fell silent in a session
that goes on; and once that datagrams pass after all."""

import logging
from collections.abc import Callable, Collection
from typing import Final

from sern_core.link.link import Link
from sern_runtime import clock
from sern_runtime.metrics import Metrics

PATIENCE_S: Final = 5.0
"""How long the stream lane may work without the datagram lane before that is said: several round trips of a satellite
link, and some lost challenges."""
STOPPED: Final = "no datagram gets through any more; data goes over TCP"

_log = logging.getLogger(__name__)


def datagrams_pass(link: Link) -> bool:
    """Whether the peer answers over the datagram lane."""
    return link.observe(now=clock.now()).datagrams_pass


class DatagramWatch:
    """Watches the datagram lane of each of `links()`.

    `problem(link, within_s)` says in one phrase what is known about why no datagram passes, and what to do; None: the
    lane is not wanted on that link. It is asked only when there is something to say, and for the metric. `name(link)`
    begins the lines of the log. Call `tick` about once a second.
    """

    def __init__(
        self,
        links: Callable[[], Collection[Link]],
        problem: Callable[[Link, float], str | None],
        name: Callable[[Link], str],
    ) -> None:
        self._links = links
        self._problem = problem
        self._name = name
        self._without_since_s: dict[str, float] = {}
        self._said: set[str] = set()
        self._passed: set[str] = set()  # peers whose datagrams have passed since their session began

    def tick(self) -> None:
        now = clock.now()
        links = self._links()
        for link in links:
            self._look(link, now)
        for peer in (self._without_since_s.keys() | self._said | self._passed) - {link.peer for link in links}:
            self._without_since_s.pop(peer, None)
            self._said.discard(peer)
            self._passed.discard(peer)

    def _look(self, link: Link, now: float) -> None:
        peer = link.peer
        if datagrams_pass(link):
            since_s = self._without_since_s.pop(peer, now)
            self._passed.add(peer)
            if peer in self._said:
                self._said.discard(peer)
                _log.warning("%s: datagrams pass now, after %.0f s without", self._name(link), now - since_s)
            return
        view = link.observe(now=now)
        if not view.established:
            self._passed.discard(peer)
        if not view.up or not view.stream_usable:
            if peer not in self._said:  # nothing passes: that is not the datagrams' fault
                self._without_since_s.pop(peer, None)
            return
        since_s = self._without_since_s.setdefault(peer, now)
        if peer in self._said or now - since_s < PATIENCE_S:
            return
        problem = self._problem(link, PATIENCE_S)
        if problem is not None:
            self._said.add(peer)
            _log.warning("%s: %s", self._name(link), STOPPED if peer in self._passed else problem)

    def register(self, metrics: Metrics) -> None:
        def up() -> list[tuple[tuple[str], float]]:
            return [
                ((link.peer,), float(datagrams_pass(link)))
                for link in self._links()
                if link.established and self._problem(link, PATIENCE_S) is not None
            ]

        metrics.gauge(
            "sern_datagram_lane_up",
            "1 while datagrams pass, 0 while a session that wants them goes on without.",
            ("peer",),
            up,
        )
