"""How often a name that does not resolve is asked for and told of, on a clock of the test's own."""

import asyncio
from itertools import pairwise

import pytest

from sern_client import relay_name
from sern_client.relay_name import ASK_AGAIN_S, RelayName, UnresolvedError
from sern_runtime import clock

TICK_S = 0.5
HOURS = 2 * 3600


class World:
    """The clock, and a resolver that knows the name from `resolves_s` on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.resolves_s = float("inf")
        self.address = "192.0.2.1"
        self.asked: list[float] = []
        monkeypatch.setattr(clock, "now", lambda: self.now)
        monkeypatch.setattr(relay_name, "resolve", self._resolve)
        self.name = RelayName("tcp://relay.example:5555", "relay.example", 5555)

    async def _resolve(self, host: str, port: int) -> str:
        assert (host, port) == ("relay.example", 5555)
        self.asked.append(self.now)
        if self.now < self.resolves_s:
            raise UnresolvedError("name or service not known")
        return self.address

    async def run(self, until_s: float, *, connected: bool = False) -> None:
        """Tick as the daemon does. A look-up that is due has its answer before the next tick."""
        while self.now < until_s:
            self.name.tick(connected=connected)
            await asyncio.sleep(0)
            self.now += TICK_S


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def said_s(caplog: pytest.LogCaptureFixture) -> list[str]:
    """How long the name had not resolved, as each line has it; the first line has no time."""
    told = [message.partition("known")[2] for message in caplog.messages if "does not resolve" in message]
    return [text.removeprefix(", for ").removesuffix(" s now") for text in told]


async def test_it_is_said_ever_more_seldom(world: World, caplog: pytest.LogCaptureFixture) -> None:
    await world.run(HOURS)
    pauses_s = (10, 20, 40, 80, 160, 320, 600, 600, 600)
    times_s = [sum(pauses_s[: index + 1]) for index in range(len(pauses_s))]
    said = said_s(caplog)
    assert said[0] == "; trying again until it does"
    assert said[1:10] == [str(time_s) for time_s in times_s]
    assert {int(after) - int(before) for before, after in pairwise(said[7:])} == {600}
    assert {record.levelname for record in caplog.records} == {"WARNING"}


async def test_it_is_asked_every_five_seconds(world: World) -> None:
    await world.run(60)
    assert ASK_AGAIN_S == 5.0
    assert world.asked == [5.0 * number for number in range(12)]


async def test_a_name_that_failed_before_begins_anew(world: World, caplog: pytest.LogCaptureFixture) -> None:
    world.resolves_s = 100.0
    await world.run(200)
    assert world.name.problem is None
    assert caplog.messages[-1] == "tcp://relay.example:5555: relay.example resolves again, to 192.0.2.1, after 100 s"
    caplog.clear()
    world.resolves_s = float("inf")
    await world.run(240)
    assert said_s(caplog) == ["; trying again until it does", "10", "30"]


async def test_a_relay_that_answers_is_not_looked_up(world: World, caplog: pytest.LogCaptureFixture) -> None:
    await world.run(60, connected=True)
    assert world.asked == [] and caplog.messages == []
    await world.run(66)
    await world.run(120, connected=True)  # a connection says that it resolves, whoever found the address
    assert world.name.problem is None
    assert caplog.messages[-1].endswith("relay.example resolves again, after 6 s")


async def test_where_it_leads_is_said_once_and_when_it_changes(world: World, caplog: pytest.LogCaptureFixture) -> None:
    """A hotel's network, for one, answers every name with its own address."""
    caplog.set_level("INFO")
    world.resolves_s = 0.0
    await world.run(30)
    assert world.name.at == "relay.example is 192.0.2.1"
    world.address = "10.0.0.1"
    await world.run(60)
    assert world.name.at == "relay.example is 10.0.0.1"
    world.resolves_s = float("inf")
    await world.run(70)
    assert world.name.at == ""
    world.resolves_s = 0.0
    await world.run(80)
    await world.run(90, connected=True)
    world.address = "192.0.2.1"
    await world.run(100)
    said = [
        (record.levelname, record.getMessage().removeprefix("tcp://relay.example:5555: ")) for record in caplog.records
    ]
    assert said == [
        ("INFO", "relay.example is 192.0.2.1"),
        ("WARNING", "relay.example is 10.0.0.1 now, and was 192.0.2.1"),
        (
            "WARNING",
            "the relay's name relay.example does not resolve: name or service not known; trying again until it does",
        ),
        ("WARNING", "relay.example resolves again, to 10.0.0.1, after 10 s"),
        ("WARNING", "relay.example is 192.0.2.1 now, and was 10.0.0.1"),
    ]
