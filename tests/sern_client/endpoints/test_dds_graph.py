"""The graph of a DDS domain as the endpoint keeps it: whose readers and writers are, and what nodes say."""

import logging
from dataclasses import replace
from typing import Any
from uuid import UUID

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from sern_client.endpoints.dds import node_info
from sern_client.endpoints.dds.graph import Graph, Local, Participant, Remote
from sern_client.endpoints.dds.names import RosName
from sern_client.endpoints.dds.qos import EndpointQos
from sern_core.types import TopicName
from tests.exploring import cases

STEADY = settings(max_examples=cases(100))


class Heard:
    def __init__(self) -> None:
        self.topics: list[str] = []
        self.services: list[str] = []

    def writers_changed(self, name: RosName, topic: str) -> None:
        self.topics.append(name.name)

    def services_changed(self, name: TopicName) -> None:
        self.services.append(name)


OWN, OTHER, SERN = (UUID(int=number) for number in (1, 2, 3))
STRING = "std_msgs::msg::dds_::String_"


def remote(number: int, participant: UUID = OTHER, topic: str = "rt/chat", **changed: Any) -> Remote:
    return replace(Remote(UUID(int=number), participant, True, topic, STRING, EndpointQos(), number), **changed)


@pytest.mark.parametrize("heed_sern", [False, True])
def test_the_graph_counts_what_is_of_this_site(heed_sern: bool) -> None:
    heard = Heard()
    graph = Graph(OWN, heard, heed_sern=heed_sern)
    graph.participant_added(Participant(OTHER, "robot"))
    graph.participant_added(Participant(SERN, "bridge", "sern_two"))
    for number, participant in ((10, OWN), (11, OTHER), (12, SERN)):
        graph.remote_added(remote(number, participant))
        graph.remote_added(remote(number, participant))
    graph.remote_added(remote(13, topic="not_ros"))
    graph.remote_added(remote(14, topic="rq/set_boolRequest", writer=False))
    found = [writer.handle for writer in graph.writers("rt/chat")]
    assert found == ([11, 12] if heed_sern else [11])
    assert graph.ignored == (set() if heed_sern else {12})
    assert heard.topics == ["/chat"] * len(found) and heard.services == ["/set_bool"]
    graph.participant_removed(SERN)
    graph.participant_removed(OTHER)
    assert graph.writers("rt/chat") == [] and graph.ignored == set() and graph.remotes == {}
    graph.remote_removed(UUID(int=99))


def test_mismatches_are_said_once_and_forgotten_with_their_cause(caplog: pytest.LogCaptureFixture) -> None:
    graph = Graph(OWN, Heard())
    graph.participant_added(Participant(OTHER, "robot"))
    graph.nodes_of(OTHER, [("/ns/talker", [UUID(int=11)])])
    with caplog.at_level(logging.WARNING):
        graph.remote_added(remote(11))
        graph.local_added(Local(UUID(int=20), False, "rt/chat", STRING, EndpointQos(reliable=True)))
        graph.remote_added(remote(12, type_name="std_msgs::msg::dds_::Int32_", qos=EndpointQos(reliable=True)))
        hashed = EndpointQos(reliable=True, type_hash="RIHS01_b")
        graph.local_added(Local(UUID(int=21), True, "rt/back", STRING, replace(hashed, type_hash="RIHS01_a")))
        graph.remote_added(remote(13, topic="rt/back", writer=False, qos=hashed))
    assert [record.message for record in caplog.records] == [
        "/chat: the publisher of node /ns/talker and we do not match: "
        "reliability (offered best_effort, asked for reliable)",
        f"/chat: the publisher of participant robot ({OTHER.hex[:24]}) and we do not match: "
        f"type (std_msgs::msg::dds_::Int32_ there, {STRING} here)",
        f"/back: the subscriber of participant robot ({OTHER.hex[:24]}) and we do not match: "
        "version of the type (RIHS01_b there, RIHS01_a here)",
    ]
    graph.remote_removed(UUID(int=11))
    graph.local_removed(UUID(int=21))
    assert len(graph.complaints) == 1


def test_node_information() -> None:
    body = node_info.encode(OWN, "sern", [UUID(int=5)], [UUID(int=6)])
    assert node_info.decode(body) == (OWN, [("/sern", [UUID(int=5), UUID(int=6)])])
    for length in range(len(body) - 4):
        assert node_info.decode(body[:length]) is None


def test_a_participant_that_says_later_that_it_is_of_sern_is_believed() -> None:
    """Discovery may tell of a writer before its participant, and a participant may change what it says of itself."""
    heard = Heard()
    graph = Graph(OWN, heard)
    graph.remote_added(remote(12, SERN))
    graph.remote_added(remote(13, SERN, writer=False, topic="rq/set_boolRequest"))
    assert [writer.handle for writer in graph.writers("rt/chat")] == [12]
    for round_ in range(2):
        graph.participant_added(Participant(SERN, "bridge", "sern_two"))
        assert graph.writers("rt/chat") == [] and graph.ignored == {12}
        assert heard.topics == ["/chat"] * (2 + 2 * round_) and len(heard.services) == 2 + 2 * round_
        graph.participant_added(Participant(SERN, "bridge of another name", "sern_two"))
        graph.participant_added(Participant(SERN, "bridge"))
        assert [writer.handle for writer in graph.writers("rt/chat")] == [12] and graph.ignored == set()
        assert heard.topics == ["/chat"] * (3 + 2 * round_) and len(heard.services) == 3 + 2 * round_


@pytest.mark.parametrize("with_participant", [False, True])
def test_what_was_told_as_of_this_site_is_told_when_it_goes(with_participant: bool) -> None:
    """Whatever its participant says of itself by then."""
    told: list[list[Remote]] = []

    class Watching(Heard):
        def writers_changed(self, name: RosName, topic: str) -> None:
            told.append(graph.writers(topic))

    graph = Graph(OWN, Watching())
    graph.participant_added(Participant(OTHER, "robot"))
    graph.remote_added(remote(11))
    assert told == [[remote(11)]]
    graph.participant_added(Participant(OTHER, "robot", "other"))
    assert told[1:] == [[]]
    if with_participant:
        graph.participant_removed(OTHER)
    else:
        graph.remote_removed(UUID(int=11))
    assert told[1:] == [[]] and graph.remotes == {} and graph.ignored == set()


def test_a_writer_that_changes_its_policies_goes_and_comes_again() -> None:
    seen: list[list[bool]] = []

    class Watching(Heard):
        def writers_changed(self, name: RosName, topic: str) -> None:
            seen.append([writer.qos.reliable for writer in graph.writers(topic)])

    graph = Graph(OWN, Watching())
    graph.participant_added(Participant(OTHER, "robot"))
    graph.local_added(Local(UUID(int=20), False, "rt/chat", STRING, EndpointQos(reliable=True)))
    graph.remote_added(remote(11))
    assert len(graph.complaints) == 1
    graph.remote_added(remote(11, qos=EndpointQos(reliable=True)))
    assert graph.complaints == {}
    graph.remote_added(remote(11, qos=EndpointQos(reliable=True)))
    assert seen == [[False], [], [True]]


class Network:
    """What discovery may tell, in any order, of three participants; and what follows from it, from scratch."""

    def __init__(self, *, heed_sern: bool) -> None:
        self.heard: dict[str, list[Remote]] = {}
        self.graph = Graph(OWN, self, heed_sern=heed_sern, own_guard="guard")
        self.participants: dict[UUID, Participant] = {}
        self.remotes: dict[UUID, Remote] = {}

    def writers_changed(self, name: RosName, topic: str) -> None:
        self.heard[topic] = self.graph.writers(topic)

    def services_changed(self, name: TopicName) -> None: ...

    def act(self, what: str, participant: int, number: int, variant: int) -> None:
        owner, guid = UUID(int=participant), UUID(int=100 + number)
        if what == "participant":
            self.participants[owner] = Participant(owner, "p", ("", "sern", "guard")[variant % 3])
            self.graph.participant_added(self.participants[owner])
        elif what == "no participant":
            self.participants.pop(owner, None)
            self.remotes = {key: one for key, one in self.remotes.items() if one.participant != owner}
            self.graph.participant_removed(owner)
        elif what == "remote":
            topic = f"rt/t{number % 2}"
            self.remotes[guid] = remote(100 + number, owner, topic, qos=EndpointQos(reliable=variant % 2 == 1))
            self.graph.remote_added(self.remotes[guid])
        else:
            self.remotes.pop(guid, None)
            self.graph.remote_removed(guid)

    def expected(self, topic: str) -> list[Remote]:
        def foreign(one: Remote) -> bool:
            owner = self.participants.get(one.participant)
            sern = owner.sern if owner is not None else ""
            return not sern or (self.graph.heed_sern and sern != "guard")

        here = [one for one in self.remotes.values() if one.topic == topic and foreign(one)]
        return sorted(here, key=lambda one: one.guid.bytes)


@given(
    heed_sern=st.booleans(),
    acts=st.lists(
        st.tuples(
            st.sampled_from(["participant", "no participant", "remote", "remote", "no remote"]),
            st.integers(2, 4),
            st.integers(0, 5),
            st.integers(0, 5),
        ),
        max_size=30,
    ),
)
@STEADY
def test_in_whatever_order_discovery_tells_it(heed_sern: bool, acts: list[tuple[str, int, int, int]]) -> None:
    network = Network(heed_sern=heed_sern)
    graph = network.graph
    for number in (1, 2):
        qos = EndpointQos(reliable=number == 1)
        graph.local_added(Local(UUID(int=number), False, f"rt/t{number - 1}", STRING, qos))
    for act in acts:
        network.act(*act)
        assert graph.remotes == network.remotes
        shown = []
        for topic in ("rt/t0", "rt/t1"):
            assert graph.writers(topic) == network.heard.get(topic, []) == network.expected(topic)
            shown += graph.writers(topic)
        assert graph.ignored == {one.handle for one in graph.remotes.values() if one not in shown}
        unreliable = {one.guid for one in shown if one.topic == "rt/t0" and not one.qos.reliable}
        assert {theirs for _, theirs in graph.complaints} == unreliable
    for participant in (2, 3, 4):
        network.act("no participant", participant, 0, 0)
    for number in (1, 2):
        graph.local_removed(UUID(int=number))
    empty = ("_of_participant", "_told", "_on_topic", "_locals_on", "_complained", "complaints", "ignored")
    assert [name for name in empty if getattr(graph, name)] == []
