"""What a relay tells over HTTP: each client with its state, and large answers a row at a time."""

import json
from typing import Any

from sern_core.vocabulary.types import ClientName
from sern_relay.admission import Admission
from sern_relay.clients_view import ClientsSource, client_row
from sern_relay.comings import Comings
from sern_relay.refusals import Refusals
from sern_relay.views import RelayViews
from sern_runtime.events import EventLog
from sern_runtime.http_routes import JsonParts
from tests.fabric_world import FabricWorld
from tests.world import SimHub, World, spec


class Relay:
    """The views of a simulated relay."""

    def __init__(self, world: World, node: SimHub | None = None) -> None:
        self.events = EventLog()
        self.comings = Comings(self.events, remembered=lambda _client: True)
        self.refusals = Refusals(self.events)
        self.hub = (node or world.relay).hub
        self.admission = Admission(None)
        self.views = RelayViews(
            self.hub.name,
            self.hub,
            self.comings,
            self.refusals,
            self.events,
            self.admission,
            lambda _client: "192.0.2.1:4",
        )

    def pieces(self, path: str) -> list[str]:
        source = self.views.routes(None)[path]
        assert callable(source)
        parts = source()
        assert isinstance(parts, JsonParts)
        return list(parts.pieces)

    def answer(self, path: str) -> Any:
        return json.loads("".join(self.pieces(path)))

    def state(self, client: str) -> str:
        source = ClientsSource(
            "relay", self.hub, self.comings, self.refusals, self.admission, lambda _client: "192.0.2.1:4"
        )
        return str(client_row(source, ClientName(client))["state"])


def test_a_large_answer_is_made_a_row_at_a_time_and_is_what_the_summary_has() -> None:
    world = World()
    robot, site = world.client("robot"), world.client("site")
    site.subscribe(".*")
    for number in range(300):
        robot.publish(f"/robot/t{number}", spec())
    world.run(2.0)
    relay = Relay(world)
    pieces = relay.pieces("/api/topics")
    assert len(pieces) > 600  # one a row: announced, and to the site
    assert max(map(len, pieces)) < 1000
    told = json.loads("".join(pieces))
    assert told["links"] == relay.views.topics()["links"]
    assert told["announced"] == relay.views.topics()["announced"]
    assert told["links"]["site"]["/robot/t7"]["answered"] is True
    assert told["announced"]["/robot/t7"] == {"class": "state", "taken": True, "owners": ["robot"], "latched": False}


def test_every_client_has_one_row() -> None:
    world = World()
    for number in range(40):
        world.client(f"robot{number}")
    world.run(2.0)
    relay = Relay(world)
    relay.refusals.note("198.51.100.9", "KEY", "unknown key")
    pieces = relay.pieces("/api/clients")
    assert len(pieces) > 40 and max(map(len, pieces)) < 1000
    told = json.loads("".join(pieces))
    assert {row["name"] for row in told["clients"]} == {f"robot{number}" for number in range(40)}
    row = told["clients"][0]
    assert (row["state"], row["address"]) == ("connected", "192.0.2.1:4")
    assert row["received_bytes"] > 0 < row["sent_bytes"]
    assert told["refused"][0]["why"] == "unknown key"
    assert len(relay.answer("/api/link")) == 40


def test_a_client_goes_through_its_states() -> None:
    world = World()
    world.client("robot")
    relay = Relay(world)
    assert relay.state("other") == "never"
    world.run(2.0)
    relay.comings.up(ClientName("robot"), resumed=False)
    assert relay.state("robot") == "connected"
    link = relay.hub.links[ClientName("robot")]
    link.disconnected(now=world.now)
    relay.comings.down(ClientName("robot"), "its connection is gone")
    assert relay.state("robot") == "away"
    relay.comings.look({}, world.now)
    assert relay.state("robot") == "forgotten"


def test_topics_and_clients_of_other_relays_are_told_with_their_relay() -> None:
    world = FabricWorld(["a", "b"])
    robot = world.client_at("a", "robot")
    world.client_at("b", "site", patterns=["/robot/odom"])
    for number in range(300):
        robot.publish(f"/robot/t{number}", spec())
    robot.publish("/robot/odom", spec())
    robot.publish("/robot/map", spec(latched=True))
    world.run(3.0)
    relay = Relay(world, world.relays["b"])
    pieces = relay.pieces("/api/topics")
    assert len(pieces) > 600 and max(map(len, pieces)) < 1000
    told = json.loads("".join(pieces))
    row = {"class": "state", "taken": True, "owners": ["robot"], "latched": False, "relays": ["a"]}
    assert told["announced"] == {"/robot/odom": row}
    assert told["elsewhere"]["/robot/t7"] == row | {"taken": False}
    assert told["elsewhere"]["/robot/map"] == row | {"taken": False, "latched": True}
    assert len(told["elsewhere"]) == 301
    rows = {row["name"]: row for row in relay.answer("/api/clients")["clients"]}
    assert (rows["robot"]["state"], rows["robot"]["relay"]) == ("at a", "a")
    assert (rows["site"]["state"], rows["site"]["relay"]) == ("connected", "b")
    assert "elsewhere" not in Relay(world).answer("/api/topics")
