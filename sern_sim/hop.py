"""A hop of the virtual-time network: two ports, the links between them, and the connection over both."""

from collections.abc import Callable

from sern_sim.links import NEVER, Link, to_ns
from sern_sim.ports import Clock, Direction, NodeState, Slot


class Hop:
    """Two ports and the links between them. `forward` is a to b, `backward` b to a.

    `on_break` is what cuts the connection: with the hop, and when it comes back (`reconnect_ns`).
    """

    __slots__ = ("_on_break", "backward", "connected", "forward", "generation", "name", "slots", "wait_ns")

    def __init__(
        self,
        clock: Clock,
        name: str,
        a: Slot,
        b: Slot,
        forward: Link,
        backward: Link,
        on_break: Callable[["Hop", float | None], None],
    ) -> None:
        self.name = name
        self.slots = (a, b)
        self.forward = Direction(clock, forward, b, f"{name}>")
        self.backward = Direction(clock, backward, a, f"{name}<")
        a.out = self.forward
        b.out = self.backward
        self._on_break = on_break
        self.connected = False
        self.generation = 0
        """Number of the connection; attempts and breaks that were scheduled for an older one are void."""
        self.wait_ns = 0
        """How long the path must be there before it connects."""

    @property
    def streaming(self) -> bool:
        return self.forward.model.streaming

    def break_connection(self, *, reconnect_s: float | None = None) -> None:
        """Cut the connection now: what is under way is lost, both ports are told.

        It comes back by itself `reconnect_s` later (default: the links' own), or that long after the path is back.
        """
        self._on_break(self, reconnect_s)

    def slots_of(self, node: NodeState) -> tuple[Slot, ...]:
        """The ends of the hop that are that node's."""
        return tuple(slot for slot in self.slots if slot.node is node)

    def may_connect(self, generation: int) -> bool:
        """Whether an attempt of that generation is still meant, and both nodes live."""
        return not self.connected and generation == self.generation and all(slot.node.alive for slot in self.slots)

    def reconnect_ns(self, reconnect_s: float | None) -> int:
        """How long a connection that was cut stays away; None: as long as the links say."""
        if reconnect_s is None:
            reconnect_s = max(self.forward.model.reconnect_s, self.backward.model.reconnect_s)
        return to_ns(reconnect_s)

    def path_back_ns(self, elapsed_ns: int) -> int:
        """When the path is back that a blackout has taken within the last `wait_ns`; 0: it was there all along."""
        back_ns = 0
        for direction in (self.forward, self.backward):
            start_ns, end_ns = direction.link.blackout_after(elapsed_ns - self.wait_ns)
            if start_ns <= elapsed_ns:
                back_ns = max(back_ns, end_ns)
        return back_ns

    def fatal_blackout_ns(self, elapsed_ns: int) -> int:
        """When the connection breaks of the next blackout, in either direction, that it will not survive; `NEVER` or
        later: of none."""
        patience_ns = to_ns(min(self.forward.model.disconnect_after_s, self.backward.model.disconnect_after_s))
        start_ns = min(
            direction.link.long_blackout_after(elapsed_ns, patience_ns) for direction in (self.forward, self.backward)
        )
        return start_ns + patience_ns if start_ns < NEVER else NEVER

    def open(self, elapsed_ns: int) -> None:
        """Datagrams pass from now on."""
        self.connected = True
        for direction in (self.forward, self.backward):
            direction.open = True
            direction.link.reset(elapsed_ns)

    def close(self, elapsed_ns: int) -> None:
        """Nothing passes, and what is under way is lost."""
        self.connected = False
        self.generation += 1
        for direction in (self.forward, self.backward):
            direction.open = False
            direction.epoch += 1
            direction.link.reset(elapsed_ns)
