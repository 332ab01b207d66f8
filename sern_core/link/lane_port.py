"""One lane of a link, as whatever moves its datagrams sees it. Pure."""

from sern_core.link.link import Link
from sern_core.vocabulary.types import PriorityClass


class LanePort:
    """One lane of a link as a port of its own: for a pump, or for the virtual-time network."""

    def __init__(self, link: Link, lane: int) -> None:
        self.link = link
        self.lane = lane

    def receive(self, data: bytes, *, now: float) -> None:
        self.link.receive(data, now=now, lane=self.lane)

    def next_datagram(self, *, now: float) -> bytes | None:
        return self.link.next_datagram(now=now, lane=self.lane)

    @property
    def priority(self) -> PriorityClass:
        """The most urgent class in the latest datagram that this port gave."""
        lane = self.link.lanes.by_id.get(self.lane)
        return PriorityClass.STATE if lane is None else lane.priority

    def next_deadline(self) -> float | None:
        return self.link.next_deadline(self.lane)

    def handle_timeout(self, *, now: float) -> None:
        self.link.handle_timeout(now=now, lane=self.lane)

    def connected(self, *, now: float) -> None:
        """A datagram socket has no connection: `Link.open_lane` begins the lane, when its keys are there."""

    def disconnected(self, *, now: float) -> None:
        """A datagram socket has no connection to lose."""
