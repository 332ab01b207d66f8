"""What came in during one turn of the loop is sent on once, over the datagram lanes first."""

import asyncio
from typing import Any

from sern_core.vocabulary.types import ClientName
from sern_relay.transports import Transports

ROBOT = ClientName("robot1")


class Part:
    """A lane server of any kind; it says when it was to send."""

    def __init__(self, name: str, flushed: list[str], address: str = "") -> None:
        self.name = name
        self.flushed = flushed
        self.at = address

    def flush(self) -> None:
        self.flushed.append(self.name)

    def address(self, _client: ClientName) -> str:
        return self.at


def complete() -> tuple[Any, list[str]]:
    """Transports with all parts, and which of these were flushed."""
    transports: Any = Transports()
    flushed: list[str] = []
    for name in ("server", "fabric", "lanes"):
        setattr(transports, name, Part(name, flushed, f"from {name}"))
    return transports, flushed


async def test_all_that_comes_in_at_once_is_sent_on_once_and_datagram_lanes_go_first() -> None:
    transports, flushed = complete()
    for _ in range(3):
        transports.after()
    assert flushed == [], "whoever comes next in this turn may have more"
    await asyncio.sleep(0)
    assert flushed == ["lanes", "server", "fabric"]
    transports.after()
    await asyncio.sleep(0)
    assert len(flushed) == 6, "what comes later is due anew"


async def test_nothing_is_sent_after_the_end() -> None:
    transports, flushed = complete()
    transports.after()
    transports.cancel()
    await asyncio.sleep(0)
    assert flushed == []


async def test_a_relay_that_has_yet_to_start_knows_of_no_connections() -> None:
    transports = Transports()
    transports.after()
    await asyncio.sleep(0)
    assert (transports.address(ROBOT), transports.session_key(ROBOT)) == ("", None)
    assert (dict(transports.reached()), transports.fabric_counters) == ({}, None)


def test_a_client_is_where_its_tcp_connection_comes_from_and_else_its_datagrams() -> None:
    transports, _flushed = complete()
    assert transports.address(ROBOT) == "from server"
    transports.server.at = ""
    assert transports.address(ROBOT) == "from lanes"
