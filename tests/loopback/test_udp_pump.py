"""A paced lane through the pump: bursts instead of wake-ups, late binding, and no spinning while it is not ready."""

from functools import partial

from sern_runtime import clock
from sern_runtime.pump import BURST, Pump
from sern_runtime.zmq_socket import SendResult
from tests.loopback.udp_support import ROBOT, Client, Relay
from tests.support import until


class PacedPort:
    """One datagram every `interval_s`, `count` in all; what was not used is granted later."""

    def __init__(self, count: int, interval_s: float) -> None:
        self.count = count
        self.interval_s = interval_s
        self.next_s = clock.now()
        self.taken: list[int] = []
        self.asked = 0
        self.too_early = 0

    def next_datagram(self, *, now: float) -> bytes | None:
        self.asked += 1
        if len(self.taken) == self.count:
            return None
        if now < self.next_s:
            return None
        self.next_s += self.interval_s
        self.taken.append(len(self.taken))
        return b"%d" % self.taken[-1]

    def next_deadline(self) -> float | None:
        return self.next_s if len(self.taken) < self.count else None

    def handle_timeout(self, *, now: float) -> None:
        self.too_early += now < self.next_s


def unexpected() -> None:
    raise AssertionError("the peer is not gone")


async def test_what_is_due_within_a_millisecond_leaves_as_one_burst() -> None:
    sent: list[bytes] = []

    def send(datagram: bytes) -> SendResult:
        sent.append(datagram)
        return SendResult.OK

    port = PacedPort(1000, 0.00005)
    pump = Pump(port, send, on_gone=unexpected, ready=lambda: True)
    pump.kick()
    await until(lambda: len(sent) == 1000)
    wakes = port.asked - 1000
    assert sent == [b"%d" % number for number in range(1000)]
    assert wakes <= 1000 / 4, "20 datagrams become due in each millisecond"
    assert port.too_early == 0
    pump.close()


async def test_nothing_is_taken_while_the_lane_is_not_ready() -> None:
    """The port may still change its mind about what goes first; and its overdue deadline does not turn the loop."""
    answers = [False]
    asked = 0

    def ready() -> bool:
        nonlocal asked
        asked += 1
        return answers[-1]

    port = PacedPort(3 * BURST, 0.0)
    pump = Pump(port, lambda _datagram: SendResult.OK, on_gone=unexpected, ready=ready)
    pump.kick()
    begun_s = clock.now()
    await until(lambda: asked >= 4)
    assert asked <= 2 + (clock.now() - begun_s) / 0.009
    assert port.asked == 0 and port.taken == []
    answers.append(True)
    pump.kick()
    await until(lambda: len(port.taken) == 3 * BURST)
    pump.close()


async def test_a_pump_at_each_end_of_a_session() -> None:
    relay = Relay()
    session = relay.open()
    client = Client(session.parameters)
    down, up = PacedPort(300, 0.0001), PacedPort(300, 0.0001)
    pumps = [
        Pump(down, session.send, on_gone=unexpected, ready=session.ready),
        Pump(up, client.udp.send, on_gone=unexpected, ready=client.udp.ready),
    ]
    relay.server.on_writable = lambda _session: pumps[0].kick()
    client.udp.on_writable = pumps[1].kick
    for pump in pumps:  # neither knows of the other's address yet: they start when they may
        pump.kick()
    expected = [b"%d" % number for number in range(300)]
    await until(partial(relay.data, ROBOT))
    await until(lambda: relay.data() == expected and client.received == expected)
    assert [pump.datagrams for pump in pumps] == [300, 300]
    for pump in pumps:
        pump.close()
    client.close()
    relay.close()
