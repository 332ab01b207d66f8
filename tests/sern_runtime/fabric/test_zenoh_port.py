"""Two and three relays over zenoh on loopback: who is there, what arrives and from whom, and what is dropped."""

import asyncio
import logging
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import CLASSES, PriorityClass
from sern_core.wire.framing import MAX_DATAGRAM_BYTES, VERSIONS
from sern_runtime.fabric.port import FabricDrop, PeerRelay
from sern_runtime.fabric.zenoh_port import ZenohPort
from sern_runtime.fabric.zenoh_settings import WHOLE_BYTES
from sern_tools.ports import free_ports
from tests.sern_runtime.fabric.relays import (
    BOOT,
    A,
    B,
    C,
    Relay,
    Told,
    between,
    chain,
    external_router,
    files,
    options,
    running,
)

pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")

AGAIN_S = 1.0
LEASE_S = 0.5


async def meet(*relays: Relay) -> None:
    """Until each knows all others."""
    for relay in relays:
        await relay.until(partial(_knows, relay, len(relays) - 1))


def _knows(relay: Relay, count: int) -> bool:
    return len(relay.told.peers) == count


async def send_until(sender: Relay, receiver: Relay, body: bytes, priority: PriorityClass) -> None:
    """Until one has arrived: on a loaded machine a datagram may be dropped, and nobody is told."""
    before = receiver.told.datagrams.count((sender.name, body))

    def arrived() -> bool:
        return receiver.told.datagrams.count((sender.name, body)) > before

    while not arrived():
        assert sender.port.send(receiver.name, priority, body)
        with suppress(TimeoutError):
            async with asyncio.timeout(AGAIN_S):
                await receiver.until(arrived)


@pytest.mark.parametrize("secured", [False, True], ids=["tcp", "tls"])
async def test_two_relays_meet_send_and_part(certificates: Path, secured: bool) -> None:
    first, second = chain(certificates if secured else None, rules="c0ffee")
    async with running(first, second) as (a, b):
        await meet(a, b)
        assert a.told.peers[B] == PeerRelay(B, BOOT, VERSIONS, "c0ffee")
        for priority in CLASSES:
            for size in (0, 1, 1171, WHOLE_BYTES, MAX_DATAGRAM_BYTES):
                await send_until(a, b, bytes([int(priority)]) * size, priority)
        await send_until(b, a, b"answer", PriorityClass.CONTROL)
        sent, received = a.port.counters, b.port.counters
        assert sent.sent >= received.received >= 15 and sent.sent_bytes >= received.received_bytes
        assert 0.0 < sent.send_block_max_s <= sent.send_block_s
        assert sent.peers_up == 1
        await b.port.close()
        await a.until(lambda: not a.told.peers)
        assert a.port.counters.peers_up == 0
        assert not a.port.send(B, PriorityClass.BULK, b"late")
        assert not b.port.send(A, PriorityClass.BULK, b"late")
        assert (sent.dropped[FabricDrop.NO_PEER], received.dropped[FabricDrop.CLOSED]) == (1, 1)
        assert [kind for kind, _ in b.told.news] == ["up", "down"]


async def test_who_comes_late_is_told_what_is_there() -> None:
    first, second = chain()
    async with running(first) as (a,):
        async with running(second) as (b,):
            await b.until(lambda: b.told.peers)
            await a.until(lambda: a.told.peers)
        await a.until(lambda: ("down", (B, BOOT)) in a.told.news)
        # A new process of the same name, while the port of the old one is known to be gone.
        async with running(options(B, connect=[_port(first.listen[0])], boot=1)) as (b,):
            await a.until(lambda: B in a.told.peers)
            assert a.told.peers[B].boot == 1


def _port(locator: str) -> int:
    return int(locator.rpartition(":")[2])


async def test_the_peer_may_come_first_and_go_and_come() -> None:
    """Who connects tries again until the other one listens."""
    first, second = chain()
    async with running(second) as (b,):
        for _ in range(2):
            async with running(first) as (a,):
                await meet(a, b)
                await send_until(a, b, b"here", PriorityClass.STATE)
            await b.until(lambda: not b.told.peers)


async def test_what_is_dropped_is_counted() -> None:
    first, second = chain(inbox_datagrams=2)
    async with running(first, second) as (a, b):
        assert not a.port.send(C, PriorityClass.BULK, b"nobody")
        await meet(a, b)
        assert not a.port.send(B, PriorityClass.BULK, bytes(MAX_DATAGRAM_BYTES + 1))
        dropped = a.port.counters.dropped
        assert (dropped[FabricDrop.NO_PEER], dropped[FabricDrop.TOO_LARGE]) == (1, 1)
        # The loop of both is this one: nothing is taken while it is held, until zenoh has brought three.
        counted, full = b.port.counters, FabricDrop.INBOX_FULL
        while not counted.dropped[full]:
            for number in range(10):
                a.port.send(B, PriorityClass.CONTROL, bytes([number]))
            await asyncio.sleep(0)
        assert counted.snapshot()["dropped_inbox_full"] == counted.dropped[full]
        await send_until(a, b, b"goes on", PriorityClass.CONTROL)


async def test_an_event_that_raises_stops_nothing() -> None:
    first, second = chain()
    async with running(first, second) as (a, b):
        await meet(a, b)
        raised: list[object] = []
        asyncio.get_running_loop().set_exception_handler(lambda _loop, context: raised.append(context["exception"]))
        b.told.raises_at_bytes = 3
        for body in (b"one", b"second", b"two", b"last one"):
            await send_until(a, b, body, PriorityClass.CONTROL)
        assert {type(error) for error in raised} == {ZeroDivisionError}
        assert len(raised) == len([body for _, body in b.told.datagrams if len(body) == 3])


@pytest.mark.parametrize("secured", [False, True], ids=["tcp", "tls"])
async def test_relays_between_which_there_is_no_connection(certificates: Path, secured: bool) -> None:
    """In the middle is another one, which does not speak for others: they do not meet."""
    one, other = free_ports(2)
    own = [files(certificates, name) if secured else None for name in (A, B, C)]
    chosen = (
        options(A, listen=one, certificates=own[0]),
        options(B, connect=[one, other], certificates=own[1]),
        options(C, listen=other, certificates=own[2]),
    )
    async with running(*chosen) as (a, b, c):
        await b.until(lambda: set(b.told.peers) == {A, C})
        await a.until(lambda: B in a.told.peers)
        await c.until(lambda: B in c.told.peers)
        # What B was told by C has come to A as well, by now, if it comes at all.
        await send_until(c, b, b"to the middle", PriorityClass.CONTROL)
        await send_until(b, a, b"and on", PriorityClass.CONTROL)
        assert (set(a.told.peers), set(c.told.peers)) == ({B}, {B})


@pytest.mark.parametrize("how", ["cut", "silent"])
async def test_a_connection_that_is_gone_for_a_while(certificates: Path, how: str) -> None:
    """Of three relays two lose each other, although the third sees both; and find each other again."""
    ports = free_ports(2)
    own = [files(certificates, name) for name in (A, B, C)]
    async with between(ports[0]) as wire:
        chosen = (
            options(A, listen=ports[0], certificates=own[0], lease_s=LEASE_S),
            options(B, listen=ports[1], connect=[ports[0]], certificates=own[1], lease_s=LEASE_S),
            options(C, connect=[wire.port, ports[1]], certificates=own[2], lease_s=LEASE_S),
        )
        async with running(*chosen) as (a, b, c):
            await meet(a, b, c)
            wire.close_door(cut=how == "cut")
            await a.until(lambda: C not in a.told.peers)
            await c.until(lambda: A not in c.told.peers)
            assert set(b.told.peers) == {A, C}
            assert not c.port.send(A, PriorityClass.CONTROL, b"nobody there")
            wire.open_door()
            await a.until(lambda: C in a.told.peers)
            await c.until(lambda: A in c.told.peers)
            await send_until(c, a, b"again", PriorityClass.CONTROL)
        wire.open_door()


async def test_relays_at_a_router_of_somebody_else() -> None:
    """Both are its clients, from before it is there, and meet there."""
    (port,) = free_ports(1)
    chosen = [options(name, connect=[port], external=True) for name in (A, B)]
    async with running(*chosen) as (a, b):
        with external_router(port):
            await meet(a, b)
            await send_until(a, b, b"through the router", PriorityClass.STATE)
        await a.until(lambda: not a.told.peers)


async def test_a_router_that_stands_still_is_left_for_another_one(caplog: pytest.LogCaptureFixture) -> None:
    """It is not tried again first, which would take as long as one that is far away may take."""
    caplog.set_level(logging.INFO)
    first, second = free_ports(2)
    with external_router(first), external_router(second, beside=first):
        async with between(first) as wire:
            at_first = options(A, connect=[wire.port, second], external=True, lease_s=LEASE_S)
            async with running(at_first, options(B, connect=[second], external=True)) as (a, b):
                await meet(a, b)
                wire.close_door(cut=False)
                await a.until(lambda: ("down", (B, BOOT)) in a.told.news and B in a.told.peers)
                await send_until(a, b, b"at the second", PriorityClass.CONTROL)
                await a.port.close()
                await b.until(lambda: not b.told.peers)
                wire.open_door()
    assert caplog.text.count("is lost; going on to another one") == 1


async def test_leaving_while_no_router_answers() -> None:
    (port,) = free_ports(1)
    async with running(options(A, connect=[port], external=True)) as (a,):
        assert not a.port.send(B, PriorityClass.BULK, b"nobody")
        assert a.port.counters.dropped[FabricDrop.CLOSED] == 1


def test_without_zenoh_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(ConfigError, match=r"needs the zenoh library: .* -m pip install eclipse-zenoh"):
        ZenohPort(options(A, listen=1), Told())


async def test_a_port_that_is_taken_is_one_line() -> None:
    first, _ = chain()
    async with running(first):
        port = ZenohPort(options(B, listen=_port(first.listen[0])), Told())
        with pytest.raises(ConfigError, match=r"zenoh does not start: .*"):
            await port.start()
        await port.close()


async def test_closing_twice_and_without_a_start() -> None:
    first, _ = chain()
    port = ZenohPort(first, Told())
    await port.close()
    await port.close()
    assert not port.send(B, PriorityClass.BULK, b"x")
