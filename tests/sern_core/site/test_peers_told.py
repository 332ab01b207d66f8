"""What a client takes from a relay about the others, for how long it keeps it, and of whom it asks."""

from collections import Counter

import pytest

from sern_core.site.peers import LET_GO_S, MAX_ENDED, MAX_GIVEN_UP, MAX_PEERS, PeerChange, Peers, PeerStatus
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import ClientName, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import MAX_ASKED
from tests.views import peers, statuses
from tests.world import World

CONNECTED, GONE, UNKNOWN = PeerStatus.CONNECTED, PeerStatus.GONE, PeerStatus.UNKNOWN


# --- what a relay may say ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "item",
    [
        {"up": True, "for": 1.0},
        {"name": 7},
        {"name": "a", "up": 1, "for": 1.0},
        {"name": "a", "up": True, "for": -1.0},
        {"name": "a", "up": True, "for": 1.0, "rtt": "x"},
        {"name": "a", "up": True, "for": 1.0, "lane": "x" * 17},
        {"name": "a", "here": 1},
    ],
)
def test_what_no_relay_says_is_refused(item: framing.Envelope) -> None:
    with pytest.raises(WireError):
        Peers().told({"t": "peers", "peers": [item]}, now=0.0)


@pytest.mark.parametrize("items", [7, {"name": "a"}, ["a"]])
def test_peers_are_a_list_of_maps(items: object) -> None:
    with pytest.raises(WireError, match="list of maps"):
        Peers().told({"t": "peers", "peers": items}, now=0.0)


def test_there_is_an_end_to_the_peers_that_a_relay_may_tell_of() -> None:
    known = Peers()
    known.session_began(now=0.0)
    for number in range(MAX_PEERS):
        known.told({"t": "peers", "peers": [{"name": f"c{number}", "up": True, "for": 0.0}]}, now=0.0)
    with pytest.raises(WireError, match="more than"):
        known.told({"t": "peers", "peers": [{"name": "one_more", "up": True, "for": 0.0}]}, now=0.0)
    assert Counter(view.status for view in known.look(now=1.0)) == {CONNECTED: MAX_PEERS}


def test_who_was_given_up_longest_ago_makes_way() -> None:
    known = Peers()
    known.session_began(now=0.0)

    def tell(name: str, **said: object) -> None:
        known.told({"t": "peers", "peers": [{"name": name, **said}]}, now=0.0)

    for number in range(MAX_PEERS):
        tell(f"c{number}", up=False, **{"for": 0.0})
    for name in ("c7", "c5"):
        tell(name)
    known.arrived(ClientName("c7"), now=0.0)
    tell("new1", up=True, **{"for": 0.0})
    names = {view.name for view in known.look(now=1.0)}
    assert "c7" not in names and {"c5", "new1"} <= names
    tell("new2", up=True, **{"for": 0.0})
    assert {view.name for view in known.look(now=1.0)} & {"c5", "c7"} == set()
    assert known._heard_s == {}
    with pytest.raises(WireError, match="more than"):
        tell("new3", up=True, **{"for": 0.0})


def test_of_many_that_were_given_up_the_last_are_shown() -> None:
    known = Peers()
    known.session_began(now=0.0)
    for number in range(MAX_GIVEN_UP + 3):
        known.told({"t": "peers", "peers": [{"name": f"c{number}", "up": False, "for": 0.0}]}, now=0.0)
    for number in range(MAX_GIVEN_UP + 3):
        known.told({"t": "peers", "peers": [{"name": f"c{number}"}]}, now=0.0)
    assert {view.name for view in known.look(now=1.0)} == {f"c{number}" for number in range(3, MAX_GIVEN_UP + 3)}


def test_who_makes_way_while_others_are_given_up_is_not_looked_at_again() -> None:
    """The relay has told of the first of them, and its next message does not come in time."""
    known = Peers()

    def tell(now: float, **item: object) -> None:
        known.told({"t": "peers", "peers": [item]}, now=now)

    known.subscribed(("/.*",), now=0.0)
    known.session_began(now=0.0)
    tell(0.0, name="a", up=True)
    names = [f"r{number:03d}" for number in range(MAX_GIVEN_UP)]
    for name in names:
        tell(1.0, name=name, up=False)
        tell(2.0, name=name, here=False)
    known.session_ended(now=3.0)
    known.session_began(now=4.0)
    tell(5.0, name="a", here=False)
    assert [view.name for view in known.look(now=6.0 + LET_GO_S)] == ["a"]


@pytest.mark.parametrize("says", [{}, {"here": False}])
def test_who_was_not_here_is_given_up_and_forgotten_in_a_session_that_says_nothing_of_it(
    says: framing.Envelope,
) -> None:
    """Also by a relay of an earlier version, which does not say whether a client is here."""
    known = Peers()
    known.session_began(now=0.0)
    known.told({"t": "peers", "peers": [{"name": "a", "up": False, "for": 0.0}]}, now=0.0)
    known.told({"t": "peers", "peers": [{"name": "a"} | says]}, now=0.0)
    known.session_ended(now=10.0)
    assert [view.status for view in known.look(now=10.0)] == [UNKNOWN]
    known.session_began(now=20.0)
    assert known.asked() == ["a"]
    (view,) = known.look(now=20.0 + LET_GO_S)
    assert (view.status, view.given_up) == (UNKNOWN, True)
    changes: list[PeerChange] = []
    known.on_change = changes.append
    assert known.look(now=21.0 + LET_GO_S) == [] and known.asked() == []
    assert [(change.name, change.forgotten) for change in changes] == [("a", True)]


def test_who_is_gone_and_still_has_streams_here_when_it_is_back_without_them_is_forgotten_with_the_last() -> None:
    known = Peers()
    known.session_began(now=0.0)
    known.opened(ClientName("a"), now=0.0)
    known.told({"t": "peers", "peers": [{"name": "a", "up": False, "for": 0.0}]}, now=0.0)
    known.told({"t": "peers", "peers": [{"name": "a", "here": True}]}, now=1.0)
    known.reached(True, now=1.0)
    assert [(view.name, view.status) for view in known.look(now=2.0 + LET_GO_S)] == [("a", UNKNOWN)]
    known.closed(ClientName("a"), TopicName("/a/odom"), now=2.0)
    assert known.look(now=2.0 + LET_GO_S) == []


def test_topics_that_ended_are_remembered_up_to_a_limit_and_while_their_origin_is_gone() -> None:
    known = Peers()
    known.session_began(now=0.0)
    name = ClientName("a")
    known.told({"t": "peers", "peers": [{"name": name, "up": False, "for": 0.0}]}, now=0.0)
    for number in range(MAX_ENDED + 3):
        known.opened(name, now=0.0)
        known.closed(name, TopicName(f"/a/t{number}"), now=0.0)
    assert list(known._ended[name]) == [f"/a/t{number}" for number in range(3, MAX_ENDED + 3)]
    known.subscribed(("/(a*",), now=0.0)
    known.told({"t": "peers", "peers": [{"name": name, "here": False}]}, now=0.0)
    assert known.look(now=0.0)[0].given_up  # the relay takes no such patterns
    known.told({"t": "peers", "peers": [{"name": name, "up": True, "for": 0.0}]}, now=0.0)
    assert known._ended == {}


# --- what a client may ask --------------------------------------------------------------------------------------------


def test_a_client_asks_of_the_last_of_many() -> None:
    known = Peers()
    known.session_began(now=0.0)
    for number in range(MAX_ASKED + 5):
        known.told({"t": "peers", "peers": [{"name": f"c{number}", "up": False, "for": 0.0}]}, now=0.0)
    known.told({"t": "peers", "peers": [{"name": "c0", "here": False}]}, now=0.0)
    assert known.asked() == [*(f"c{number}" for number in range(6, MAX_ASKED + 5)), "c0"]


@pytest.mark.interpreted
def test_of_what_is_no_name_of_a_client_nothing_is_said() -> None:
    """The name as it came may be too long to be said: what is bounded in it is its characters."""
    world = World().watch()
    asking = world.client("asking")
    world.run(1.0)
    told: list[framing.Envelope] = []

    def note(envelope: framing.Envelope, *, now: float) -> None:
        told.append(envelope)

    asking.core.peers.told = note  # type: ignore[method-assign]
    for start in (0, 12):
        names = ["robot", *(chr(0x10000 + start + number) * 64 for number in range(12))]
        envelope = {"t": "subscribe", "patterns": [], "more": start == 0, "peers": True, "known": names}
        asking.core.link.control.send(envelope, now=asking.now)
    world.run(3.0)
    assert [item for envelope in told for item in envelope["peers"]] == [{"name": "robot", "here": False}]
    world.check_faults()


def test_many_lost_robots_are_asked_of_in_parts() -> None:
    world = World().watch()
    site = world.client("site", patterns=["/.*"])
    world.run(1.0)
    names = [f"r{number:03d}" + "x" * 59 for number in range(MAX_ASKED)]
    for name in names:
        site.core.peers.told({"t": "peers", "peers": [{"name": name, "up": False, "for": 0.0}]}, now=site.now)
    world.hops["site"].break_connection(reconnect_s=1.0)
    world.until(lambda: statuses(site)[names[0]] is UNKNOWN)
    world.until(lambda: sum(view.given_up for view in peers(site).values()) == MAX_GIVEN_UP, within_s=10.0)
    world.validate()
