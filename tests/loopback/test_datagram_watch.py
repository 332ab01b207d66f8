"""A datagram lane that was wanted and does not come up is named in the logs of both sides once, as is its return."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from sern_client.daemon import ClientDaemon
from sern_relay.daemon import RelayDaemon
from sern_runtime import datagram_watch
from sern_tools.ports import free_ports
from tests.between import INSIDE, Nat
from tests.daemons import HOST, Lab
from tests.support import until

PATIENCE_S = 0.4


def lane_up(text: str) -> dict[str, float]:
    """The metric's values by peer, of a text of metrics."""
    (family,) = (one for one in text_string_to_metric_families(text) if one.name == "sern_datagram_lane_up")
    return {sample.labels["peer"]: sample.value for sample in family.samples}


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(datagram_watch, "PATIENCE_S", PATIENCE_S)


def said(caplog: pytest.LogCaptureFixture, words: str) -> list[str]:
    return [record.getMessage() for record in caplog.records if words in record.getMessage()]


def scraped(daemon: RelayDaemon | ClientDaemon) -> dict[str, float]:
    server = daemon._http
    assert server is not None
    return lane_up(generate_latest(server._registry).decode())


@asynccontextmanager
async def behind_nat(tmp_path: Path, *, answers: bool = True) -> AsyncIterator[tuple[Lab, Nat, RelayDaemon]]:
    """A relay, and a NAT that swallows what it answers by datagram unless `answers`."""
    (port,) = free_ports(1)
    nat = Nat(port, answers=answers)
    async with Lab(tmp_path, "robot1", relay_port=port) as lab:
        try:
            relay = await lab.relay()
            await nat.start()
            yield lab, nat, relay
        finally:
            await nat.close()


async def connected(lab: Lab, nat: Nat) -> ClientDaemon:
    there = {"endpoint": f"tcp://{INSIDE}:{nat.port}"}
    return await lab.connected(lab.client_file("robot1", {"kind": "synthetic", "role": "robot"}, relay=there))


async def test_blocked_datagrams_are_named_on_both_sides_and_so_is_their_return(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    async with behind_nat(tmp_path) as (lab, nat, relay):
        nat.block()
        robot = await connected(lab, nat)
        within = f"in {PATIENCE_S:g} s; using TCP; open"
        ours = f"robot1: no datagram came through from {INSIDE}:{nat.port}/udp {within} UDP"
        theirs = f"robot1: no datagram came through from it to {nat.port}/udp here {within}"
        await until(lambda: said(caplog, ours) and said(caplog, theirs), "both sides say what is blocked")
        assert scraped(robot) == {"relay": 0.0}
        assert scraped(relay) == {"robot1": 0.0}
        for _ in range(3):
            relay.datagrams.tick()
            robot.connection.datagrams.tick()
        await nat.rebind("127.0.0.3")
        back = "robot1: datagrams pass now"
        await until(lambda: len(said(caplog, back)) == 2, "both sides say that it is up")
        assert (len(said(caplog, ours)), len(said(caplog, theirs))) == (1, 1)
        # Each says it when it looks, the one up to a second after the other.
        await until(lambda: scraped(robot) == {"relay": 1.0} and scraped(relay) == {"robot1": 1.0}, "both tell of it")
        await lab.end(robot)
        await lab.end(relay)


async def test_datagrams_that_stop_in_a_session_are_named_on_both_sides_and_so_is_their_return(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    async with behind_nat(tmp_path) as (lab, nat, relay):
        robot = await connected(lab, nat)
        await until(lambda: scraped(robot) == {"relay": 1.0} and scraped(relay) == {"robot1": 1.0}, "datagrams pass")
        for watched in (relay.datagrams, robot.connection.datagrams):
            watched.tick()  # it has seen that they pass
        caplog.clear()  # and has said so, if that took longer than its short patience here
        nat.block()
        stopped = f"robot1: {datagram_watch.STOPPED}"
        await until(lambda: len(said(caplog, stopped)) == 2, "both sides say that none passes any more")
        await nat.rebind("127.0.0.3")
        back = "robot1: datagrams pass now"
        await until(lambda: len(said(caplog, back)) == 2, "both sides say that they pass")
        lines = [line for line in caplog.messages if "datagram" in line]
        assert lines == [*said(caplog, stopped), *said(caplog, back)]


async def test_answers_that_are_lost_are_told_from_datagrams_that_do_not_come(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Datagrams reach the relay, and what it answers is swallowed: each side says what it sees."""
    async with behind_nat(tmp_path, answers=False) as (lab, nat, _relay):
        await connected(lab, nat)
        ours = f"robot1: no datagram came through from {INSIDE}:{nat.port}/udp"
        theirs = "robot1: datagrams come through from it (127.0.0.3), and it has confirmed none of ours"
        await until(lambda: said(caplog, ours) and said(caplog, theirs), "both sides say what they see")
        assert not said(caplog, "datagrams pass now")


@pytest.mark.parametrize("off", ["relay", "client"])
async def test_a_lane_that_is_switched_off(tmp_path: Path, caplog: pytest.LogCaptureFixture, off: str) -> None:
    """At the relay: the client says that it was offered none. At the client: nobody misses anything."""
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay(lab.relay_file(relay={"udp": off != "relay"}))
        unwanted = {"udp": off != "client"}
        robot = await lab.connected(lab.client_file("robot1", {"kind": "synthetic", "role": "robot"}, relay=unwanted))
        words = f"robot1: the relay at {HOST} has offered no datagram lane"
        if off == "relay":
            await until(lambda: said(caplog, words), "the client says so")
            assert scraped(robot) == {"relay": 0.0}
        else:
            await until(lambda: robot.connection.datagrams._without_since_s, "the client looks")
            robot.connection.datagrams._without_since_s["relay"] -= PATIENCE_S
            robot.connection.datagrams.tick()
            assert not said(caplog, "datagram")
            assert scraped(robot) == {}
        relay.datagrams.tick()
        assert scraped(relay) == {}
