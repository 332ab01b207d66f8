"""Relays at a router that reads, alters, repeats and makes up what it likes: a zenoh router, and what it can do."""

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509

from sern_core.vocabulary.types import CLASSES, ClientName, PriorityClass
from sern_core.wire.framing import MAX_DATAGRAM_BYTES
from sern_runtime.fabric import keys
from sern_runtime.fabric.identity import Identity
from sern_runtime.fabric.meeting import Kind
from sern_runtime.fabric.port import FabricDrop, PeerRelay
from sern_runtime.fabric.sealed_port import BOOTS, SealedPort, port_of
from sern_runtime.fabric.zenoh_port import ZenohPort
from sern_tools.ports import free_ports
from tests.sern_runtime.fabric.relays import (
    BOOT,
    A,
    B,
    C,
    Relay,
    Told,
    chain,
    external_router,
    files,
    options,
    running,
)
from tests.sern_runtime.fabric.test_zenoh_port import meet, send_until
from tests.support import until

zenoh = pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")

SECRET = b"nobody else is to read this"
SEALED = (FabricDrop.UNSEALED, FabricDrop.BAD_SEAL, FabricDrop.BAD_CARD)


class Router:
    """What a hostile router has seen, and what it says."""

    def __init__(self, session: Any, port: int) -> None:
        self.session = session
        self.port = port
        self.seen: list[tuple[str, bytes]] = []
        self._tap = session.declare_subscriber(f"{keys.ROOT}/h/**", self._see)

    def _see(self, sample: Any) -> None:
        self.seen.append((str(sample.key_expr), sample.payload.to_bytes()))

    def of(self, source: ClientName, destination: ClientName) -> list[bytes]:
        return [body for key, body in list(self.seen) if key.startswith(f"{keys.ROOT}/h/{destination}/{source}/")]

    def say(self, source: ClientName, destination: ClientName, body: bytes) -> None:
        key = keys.hop_key(destination, source, PriorityClass.CONTROL)
        self.session.put(key, body, congestion_control=zenoh.CongestionControl.BLOCK)

    def token(self, relay: PeerRelay) -> Any:
        return self.session.liveliness().declare_token(keys.relay_token(relay))


@asynccontextmanager
async def at_a_router(certificates: Path, **more: Any) -> AsyncIterator[tuple[Router, Relay, Relay]]:
    """A and B, which have met, at a router that has the certificate of C."""
    (port,) = free_ports(1)
    with external_router(port, files(certificates, C)) as session:
        router = Router(session, port)
        chosen = [
            options(name, connect=[port], external=True, certificates=files(certificates, name), **more)
            for name in (A, B)
        ]
        async with running(*chosen) as (a, b):
            await meet(a, b)
            yield router, a, b


def refused(relay: Relay) -> int:
    """What came and was not right. (`NO_PEER` is an offer that is here before the presence.)"""
    return sum(relay.port.counters.dropped[reason] for reason in SEALED)


async def refuses(relay: Relay, count: int) -> None:
    await until(lambda: refused(relay) >= count, f"{relay.name} has refused {count}")


def test_only_what_goes_through_external_routers_is_sealed(certificates: Path) -> None:
    own = files(certificates, A)
    assert isinstance(port_of(options(A, connect=[1], certificates=own, external=True), Told()), SealedPort)
    for chosen in (options(A, connect=[1], certificates=own), options(A, connect=[1], external=True), chain()[0]):
        assert isinstance(port_of(chosen, Told()), ZenohPort)


async def test_they_meet_send_and_part(certificates: Path) -> None:
    async with at_a_router(certificates, rules="c0ffee") as (_, a, b):
        assert a.told.peers[B] == PeerRelay(B, BOOT, options(B).wire_versions, "c0ffee")
        for priority in CLASSES:
            for size in (0, 1, 1171, MAX_DATAGRAM_BYTES):
                await send_until(a, b, bytes([int(priority)]) * size, priority)
        await send_until(b, a, b"answer", PriorityClass.CONTROL)
        assert (a.port.counters.peers_up, b.port.counters.peers_up) == (1, 1)
        assert not a.port.send(B, PriorityClass.BULK, bytes(MAX_DATAGRAM_BYTES + 1))
        assert a.port.counters.dropped[FabricDrop.TOO_LARGE] == 1
        await b.port.close()
        await a.until(lambda: not a.told.peers)
        assert a.port.counters.peers_up == 0 and not a.port.send(B, PriorityClass.BULK, b"late")
        assert [kind for kind, _ in a.told.news] == [kind for kind, _ in b.told.news] == ["up", "down"]
        assert a.port.counters.dropped[FabricDrop.BAD_SEAL] == b.port.counters.dropped[FabricDrop.BAD_SEAL] == 0


async def test_a_router_reads_nothing_and_brings_nothing_in(certificates: Path) -> None:
    async with at_a_router(certificates) as (router, a, b):
        for number in range(5):
            await send_until(a, b, SECRET + b"%d" % number, PriorityClass.CONTROL)
            await send_until(b, a, SECRET, PriorityClass.BULK)
        came = list(b.told.datagrams)
        kept = router.of(A, B)
        assert len(kept) >= 5 and not any(SECRET in body for _, body in router.seen)
        sealed = [body for body in kept if body[0] == Kind.SEALED]
        before = refused(b)
        forged = [
            *sealed,  # again
            *(body[:-1] + bytes((body[-1] ^ 1,)) for body in sealed),  # altered
            *(body for body in router.of(B, A) if body[0] == Kind.SEALED),  # its own, as if of A
            SECRET,  # in plain text
            bytes((Kind.SEALED,)) + SECRET * 10,
            b"",
        ]
        for body in forged:
            router.say(A, B, body)
            router.say(C, B, body)  # as if of another relay
        await refuses(b, before + 2 * len(forged))
        assert b.told.datagrams == came and set(b.told.peers) == {A}
        await send_until(a, b, b"goes on", PriorityClass.CONTROL)
        assert b.told.datagrams[len(came) :] == [(A, b"goes on")] * (len(b.told.datagrams) - len(came))


async def test_presence_that_a_router_makes_up_is_nobody(certificates: Path) -> None:
    """Of a relay that is not there, and of an older process of one that is, with all that it has ever said."""
    async with at_a_router(certificates) as (router, a, b):
        await send_until(a, b, b"kept", PriorityClass.CONTROL)
        kept = router.of(A, B)
        asked = len([body for body in router.of(B, A) if body[0] == Kind.ASK])
        old = router.token(PeerRelay(A, BOOT - 1, options(A).wire_versions, ""))
        nobody = router.token(PeerRelay(C, BOOT, options(C).wire_versions, ""))
        # B asks the one for an offer, and makes the other one: it has seen both.
        await until(lambda: len([body for body in router.of(B, A) if body[0] == Kind.ASK]) > asked, "it asks")
        await until(lambda: any(body[0] == Kind.OFFER for body in router.of(B, C)), "it makes an offer")
        before = refused(b)
        for body in kept:
            router.say(C, B, body)
        await refuses(b, before + len(kept))
        await send_until(a, b, b"goes on", PriorityClass.CONTROL)
        assert [what for kind, what in b.told.news if kind == "up"] == [options(A).itself]
        assert [kind for kind, _ in b.told.news] == ["up"]
        del old, nobody


async def test_a_relay_that_is_started_again_is_met_again(certificates: Path) -> None:
    async with at_a_router(certificates) as (router, a, b):
        await b.port.close()
        await a.until(lambda: not a.told.peers)
        chosen = options(B, connect=[router.port], external=True, certificates=files(certificates, B), boot=1)
        async with running(chosen) as (again,):
            await a.until(lambda: a.told.peers)
            assert a.told.peers[B].boot == 1
            await again.until(lambda: again.told.peers)
            await send_until(again, a, b"new", PriorityClass.STATE)
            await send_until(a, again, b"new", PriorityClass.STATE)


@pytest.mark.parametrize("case", ["foreign", "another's key"])
async def test_who_has_no_right_certificate_is_not_told_of(
    certificates: Path, foreign: Path, tmp_path: Path, case: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The router lets it in all the same: it is none that checks."""
    (port,) = free_ports(1)
    wrong = files(foreign, B) if case == "foreign" else files(certificates, B, key_of=C)
    with external_router(port):
        async with running_plain(port, (A, files(certificates, A)), (B, wrong)) as (a, b):
            await refuses(a if case != "foreign" else b, 1)
            assert not a.told.peers and not b.told.peers
            assert not a.port.send(B, PriorityClass.CONTROL, SECRET)
            assert a.port.counters.dropped[FabricDrop.NO_PEER] >= 1 and a.port.counters.peers_up == 0
            assert "is not let in: its" in caplog.text


@asynccontextmanager
async def running_plain(port: int, *who: Any, at_s: float | None = None) -> AsyncIterator[list[Relay]]:
    """Sealed, over connections that are not: what is tried here is not TLS. `at_s`: what their clocks say."""
    relays = []
    for name, own in who:
        chosen = options(name, connect=[port], external=True)
        relay = Relay(chosen)
        wall_s = time.time if at_s is None else partial(float, at_s)
        relay.port = SealedPort(chosen, relay.told, Identity.read(own), wall_s=wall_s)
        relays.append(relay)
    try:
        for relay in relays:
            await relay.port.start()
        yield relays
    finally:
        for relay in relays:
            await relay.port.close()


async def test_a_certificate_that_expires_ends_it(certificates: Path) -> None:
    """By the clock of A, which stands still a moment before the end: they meet again after it."""
    (port,) = free_ports(1)
    certificate = x509.load_pem_x509_certificate(files(certificates, B).certificate.read_bytes())
    before_s = certificate.not_valid_after_utc.timestamp() - 0.1
    with external_router(port):
        async with running_plain(port, (A, files(certificates, A)), (B, files(certificates, B)), at_s=before_s) as (
            a,
            _,
        ):
            await a.until(lambda: [kind for kind, _ in a.told.news][:3] == ["up", "down", "up"])


async def test_presence_is_bounded(certificates: Path) -> None:
    told = Told()
    chosen = options(A, connect=[1], external=True)
    port = SealedPort(chosen, told, Identity.read(files(certificates, A)), most_meetings=BOOTS)
    for boot in range(20):
        port.peer_up(PeerRelay(B, boot, (1, 1), ""))
    assert port.meetings == BOOTS
    port.peer_up(PeerRelay(C, 1, (1, 1), ""))
    assert port.meetings == BOOTS and port.counters.dropped[FabricDrop.NEWS_FULL] == 1
    for boot in range(20):
        port.peer_down(B, boot)
    assert port.meetings == 0 and not told.news
    await port.close()
