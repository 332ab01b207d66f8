"""Says, once and by name, that the datagram lane was wanted and does not come up, and once that it did after all."""

import logging
from collections.abc import Callable, Collection
from typing import Final

from sern_core.lanes import LANE_UDP, LANE_ZMQ
from sern_core.link import Link
from sern_runtime import clock
from sern_runtime.metrics import Metrics

PATIENCE_S: Final = 5.0
"""How long the stream lane may work without the datagram lane before that is said: several round trips of a satellite
link, and some lost challenges."""

_log = logging.getLogger(__name__)


def datagrams_pass(link: Link) -> bool:
    """Whether the peer answers over the datagram lane."""
    lane = link.lanes.get(LANE_UDP)
    return lane is not None and lane.usable and lane.answered


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

    def tick(self) -> None:
        now = clock.now()
        links = self._links()
        for link in links:
            self._look(link, now)
        gone = self._without_since_s.keys() - {link.peer for link in links}
        for peer in gone:
            del self._without_since_s[peer]
            self._said.discard(peer)

    def _look(self, link: Link, now: float) -> None:
        peer = link.peer
        if datagrams_pass(link):
            self._without_since_s.pop(peer, None)
            if peer in self._said:
                self._said.discard(peer)
                _log.info("%s: datagrams pass now; the datagram lane is up", self._name(link))
            return
        if not (link.established and link.lanes[LANE_ZMQ].usable):  # nothing passes: that is not the datagrams' fault
            self._without_since_s.pop(peer, None)
            return
        since_s = self._without_since_s.setdefault(peer, now)
        if peer in self._said or now - since_s < PATIENCE_S:
            return
        problem = self._problem(link, PATIENCE_S)
        if problem is not None:
            self._said.add(peer)
            _log.warning("%s: %s", self._name(link), problem)

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
