"""Ports and nodes: what the virtual-time network joins, and how it keeps them."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final, Protocol

from sern_sim.links import NEVER, NS, Link, LinkStats
from sern_sim.models import LinkModel

NEVER_S: Final = NEVER / NS


class Port(Protocol):
    """One side of a hop. `now` is seconds on the network's clock; deadlines are on the same clock.

    A port begins unconnected; `connected` comes before it is asked for datagrams, and again after each
    `disconnected`. While it is not connected nothing is asked for, but deadlines are served.
    """

    def receive(self, data: bytes, *, now: float) -> None: ...

    def next_datagram(self, *, now: float) -> bytes | None:
        """The next datagram to send, or None when nothing may be sent now."""

    def next_deadline(self) -> float | None:
        """When `handle_timeout` is due; None or inf: never. A time in the past is due at once."""

    def handle_timeout(self, *, now: float) -> None:
        """The deadline has come: `now` is never before it. Must move the deadline."""

    def connected(self, *, now: float) -> None: ...

    def disconnected(self, *, now: float) -> None: ...


class Node(Protocol):
    """Ports that share state: an event on one may give others something to send.

    Two methods more are used when they exist. `after_event(now: float) -> bool | None` is called after each event on
    the node and after each round of sending; True says that it gave a port something to do.
    `take_dirty() -> Iterable[Port]` hands over (and forgets) the ports whose output or deadline may have changed since
    the last call; a node with many ports has it so that not all are asked after every event.
    """

    def ports(self) -> Sequence[Port]: ...


class SoloNode:
    """A node of one port, with an optional hook."""

    def __init__(self, port: Port, after_event: Callable[[float], bool | None] | None = None) -> None:
        self.port = port
        self.after_event = after_event

    def ports(self) -> Sequence[Port]:
        return (self.port,)


class NodeState:
    """A node as the network sees it: the record that stays while the object behind it may be replaced."""

    __slots__ = ("after_event", "alive", "node", "slots", "take_dirty")

    def __init__(self, node: Node) -> None:
        self.slots: list[Slot] = []
        self.adopt(node)

    def adopt(self, node: Node) -> None:
        self.node = node
        self.alive = True
        self.after_event: Callable[[float], bool | None] | None = getattr(node, "after_event", None)
        self.take_dirty: Callable[[], Iterable[Port]] | None = getattr(node, "take_dirty", None)


class Clock(Protocol):
    """What counters and queues are as of."""

    @property
    def elapsed_ns(self) -> int: ...


class Direction:
    """One direction of a hop: its link and what became of the packets."""

    __slots__ = ("_clock", "epoch", "link", "name", "open", "target")

    def __init__(self, clock: Clock, link: Link, target: "Slot", name: str) -> None:
        self._clock = clock
        self.target = target
        self.link = link
        self.name = name
        self.open = False
        self.epoch = 0  # arrivals of an earlier epoch were under way when the connection broke

    @property
    def model(self) -> LinkModel:
        return self.link.model

    @property
    def stats(self) -> LinkStats:
        """Counters since the start of the run; `later.minus(earlier)` for a part of it."""
        return self.link.stats(self._clock.elapsed_ns)

    @property
    def backlog_packets(self) -> int:
        """Packets in the bottleneck's queue now."""
        return self.link.backlog_packets(self._clock.elapsed_ns)


class Slot:
    """A port in its place in the network, with its methods at hand."""

    __slots__ = (
        "connected",
        "due_ns",
        "due_s",
        "name",
        "next_datagram",
        "next_deadline",
        "node",
        "out",
        "pending",
        "port",
        "receive",
    )

    def __init__(self, port: Port, node: NodeState, name: str) -> None:
        self.node = node
        self.name = name
        self.connected = False
        self.out: Direction
        self.adopt(port)

    def adopt(self, port: Port) -> None:
        self.port = port
        self.receive = port.receive
        self.next_datagram = port.next_datagram
        self.next_deadline = port.next_deadline
        self.due_ns = NEVER
        self.due_s = 0.0
        # Times at which a timer event of this slot is in the heap, latest first. A new one is made only when the
        # deadline is before all of them; an event that finds nothing due looks further. So none pile up.
        self.pending: list[int] = []

    def arm(self, start_ns: int, elapsed_ns: int) -> int:
        """Take the port's deadline. Returns when a timer event is to be made for it; `NEVER`: none, or there is one."""
        deadline_s = self.next_deadline()
        if deadline_s is None or deadline_s >= NEVER_S:
            self.due_ns = NEVER
            return NEVER
        # A deadline made as now + delay carries the rounding of floats; to the nearest nanosecond it is exact again,
        # whatever the clock's offset.
        due_ns = round(deadline_s * NS) - start_ns
        if due_ns < elapsed_ns:
            due_ns = elapsed_ns
        self.due_ns = due_ns
        self.due_s = deadline_s
        pending = self.pending
        if pending and due_ns >= pending[-1]:
            return NEVER
        pending.append(due_ns)
        return due_ns
