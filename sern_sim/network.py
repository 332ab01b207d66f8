"""The virtual-time network: joins state machines through modelled links and runs them without waiting.

Theory of operation
    A *port* is one side of a hop; a *node* groups ports that share state. `Network.join` connects two ports by a pair
    of modelled links. Events (arrivals, deadlines, calls, connections made and broken) sit in one heap of tuples
    (time_ns, sequence, kind, subject, data, epoch); equal times are served in the order in which they were made, so
    a run depends on its seed and on nothing else.
    After every event on a node: its hook `after_event`, then `next_datagram` of its ports until None, then the hook
    again as long as it says that it gave a port something to do, then the deadlines are armed.

Time
    Inside: integer nanoseconds since the start of the run (scenario time). Ports see `now`, a float in seconds with a
    random offset, so that nothing may rely on time beginning at zero. Scripts (`at`, `every`, `run_until`) speak in
    scenario seconds, as profiles do; `Network.now` and `Network.elapsed_s` give both.
"""

from collections.abc import Callable, Iterable, Sequence
from heapq import heappop, heappush
from random import Random
from typing import Any, Final

from sern_core.vocabulary.errors import UsageError
from sern_sim.events import EventLog, SimulationTimeoutError
from sern_sim.hop import Hop
from sern_sim.hosts import Hosts
from sern_sim.links import NEVER, NS, Link, to_ns
from sern_sim.models import LinkModel
from sern_sim.ports import Direction, Node, NodeState, Port, Slot
from sern_sim.watchdog import Watchdog

MAX_EVENTS_PER_INSTANT: Final = 100_000
"""More events and datagrams than this at one instant are an endless loop, not traffic (a stall of a fast stream
delivers tens of thousands at once)."""
EARLIEST_START_S: Final = 1e5
LATEST_START_S: Final = 1.3e5
"""Clock readings at the start. More than a day, so that a clock reading handed to a function that takes scenario time
is caught; below 2^17 s, where a float resolves 0.015 ns and the offset changes nothing that a port computes."""

_DELIVER, _TIMER, _CALL, _CONNECT, _BREAK = range(5)
_NAMES: Final = ("arrival", "deadline", "call", "connect", "break")


class Call:
    """A scheduled call; `cancel` takes it back."""

    __slots__ = ("callback", "cancelled", "node", "period_ns")

    def __init__(self, callback: Callable[[float], object], node: "NodeState | None", period_ns: int) -> None:
        self.callback = callback
        self.node = node
        self.period_ns = period_ns
        self.cancelled = False

    def cancel(self) -> None:
        self.cancelled = True


class Network:
    """A deterministic network in virtual time; see the module's docstring.

    `seed` decides everything random. `start_s` is the clock reading at the start, random when not given.
    `log` records every event (slower). Raises UsageError for misuse, SimulationStuck when time stands still.
    """

    def __init__(
        self,
        seed: int,
        *,
        start_s: float | None = None,
        max_events_per_instant: int = MAX_EVENTS_PER_INSTANT,
        log: EventLog | None = None,
    ) -> None:
        self._random = Random(seed)
        offset_s = self._random.uniform(EARLIEST_START_S, LATEST_START_S)
        self._start_ns = to_ns(offset_s if start_s is None else start_s)
        self._watchdog = Watchdog(max_events_per_instant)
        self._log = log
        self._heap: list[tuple[int, int, int, Any, bytes, int]] = []
        self._sequence = 0
        self._hosts = Hosts()
        self.hops: list[Hop] = []
        self.elapsed_ns = 0
        self.now = self._start_ns / NS
        self.event_count = 0
        self._running = False

    # ------------------------------------------------------------------ building

    def join(
        self,
        port_a: Port,
        node_a: Node | None,
        port_b: Port,
        node_b: Node | None,
        forward: LinkModel,
        backward: LinkModel,
        *,
        name: str = "",
        beside: Hop | None = None,
    ) -> Hop:
        """Connect two ports; `forward` carries a to b. A node of None: the port stands alone. `beside`: another hop
        whose bottlenecks, one each way, this one shares.

        Both ports get `connected` as the next event, or for a stream as soon as the path is there.
        Raises UsageError when a port is joined already, is not of its node, or the modes of the links differ.
        """
        if forward.mode is not backward.mode:
            raise UsageError("forward and backward are of different modes: make both datagram or both stream")
        name = name or f"hop{len(self.hops)}"
        slot_a = self._hosts.add(port_a, node_a, f"{name}.a")
        slot_b = self._hosts.add(port_b, node_b, f"{name}.b")
        shared = (beside.forward.link, beside.backward.link) if beside is not None else (None, None)
        link_f = Link(forward, Random(self._random.getrandbits(64)), shared[0])
        link_b = Link(backward, Random(self._random.getrandbits(64)), shared[1])
        hop = Hop(self, name, slot_a, slot_b, link_f, link_b, self._break_hop)
        self.hops.append(hop)
        self._schedule_connect(hop, 0)
        return hop

    def crash_node(self, node: Node) -> None:
        """The node is gone: it is asked nothing more, stream peers see their connections break, datagrams vanish."""
        state = self._hosts.state_of(node)
        if not state.alive:
            raise UsageError("crash_node: the node is gone already")
        state.alive = False
        for hop in self.hops:
            if gone := hop.slots_of(state):
                hop.generation += 1  # a pending attempt to connect is void
                if hop.connected:
                    # A stream's peer sees the connection break; nothing tells a datagram's peer.
                    self._disconnect(hop, hop.slots if hop.streaming else gone)

    def replace_node(self, old: Node, new: Node, ports: Sequence[tuple[Port, Port]] | None = None) -> None:
        """A new object takes the place of `old` (crashed now, or before by `crash_node`): a process started again.

        `ports` pairs old and new ports; by default those of both nodes in their order. Its hops connect as after any
        break; in datagram mode only the new node's ports are told, as nothing tells a datagram's peer.
        """
        state = self._hosts.state_of(old)
        replacements = self._hosts.replacements(old, new, ports)
        if state.alive:
            self.crash_node(old)
        self._hosts.replace(state, new, replacements)
        for hop in self.hops:
            if hop.slots_of(state):
                self._schedule_connect(hop, hop.reconnect_ns(None))
        for slot in state.slots:
            self._settle(state, slot)

    # ------------------------------------------------------------------ scripts

    @property
    def start_s(self) -> float:
        """The clock reading at the start of the run."""
        return self._start_ns / NS

    @property
    def elapsed_s(self) -> float:
        """Scenario time: seconds since the start of the run."""
        return self.elapsed_ns / NS

    def at(self, elapsed_s: float, callback: Callable[[float], object], *, node: Node | Port | None = None) -> Call:
        """Call `callback(now)` at scenario time `elapsed_s`. With `node`, only that node is asked for output after."""
        return self._schedule(self._scenario_ns(elapsed_s), callback, node, 0)

    def after(self, delay_s: float, callback: Callable[[float], object], *, node: Node | Port | None = None) -> Call:
        """Call `callback(now)` in `delay_s` from now."""
        return self._schedule(self.elapsed_ns + to_ns(delay_s), callback, node, 0)

    def every(
        self,
        period_s: float,
        callback: Callable[[float], object],
        *,
        node: Node | Port | None = None,
        first_s: float = 0.0,
    ) -> Call:
        """Call `callback(now)` every `period_s`, first in `first_s` from now, without drift, until cancelled."""
        period_ns = to_ns(period_s)
        if period_ns <= 0:
            raise UsageError(f"period_s is {period_s}: give a time above 0 s")
        return self._schedule(self.elapsed_ns + to_ns(first_s), callback, node, period_ns)

    def _schedule(
        self, at_ns: int, callback: Callable[[float], object], node: Node | Port | None, period_ns: int
    ) -> Call:
        call = Call(callback, None if node is None else self._hosts.state_of(node), period_ns)
        self._push(at_ns, _CALL, call, 0)
        return call

    def _scenario_ns(self, elapsed_s: float) -> int:
        at_ns = to_ns(elapsed_s)
        if at_ns >= self._start_ns >= to_ns(EARLIEST_START_S):
            raise UsageError(f"{elapsed_s} s looks like a clock reading: give seconds since the start of the run")
        if at_ns < self.elapsed_ns:
            raise UsageError(f"{elapsed_s} s is over: the run is at {self.elapsed_s} s")
        return at_ns

    # ------------------------------------------------------------------ running

    def run_until(self, elapsed_s: float) -> None:
        """Run to scenario time `elapsed_s`, events at that very time included."""
        end_ns = self._scenario_ns(elapsed_s)
        self._run(end_ns, None)
        self._set_time(end_ns)

    def run_for(self, duration_s: float) -> None:
        """Run on for `duration_s`."""
        end_ns = self.elapsed_ns + to_ns(duration_s)
        self._run(end_ns, None)
        self._set_time(end_ns)

    def run_until_true(self, condition: Callable[[], object], *, within_s: float, what: str = "condition") -> float:
        """Run until `condition()` holds, checked after every event; returns how long it took in seconds.

        Raises SimulationTimeoutError, naming `what`, when it does not hold `within_s` from now.
        """
        begin_ns = self.elapsed_ns
        end_ns = begin_ns + to_ns(within_s)
        if condition() or self._run(end_ns, condition):
            return (self.elapsed_ns - begin_ns) / NS
        self._set_time(end_ns)
        if not condition():
            raise SimulationTimeoutError(f"{what}: not within {within_s} s, by {self.elapsed_s:.3f} s of the run")
        return (self.elapsed_ns - begin_ns) / NS

    def _run(self, end_ns: int, condition: Callable[[], object] | None) -> bool:
        if self._running:
            raise UsageError("a call made by the network cannot run the network: schedule what is to follow instead")
        self._running = True
        try:
            return self._run_events(end_ns, condition)
        finally:
            self._running = False

    def _run_events(self, end_ns: int, condition: Callable[[], object] | None) -> bool:
        heap, watchdog = self._heap, self._watchdog
        while heap and heap[0][0] <= end_ns:
            at_ns, _, kind, subject, data, epoch = heappop(heap)
            if at_ns != self.elapsed_ns:
                self._set_time(at_ns)
            self.event_count += 1
            watchdog.count += 1
            if watchdog.count > watchdog.quiet:
                watchdog.note(self.elapsed_s, f"{_NAMES[kind]} {subject.callback if kind == _CALL else subject.name}")
            if kind == _DELIVER:
                self._on_arrival(subject, data, epoch)
            elif kind == _TIMER:
                self._on_timer(subject)
            elif kind == _CALL:
                self._on_call(subject)
            elif kind == _CONNECT:
                self._on_connect(subject, epoch)
            elif epoch == subject.generation:
                self._break_hop(subject, None)
            if condition is not None and condition():
                return True
        return False

    def _set_time(self, at_ns: int) -> None:
        if at_ns > self.elapsed_ns:
            self.elapsed_ns = at_ns
            self.now = (self._start_ns + at_ns) / NS
            watchdog = self._watchdog
            if watchdog.count > watchdog.quiet:
                watchdog.forget()
            watchdog.count = 0

    def _push(self, at_ns: int, kind: int, subject: Any, epoch: int) -> None:
        self._sequence += 1
        heappush(self._heap, (at_ns, self._sequence, kind, subject, b"", epoch))

    # ------------------------------------------------------------------ events on nodes

    def _settle(self, state: NodeState, slot: Slot | None) -> None:
        """After an event on a node: hook, output, deadlines. `slot`: the port it happened on; None: any."""
        if not state.alive:
            return
        hook = state.after_event
        if hook is not None:
            hook(self.now)
        if state.take_dirty is None:
            slots: Iterable[Slot] = state.slots
            touched = None
        else:
            slots = touched = {} if slot is None else {slot: None}
            self._add_dirty(state.take_dirty, touched)
        while True:
            for each in slots:
                if each.connected:
                    self._drain(each)
            more = hook is not None and bool(hook(self.now))
            if touched is not None and state.take_dirty is not None:
                more |= self._add_dirty(state.take_dirty, touched)
            if not more:
                break
            watchdog = self._watchdog
            watchdog.count += 1
            if watchdog.count > watchdog.quiet:
                watchdog.note(self.elapsed_s, "more to send after sending")
        for each in slots:
            due_ns = each.arm(self._start_ns, self.elapsed_ns)
            if due_ns < NEVER:
                self._sequence += 1
                heappush(self._heap, (due_ns, self._sequence, _TIMER, each, b"", 0))

    def _add_dirty(self, take_dirty: Callable[[], Iterable[Port]], touched: dict[Slot, None]) -> bool:
        before = len(touched)
        for port in take_dirty():
            slot = self._hosts.slots.get(id(port))
            if slot is not None:
                touched[slot] = None
        return len(touched) > before

    def _drain(self, slot: Slot) -> None:
        next_datagram, now = slot.next_datagram, self.now
        data = next_datagram(now=now)
        if data is None:
            return
        direction = slot.out
        link = direction.link
        send = link.send if direction.open else link.send_nowhere
        elapsed_ns, watchdog = self.elapsed_ns, self._watchdog
        while data is not None:
            watchdog.count += 1
            if watchdog.count > watchdog.quiet:
                watchdog.note(self.elapsed_s, f"datagram of {len(data)} bytes from {slot.name}")
            arrival_ns = send(len(data), elapsed_ns)
            if arrival_ns >= 0:
                self._sequence += 1
                heappush(self._heap, (arrival_ns, self._sequence, _DELIVER, direction, data, direction.epoch))
                if link.twice:
                    self._sequence += 1
                    heappush(self._heap, (arrival_ns, self._sequence, _DELIVER, direction, data, direction.epoch))
            if self._log is not None:
                self._log.add(elapsed_ns, "send" if arrival_ns >= 0 else "lost", slot.name, data)
            data = next_datagram(now=now)

    def _on_arrival(self, direction: Direction, data: bytes, epoch: int) -> None:
        link = direction.link
        if epoch != direction.epoch:
            link.broken_packets += 1
            if self._log is not None:
                self._log.add(self.elapsed_ns, "broken", direction.name, data)
            return
        link.delivered_packets += 1
        link.delivered_bytes += len(data)
        slot = direction.target
        if self._log is not None:
            self._log.add(self.elapsed_ns, "receive", slot.name, data)
        slot.receive(data, now=self.now)
        self._settle(slot.node, slot)

    def _on_timer(self, slot: Slot) -> None:
        if not slot.node.alive or not slot.pending or slot.pending[-1] != self.elapsed_ns:
            return  # left over from a node that was replaced
        slot.pending.pop()
        if slot.due_ns > self.elapsed_ns:
            if slot.due_ns < NEVER and (not slot.pending or slot.due_ns < slot.pending[-1]):
                slot.pending.append(slot.due_ns)
                self._push(slot.due_ns, _TIMER, slot, 0)
            return
        if slot.due_s > self.now:
            self.now = slot.due_s  # by less than a nanosecond: a port must never be woken before its own deadline
        if self._log is not None:
            self._log.add(self.elapsed_ns, "timeout", slot.name)
        slot.port.handle_timeout(now=self.now)
        self._settle(slot.node, slot)

    def _on_call(self, call: Call) -> None:
        if call.cancelled:
            return
        if self._log is not None:
            self._log.add(self.elapsed_ns, "call", "")
        call.callback(self.now)
        if call.period_ns and not call.cancelled:
            self._push(self.elapsed_ns + call.period_ns, _CALL, call, 0)
        for state in self._hosts.states() if call.node is None else (call.node,):
            self._settle(state, None)

    # ------------------------------------------------------------------ connections

    def _schedule_connect(self, hop: Hop, wait_ns: int) -> None:
        """Connect once the path has been there for `wait_ns`."""
        hop.wait_ns = wait_ns
        self._push(self.elapsed_ns + wait_ns, _CONNECT, hop, hop.generation)

    def _on_connect(self, hop: Hop, generation: int) -> None:
        """A connection attempt. It succeeds when both nodes live and, for a stream, the path was there all along."""
        if not hop.may_connect(generation):
            return
        back_ns = hop.path_back_ns(self.elapsed_ns) if hop.streaming else 0
        if back_ns:
            self._push(back_ns + hop.wait_ns, _CONNECT, hop, generation)
        else:
            hop.open(self.elapsed_ns)
            if hop.streaming and (break_ns := hop.fatal_blackout_ns(self.elapsed_ns)) < NEVER:
                self._push(break_ns, _BREAK, hop, hop.generation)
            self._tell_connected(hop)
        for slot in hop.slots:
            self._settle(slot.node, slot)  # deadlines are served from the beginning

    def _tell_connected(self, hop: Hop) -> None:
        for slot in hop.slots:
            # A datagram peer that lived on while the other node was replaced has been connected all the time.
            if not slot.connected:
                slot.connected = True
                if self._log is not None:
                    self._log.add(self.elapsed_ns, "connected", slot.name)
                slot.port.connected(now=self.now)

    def _break_hop(self, hop: Hop, reconnect_s: float | None) -> None:
        """See `Hop.break_connection`; nothing happens when it is down already."""
        if hop.connected:
            self._disconnect(hop, hop.slots)
            self._schedule_connect(hop, hop.reconnect_ns(reconnect_s))

    def _disconnect(self, hop: Hop, told: tuple[Slot, ...]) -> None:
        """Lose what is under way and tell the ports of `told` that live."""
        hop.close(self.elapsed_ns)
        for slot in told:
            slot.connected = False
            if slot.node.alive:
                if self._log is not None:
                    self._log.add(self.elapsed_ns, "disconnected", slot.name)
                slot.port.disconnected(now=self.now)
        for slot in told:
            self._settle(slot.node, slot)
