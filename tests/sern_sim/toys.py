"""Toy ports for the tests of the virtual-time network."""

from collections import deque
from collections.abc import Sequence

from sern_sim.hop import Hop
from sern_sim.models import PERFECT, LinkModel
from sern_sim.network import Network
from sern_sim.ports import Port


class Wire:
    """Sends what is put into `outbox`, remembers what arrives and when; no deadlines."""

    def __init__(self) -> None:
        self.outbox: deque[bytes] = deque()
        self.inbox: list[bytes] = []
        self.arrivals_s: list[float] = []  # on the network's clock
        self.history: list[str] = []

    def receive(self, data: bytes, *, now: float) -> None:
        self.inbox.append(data)
        self.arrivals_s.append(now)

    def next_datagram(self, *, now: float) -> bytes | None:
        return self.outbox.popleft() if self.outbox else None

    def next_deadline(self) -> float | None:
        return None

    def handle_timeout(self, *, now: float) -> None:
        raise AssertionError("no deadline was given")

    def connected(self, *, now: float) -> None:
        self.history.append("connected")

    def disconnected(self, *, now: float) -> None:
        self.history.append("disconnected")
        self.outbox.clear()


class Ticker(Wire):
    """Sends a numbered datagram of `size_bytes` every `period_s`, by deadline."""

    def __init__(self, period_s: float, size_bytes: int = 100) -> None:
        super().__init__()
        self.period_s = period_s
        self.size_bytes = size_bytes
        self.begin_s: float | None = None
        self.ticks = 0  # since begin_s; deadlines are multiples of the period, so that they do not drift
        self.sent = 0

    def connected(self, *, now: float) -> None:
        super().connected(now=now)
        self.begin_s = now
        self.ticks = 0

    def disconnected(self, *, now: float) -> None:
        super().disconnected(now=now)
        self.begin_s = None

    def next_deadline(self) -> float | None:
        return None if self.begin_s is None else self.begin_s + self.ticks * self.period_s

    def handle_timeout(self, *, now: float) -> None:
        due_s = self.next_deadline()
        assert due_s is not None and now >= due_s
        self.outbox.append(numbered(self.sent, self.size_bytes))
        self.sent += 1
        self.ticks += 1


class ArqSender(Wire):
    """Sends `total` numbered datagrams, at most `window` unacknowledged, each again every `timeout_s` until acked."""

    def __init__(self, total: int, *, window: int = 8, size_bytes: int = 200, timeout_s: float = 0.3) -> None:
        super().__init__()
        self.total = total
        self.window = window
        self.size_bytes = size_bytes
        self.timeout_s = timeout_s
        self.open: dict[int, float] = {}  # number -> when it is due again
        self.next_number = 0
        self.transmissions = 0
        self.online = False

    @property
    def done(self) -> bool:
        return self.next_number == self.total and not self.open

    def receive(self, data: bytes, *, now: float) -> None:
        super().receive(data, now=now)
        self.open.pop(number_of(data), None)

    def next_datagram(self, *, now: float) -> bytes | None:
        number = next((n for n, due_s in self.open.items() if due_s <= now), None)
        if number is None:
            if self.next_number == self.total or len(self.open) >= self.window:
                return None
            number = self.next_number
            self.next_number += 1
        self.open[number] = now + self.timeout_s
        self.transmissions += 1
        return numbered(number, self.size_bytes)

    def next_deadline(self) -> float | None:
        return min(self.open.values(), default=None) if self.online else None

    def handle_timeout(self, *, now: float) -> None:
        assert any(due_s <= now for due_s in self.open.values())

    def connected(self, *, now: float) -> None:
        super().connected(now=now)
        self.online = True

    def disconnected(self, *, now: float) -> None:
        super().disconnected(now=now)
        self.online = False


class ArqReceiver(Wire):
    """Acknowledges every numbered datagram and keeps each number once."""

    def __init__(self) -> None:
        super().__init__()
        self.numbers: set[int] = set()

    def receive(self, data: bytes, *, now: float) -> None:
        super().receive(data, now=now)
        self.numbers.add(number_of(data))
        self.outbox.append(data[:8])


class Hub:
    """A relay: what arrives on one port goes out on all others. Reports dirty ports when asked to."""

    def __init__(self, ports: int) -> None:
        self.wires = [HubPort(self) for _ in range(ports)]
        self.dirty: set[HubPort] = set()
        self.asked = 0

    def ports(self) -> Sequence[Port]:
        return self.wires


class DirtyHub(Hub):
    def take_dirty(self) -> Sequence[Port]:
        dirty = sorted(self.dirty, key=self.wires.index)
        self.dirty.clear()
        return dirty


class HubPort(Wire):
    def __init__(self, hub: Hub) -> None:
        super().__init__()
        self.hub = hub

    def receive(self, data: bytes, *, now: float) -> None:
        super().receive(data, now=now)
        for wire in self.hub.wires:
            if wire is not self:
                wire.outbox.append(data)
                self.hub.dirty.add(wire)

    def next_datagram(self, *, now: float) -> bytes | None:
        self.hub.asked += 1
        return super().next_datagram(now=now)


def numbered(number: int, size_bytes: int = 8) -> bytes:
    return number.to_bytes(8, "big").ljust(size_bytes, b".")


def number_of(data: bytes) -> int:
    return int.from_bytes(data[:8], "big")


def joined(
    forward: LinkModel, a: Port, b: Port, *, backward: LinkModel | None = None, seed: int = 1
) -> tuple[Network, Hop]:
    """Two lone ports on a network of their own. `backward` defaults to a perfect link of the same mode."""
    network = Network(seed)
    if backward is None:
        backward = PERFECT.as_stream() if forward.streaming else PERFECT
    return network, network.join(a, None, b, None, forward, backward)


def send_at(network: Network, wire: Wire, elapsed_s: float, *payloads: bytes) -> None:
    """Put payloads into the wire's outbox at a scenario time."""
    network.at(elapsed_s, lambda now: wire.outbox.extend(payloads), node=wire)


def elapsed(network: Network, wire: Wire) -> list[float]:
    """Arrival times since the start of the run, rounded to the nanosecond."""
    return [round(at_s - network.start_s, 9) for at_s in wire.arrivals_s]


def is_up(hop: Hop) -> bool:
    """`hop.connected`, asked anew: a type checker takes an attribute once checked for unchanged."""
    return hop.connected
