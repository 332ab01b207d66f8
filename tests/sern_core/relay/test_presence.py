"""What a relay tells a client of the others: whom it may ask of, when, and how much at once."""

from collections.abc import Callable

import pytest

from sern_core.link.view import LinkView
from sern_core.relay.presence import BACK_PAUSE_S, MAX_TOLD, Presence
from sern_core.vocabulary.limits import LIMITS, PeerLimits
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_core.wire.announce import MAX_ASKED
from tests.views import IDLE


class Told:
    """A client's link, as far as `Presence` looks at it."""

    established = True
    moved = False
    acked_seq = 1_000_000

    def __init__(self) -> None:
        self.items: list[framing.Envelope] = []
        self.control = self

    def observe(self, *, now: float) -> LinkView:
        return IDLE

    def send(self, envelope: framing.Envelope, attachment: bytes = b"", *, now: float) -> int:
        self.items += envelope["peers"]
        return 0


def asking(
    matching: set[ClientName], *others: str, told_at_once: int = LIMITS.told_at_once
) -> tuple[Presence, Told, dict[ClientName, Told]]:
    def attempt(_client: ClientName, _now: float, call: Callable[[], object]) -> None:
        call()

    site = Told()
    links = {ClientName(name): Told() for name in others} | {ClientName("site"): site}
    limits = PeerLimits(told_at_once=told_at_once)
    presence = Presence(links, set(), matching, attempt, lambda: None, limits, home=lambda _client: None)
    presence.watch(ClientName("site"), now=0.0)
    return presence, site, links


def test_a_client_is_told_who_is_here_once_it_is_known_what_it_takes() -> None:
    """Before, a robot would be taken for one that is given up, and not for one that is waited for."""
    matching = {ClientName("site")}
    presence, site, links = asking(matching, "there")
    presence.ask(ClientName("site"), map(ClientName, ("taken", "there", "away")))
    presence.sweep(now=1.0)
    assert site.items == []
    presence.joined(ClientName("taken"), ClientName("site"))
    matching.clear()
    presence.sweep(now=2.0)
    assert site.items == [
        {"name": "away", "here": False},
        {"name": "taken", "up": False, "for": 0.0},
    ]
    presence.sweep(now=2.0 + BACK_PAUSE_S - 0.1)
    assert len(site.items) == 2
    presence.sweep(now=2.0 + BACK_PAUSE_S)
    assert site.items[2:] == [{"name": "there", "here": True}]
    links[ClientName("away")] = Told()
    presence.changed(ClientName("away"), now=10.0)
    links[ClientName("away")].established = False
    presence.changed(ClientName("away"), now=11.0)
    presence.sweep(now=20.0)
    assert len(site.items) == 3
    links[ClientName("away")].established = True
    presence.changed(ClientName("away"), now=20.0)
    presence.sweep(now=20.0 + BACK_PAUSE_S)
    assert site.items[3:] == [{"name": "away", "here": True}]
    presence.changed(ClientName("away"), now=30.0)
    presence.sweep(now=30.0 + BACK_PAUSE_S)
    assert len(site.items) == 4


@pytest.mark.parametrize("asked", [True, False])
def test_who_is_back_has_some_time_to_say_what_it_has(asked: bool) -> None:
    presence, site, links = asking(set())
    peer = ClientName("away")
    presence.ask(ClientName("site"), [peer])
    if asked:
        links[peer] = Told()
        presence.sweep(now=1.0)
        assert site.items == []
    else:
        presence.sweep(now=1.0)
        links[peer] = Told()
        presence.changed(peer, now=1.0)
        assert site.items == [{"name": "away", "here": False}]
    presence.joined(peer, ClientName("site"))
    for second in range(2, 20):
        presence.sweep(now=float(second))
    assert [item.get("up") for item in site.items] == ([True] if asked else [None, True])


def test_there_is_an_end_to_those_of_whom_a_client_may_ask() -> None:
    presence, site, _links = asking(set())
    for _ in range(2):
        presence.ask(ClientName("site"), [ClientName(f"c{number}") for number in range(MAX_ASKED + 7)])
    presence.sweep(now=1.0)
    assert len(site.items) == MAX_ASKED
    presence.ask(ClientName("site"), [ClientName("new")])
    presence.sweep(now=2.0)
    assert len(site.items) == MAX_ASKED + 1 and len(presence._watchers[ClientName("site")].missing) == MAX_ASKED


def test_what_many_clients_are_told_takes_many_turns() -> None:
    """A relay that begins anew is asked by all of them at once."""
    presence, _site, links = asking(set(), *(f"s{number}" for number in range(4)), told_at_once=4)
    for name in links:
        presence.watch(name, now=0.0)
        presence.ask(name, [ClientName(f"c{number}") for number in range(2 * MAX_TOLD)])
    presence.sweep(now=1.0)
    told = [sum(len(link.items) for link in links.values()) // MAX_TOLD]
    while presence.tell(now=1.0):
        told.append(sum(len(link.items) for link in links.values()) // MAX_TOLD)
    assert told == [4, 8] and all(len(link.items) == 2 * MAX_TOLD for link in links.values())


def test_a_relay_is_believed_for_the_clients_that_are_at_it_and_for_no_others() -> None:
    site = Told()
    here, there, other = map(ClientName, ("site", "@a", "@b"))
    links = {here: site, there: Told(), other: Told()}

    def attempt(_client: ClientName, _now: float, call: Callable[[], object]) -> None:
        call()

    presence = Presence(links, set(), set(), attempt, lambda: None, PeerLimits(), home=lambda _client: there)
    presence.joined(ClientName("robot"), here)
    presence.watch(here, now=0.0)
    gone: framing.Envelope = {"peers": [{"name": "robot", "up": False, "for": 3.0}]}
    presence.told(other, gone, now=1.0)
    assert [item["up"] for item in site.items] == [True]
    presence.told(there, gone, now=2.0)
    assert [(item["up"], item["for"]) for item in site.items[1:]] == [(False, 3.0)]
    for untrue in ({"name": "robot", "up": True}, {"name": "robot", "here": True}):
        presence.told(other, {"peers": [untrue]}, now=3.0)
    presence.sweep(now=4.0)
    assert [item["up"] for item in site.items] == [True, False]
