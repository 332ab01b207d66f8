"""Who may write what: a certificate lets a relay speak for itself alone, and lets nobody in who has none of ours."""

import asyncio
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_runtime.config.fabric import CertificateFiles
from sern_runtime.fabric import keys
from sern_runtime.fabric.port import PeerRelay
from sern_runtime.fabric.zenoh_settings import FabricOptions, settings
from sern_tools.ports import free_ports
from tests.sern_runtime.fabric.relays import BOOT, A, B, C, files, options, running
from tests.support import until

zenoh = pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")


@contextmanager
def stranger(chosen: FabricOptions) -> Iterator[Any]:
    """A session of somebody who has these files and keeps no rule of ours."""
    config = zenoh.Config()
    for key, value in settings(chosen).items():
        if key != "access_control":
            config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


def put(session: Any, destination: ClientName, source: ClientName, body: bytes) -> None:
    session.put(
        keys.hop_key(destination, source, PriorityClass.CONTROL), body, congestion_control=zenoh.CongestionControl.BLOCK
    )


async def test_a_relay_speaks_for_itself_alone(certificates: Path) -> None:
    """B has its own certificate, and tries to send, to be told and to be there as C."""
    (port,) = free_ports(1)
    mine, theirs = files(certificates, A), files(certificates, B)
    async with running(options(A, listen=port, certificates=mine)) as (a,):
        with stranger(options(B, connect=[port], certificates=theirs)) as session:
            heard: list[str] = []
            spied = session.declare_subscriber(f"{keys.ROOT}/**", lambda sample: heard.append(str(sample.key_expr)))
            inbox = session.declare_subscriber(keys.inbox(B), lambda sample: heard.append(str(sample.key_expr)))
            of_c = session.liveliness().declare_token(keys.relay_token(PeerRelay(C, 1, (1, 1), "")))
            # In the order in which they were said: what comes after all that has come, and nothing of it.
            own = session.liveliness().declare_token(keys.relay_token(PeerRelay(B, 1, (1, 1), "")))
            await a.until(lambda: a.told.peers)
            assert set(a.told.peers) == {B}
            put(session, A, C, b"as c")
            put(session, A, A, b"as the relay itself")
            session.put(
                f"{keys.ROOT}/h/{A}/{B}/0/x", b"no key of ours", congestion_control=zenoh.CongestionControl.BLOCK
            )
            put(session, A, B, b"as itself")
            await a.until(lambda: a.told.datagrams)
            assert a.told.datagrams == [(B, b"as itself")]
            assert not a.port.send(C, PriorityClass.CONTROL, b"for c")
            for_b = keys.hop_key(B, A, PriorityClass.CONTROL)
            await until(lambda: a.port.send(B, PriorityClass.CONTROL, b"for b") and for_b in heard)
            # It hears what is for it, and nothing that is for others.
            from_a = [key for key in heard if f"/{A}/" in key and f"/h/{A}/" not in key]
            assert set(from_a) == {keys.hop_key(B, A, PriorityClass.CONTROL)}
            del spied, inbox, of_c, own


@pytest.mark.parametrize("case", ["foreign authority", "another's key", "not named", "no certificate"])
async def test_who_has_no_right_certificate_is_nobody(certificates: Path, foreign: Path, case: str) -> None:
    """C is let in after the stranger has tried, and so it is known that the stranger was not."""
    (port,) = free_ports(1)
    chosen: dict[str, FabricOptions] = {
        "foreign authority": options(
            B, connect=[port], certificates=_replaced(files(foreign, B), ca=files(certificates, B).ca)
        ),
        "another's key": options(B, connect=[port], certificates=files(certificates, B, key_of=C)),
        "not named": options(B, connect=[port], certificates=files(certificates, B)),
        "no certificate": options(B, connect=[port]),
    }
    mine = options(A, listen=port, certificates=files(certificates, A), relays=(C,))
    if case in ("foreign authority", "another's key"):
        mine = options(A, listen=port, certificates=files(certificates, A))
    async with running(mine) as (a,):
        await _try(chosen[case])
        async with running(options(C, connect=[port], certificates=files(certificates, C))) as (c,):
            await c.until(lambda: c.told.peers)
            await a.until(lambda: a.told.peers)
            await until(lambda: c.port.send(A, PriorityClass.CONTROL, b"right") and a.told.datagrams)
        assert set(a.told.datagrams) == {(C, b"right")}
        assert {what.name for kind, what in a.told.news if isinstance(what, PeerRelay)} == {C}


def _replaced(found: CertificateFiles, *, ca: Path) -> CertificateFiles:
    return CertificateFiles(ca, found.certificate, found.key)


async def _try(chosen: FabricOptions) -> None:
    """Connect once, say what a relay says, and be gone, or fail to open."""

    def attempt() -> None:
        config = zenoh.Config()
        told = {**settings(chosen), "connect/timeout_ms": 1000, "connect/exit_on_failure": True}
        for key, value in told.items():
            if key != "access_control":
                config.insert_json5(key, json.dumps(value))
        try:
            session = zenoh.open(config)
        except zenoh.ZError:
            return
        with session:
            token = session.liveliness().declare_token(keys.relay_token(PeerRelay(B, BOOT, (1, 1), "")))
            put(session, A, B, b"wrong")
            token.undeclare()

    await asyncio.to_thread(attempt)
