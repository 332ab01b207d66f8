"""The graph of a DDS domain as the endpoint keeps it: whose readers and writers are, and what nodes say."""

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from sern_client.endpoints.dds import node_info
from sern_client.endpoints.dds.graph import (
    MAX_EARLY_NODES,
    MAX_IGNORED_BEFORE,
    MAX_UNNAMED,
    NAME_WAIT_S,
    Graph,
    Local,
    Participant,
    Remote,
)
from sern_client.endpoints.dds.names import RosName
from sern_client.endpoints.dds.node_info import Node
from sern_client.endpoints.dds.qos import EndpointQos
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from tests.exploring import cases
from tests.steps import steps

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


@pytest.mark.parametrize("accept_bridged", [False, True])
def test_the_graph_counts_what_is_of_this_site(accept_bridged: bool) -> None:
    heard = Heard()
    graph = Graph(OWN, heard, accept_bridged=accept_bridged)
    graph.participant_added(Participant(OTHER, "robot"))
    graph.participant_added(Participant(SERN, "bridge", "sern_two"))
    for number, participant in ((10, OWN), (11, OTHER), (12, SERN)):
        graph.remote_added(remote(number, participant))
        graph.remote_added(remote(number, participant))
    graph.remote_added(remote(13, topic="not_ros"))
    graph.remote_added(remote(14, topic="rq/set_boolRequest", writer=False))
    found = [writer.handle for writer in graph.writers("rt/chat")]
    assert found == ([11, 12] if accept_bridged else [11])
    assert graph.ignored == (set() if accept_bridged else {12})
    assert heard.topics == ["/chat"] * len(found) and heard.services == ["/set_bool"]
    graph.participant_removed(SERN)
    graph.participant_removed(OTHER)
    assert graph.writers("rt/chat") == [] and graph.ignored == set() and graph.remotes == {}
    graph.remote_removed(UUID(int=99))


def test_mismatches_are_said_once_and_forgotten_with_their_cause(caplog: pytest.LogCaptureFixture) -> None:
    graph = Graph(OWN, Heard())
    graph.participant_added(Participant(OTHER, "robot"))
    graph.nodes_of(OTHER, [Node("/ns/talker", UUID(int=11).bytes)])
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
    assert node_info.decode(body) == (OWN, [Node("/sern", UUID(int=5).bytes + UUID(int=6).bytes)])
    for length in range(len(body)):
        assert node_info.decode(body[:length]) is None
    assert node_info.decode(body + bytes(3)) is not None  # DDS pads
    assert node_info.decode(body + bytes(4)) is None


def test_node_information_of_before_iron() -> None:
    """Humble writes ids of 24 bytes, of which the last eight are zeros."""

    def old(guid: UUID) -> bytes:
        return guid.bytes + bytes(8)

    body = b"\0\1\0\0" + old(OTHER) + (1).to_bytes(4, "little")
    body += (4).to_bytes(4, "little") + b"/ns\0" + (7).to_bytes(4, "little") + b"talker\0\0"
    body += (1).to_bytes(4, "little") + old(UUID(int=5)) + (2).to_bytes(4, "little")
    body += old(UUID(int=6)) + old(UUID(int=7))
    gids = b"".join(UUID(int=number).bytes for number in (5, 6, 7))
    assert node_info.decode(body) == (OTHER, [Node("/ns/talker", gids)])
    nobody = 4 + 16 + 4  # an id of 16 bytes and no node, as today's layout has it
    for length in (*range(nobody), *range(nobody + 4, len(body))):
        assert node_info.decode(body[:length]) is None
    assert node_info.decode(body[:nobody]) == (OTHER, [])
    assert node_info.decode(b"\0\1\0\0" + old(OTHER) + bytes(4)) == (OTHER, [])


def test_node_information_is_told_to_iron_and_later_only() -> None:
    seen: list[bool] = []
    graph = Graph(OWN, Heard(), modern_seen=lambda: seen.append(graph.modern))
    graph.participant_added(Participant(OWN, "sern", "sern"))  # discovery shows us ourselves too
    graph.participant_added(Participant(OTHER, "robot"))
    graph.remote_added(remote(11))
    assert (graph.modern, seen) == (False, [])
    for number in (12, 13):
        graph.remote_added(remote(number, qos=EndpointQos(type_hash="RIHS01_1")))
    assert seen == [True], "once"
    other = Graph(OWN, Heard())
    other.participant_added(Participant(SERN, "bridge", "sern_two"))
    assert other.modern, "another SERN endpoint reads it as well"


GUIDS = st.lists(st.uuids(), max_size=4)
NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9)


@given(participant=st.uuids(), nodes=st.lists(st.tuples(NAMES, NAMES, GUIDS, GUIDS), max_size=4))
@STEADY
def test_what_others_say_of_their_nodes(
    participant: UUID, nodes: list[tuple[str, str, list[UUID], list[UUID]]]
) -> None:
    """Bytes of the serialiser are read back."""

    def new(name: str, **fields: Any) -> Any:
        return ros_types.new(f"rmw_dds_common/msg/{name}", Encoding.CDR, **fields)

    def gid(guid: UUID) -> Any:
        return new("Gid", data=np.frombuffer(guid.bytes, dtype="uint8"))

    entities = [
        new(
            "NodeEntitiesInfo",
            node_namespace=namespace,
            node_name=name,
            reader_gid_seq=[gid(guid) for guid in readers],
            writer_gid_seq=[gid(guid) for guid in writers],
        )
        for namespace, name, readers, writers in nodes
    ]
    info = new("ParticipantEntitiesInfo", gid=gid(participant), node_entities_info_seq=entities)
    found = node_info.decode(ros_types.serialise(info, node_info.TYPE, Encoding.CDR))
    assert found is not None and found[0] == participant
    assert [(node.name, node.gids) for node in found[1]] == [
        (f"{namespace.rstrip('/')}/{name}", b"".join(guid.bytes for guid in (*readers, *writers)))
        for namespace, name, readers, writers in nodes
    ]
    assert set(node_info.by_entity(found[1])) == {
        guid.bytes for *_, readers, writers in nodes for guid in (*readers, *writers)
    }


def test_the_first_node_that_names_a_reader_or_writer_has_it() -> None:
    there, other = UUID(int=1), UUID(int=2)
    nodes = [Node("/empty", b""), Node("/one", there.bytes), Node("/two", other.bytes + there.bytes)]
    assert node_info.by_entity(nodes) == {there.bytes: "/one", other.bytes: "/two"}


def test_whose_it_is_costs_the_same_however_many_nodes_were_said() -> None:
    def cost(nodes: int) -> int:
        graph = Graph(OWN, Heard())
        graph.participant_added(Participant(OTHER))
        graph.nodes_of(OTHER, [Node(f"/n{number}", UUID(int=number).bytes) for number in range(nodes)])
        last = remote(nodes - 1)
        assert graph.owner(last) == f"node /n{nodes - 1}"
        return steps(lambda: graph.owner(last))

    assert cost(2000) == cost(10)


def test_what_is_said_anew_of_nodes_holds() -> None:
    graph = Graph(OWN, Heard())
    graph.participant_added(Participant(OTHER))
    for name in ("/before", "/after"):
        graph.nodes_of(OTHER, [Node(name, UUID(int=11).bytes)])
        assert graph.owner(remote(11)) == f"node {name}"
    graph.participant_removed(OTHER)
    assert graph.owner(remote(11)).startswith("participant without a name")


class Later:
    """Calls that wait for their time."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], None]] = []

    def __call__(self, delay_s: float, call: Callable[[], None]) -> None:
        assert delay_s == NAME_WAIT_S
        self.calls.append(call)


def test_a_line_waits_for_the_name_of_the_node(caplog: pytest.LogCaptureFixture) -> None:
    """Each pair once: when the node is known, or when its time is over; not of what has gone meanwhile."""
    later = Later()
    graph = Graph(OWN, Heard(), later=later)
    graph.participant_added(Participant(OTHER, "robot"))
    graph.local_added(Local(UUID(int=20), False, "rt/chat", STRING, EndpointQos(reliable=True)))
    for number in (11, 12, 13):
        graph.remote_added(remote(number))
    assert caplog.messages == [] and len(graph.complaints) == 3
    graph.nodes_of(OTHER, [Node("/early", UUID(int=99).bytes)])
    assert caplog.messages == []
    graph.remote_removed(UUID(int=13))
    graph.nodes_of(OTHER, [Node("/talker", UUID(int=11).bytes)])
    (line,) = caplog.messages
    assert line.startswith("/chat: the publisher of node /talker and we do not match: reliability")
    assert line in graph.complaints.values()
    for call in later.calls:
        call()
    assert len(caplog.messages) == 2
    assert caplog.messages[1].startswith("/chat: the publisher of participant robot (")


def test_what_is_said_about_the_same_waits_once_and_only_so_much_waits() -> None:
    later, said = Later(), Counter[int]()
    graph = Graph(OWN, Heard(), later=later)
    graph.participant_added(Participant(OTHER, "robot"))
    for _ in range(3):
        for number in range(MAX_UNNAMED + 5):
            graph.when_named(remote(number), partial(said.update, [number]), number)
    assert said == dict.fromkeys(range(MAX_UNNAMED, MAX_UNNAMED + 5), 3), "for these there is no room"
    assert len(later.calls) == MAX_UNNAMED
    for call in later.calls:
        call()
        call()
    assert [said[number] for number in range(MAX_UNNAMED)] == [1] * MAX_UNNAMED


def test_bodies_in_the_other_byte_order() -> None:
    body = b"\0\0\0\0" + OTHER.bytes + (1).to_bytes(4, "big") + (3).to_bytes(4, "big") + b"/a\0" + b"\0"
    body += (2).to_bytes(4, "big") + b"b\0" + bytes(2) + (1).to_bytes(4, "big") + SERN.bytes + bytes(4)
    assert node_info.decode(body) == (OTHER, [Node("/a/b", SERN.bytes)])
    assert node_info.decode(b"\0\1" + body[2:]) is None


@given(st.binary(max_size=200))
@STEADY
def test_node_information_that_is_none(rest: bytes) -> None:
    found = node_info.decode(b"\0\1\0\0" + OTHER.bytes + rest)
    assert found is None or found[0] == OTHER


def test_node_information_has_a_limit() -> None:
    body = node_info.encode(OWN, "sern", [], [UUID(int=number) for number in range(4090)])
    assert len(body) <= node_info.MAX_BODY_BYTES and node_info.decode(body) is not None
    body = node_info.encode(OWN, "sern", [], [UUID(int=number) for number in range(4100)])
    assert len(body) > node_info.MAX_BODY_BYTES and node_info.decode(body) is None


def test_nodes_of_invented_participants_do_not_pile_up() -> None:
    """Bodies may be earlier than their participants, so some are kept."""
    graph = Graph(OWN, Heard())
    graph.participant_added(Participant(OTHER, "robot"))
    graph.nodes_of(OTHER, [Node("/known", UUID(int=11).bytes)])
    graph.nodes_of(SERN, [Node("/early", UUID(int=12).bytes)])
    graph.participant_added(Participant(SERN, "other"))
    late = UUID(int=10_000)
    for number in range(10_001 - 3 * MAX_EARLY_NODES, 10_001):
        graph.nodes_of(UUID(int=number), [Node("/invented", UUID(int=13).bytes)])
    assert len(graph._early_nodes) == MAX_EARLY_NODES and len(graph._nodes) == 2
    graph.participant_added(Participant(late))
    owners = [remote(11, OTHER), remote(12, SERN), remote(13, late), remote(13, UUID(int=9999))]
    assert [graph.owner(one) for one in owners[:3]] == ["node /known", "node /early", "node /invented"]
    assert graph.owner(owners[3]).startswith("participant without a name")
    graph.participant_removed(OTHER)
    assert graph.owner(remote(11, OTHER)).startswith("participant without a name")


def test_what_is_said_of_peers_is_short(caplog: pytest.LogCaptureFixture) -> None:
    long = "x" * 60_000
    graph = Graph(OWN, Heard())
    graph.participant_added(Participant(OTHER, long))
    graph.local_added(Local(UUID(int=20), False, "rt/chat", STRING, EndpointQos(type_hash="a")))
    graph.remote_added(remote(11, type_name=long))
    graph.remote_added(remote(12, qos=EndpointQos(type_hash=long)))
    graph.nodes_of(OTHER, [Node("/" + long, UUID(int=13).bytes)])
    graph.remote_added(remote(13, type_name="T"))
    assert len(graph.complaints) == 3 and max(map(len, graph.complaints.values())) < 700
    assert max(map(len, caplog.messages)) < 700


def test_a_participant_that_goes_tells_each_topic_once() -> None:
    heard = Heard()
    graph = Graph(OWN, heard)
    graph.participant_added(Participant(OTHER, "robot"))
    graph.participant_added(Participant(SERN, "other"))
    for number in range(200):
        graph.remote_added(remote(1000 + number, topic=f"rt/t{number % 2}"))
    graph.remote_added(remote(5000, SERN, "rt/t0"))
    for number, topic in enumerate(("rq/aRequest", "rr/aReply", "rr/bReply")):
        graph.remote_added(remote(2000 + number, topic=topic, writer=topic.startswith("rr")))
    heard.topics.clear()
    heard.services.clear()
    graph.participant_removed(OTHER)
    assert heard.topics == ["/t0", "/t1"] and heard.services == ["/a", "/b"]
    assert [one.guid for one in graph.writers("rt/t0")] == [UUID(int=5000)] and graph.writers("rt/t1") == []


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


def test_the_last_words_of_a_writer_of_sern_are_not_taken_for_a_robots() -> None:
    """DDS may tell that it went before it gives its last sample."""
    graph = Graph(OWN, Heard())
    graph.participant_added(Participant(SERN, "bridge", "sern_two"))
    graph.remote_added(remote(12, SERN))
    graph.remote_added(remote(11))
    graph.remote_removed(UUID(int=12))
    graph.remote_removed(UUID(int=11))
    assert graph.ignores(12) and not graph.ignores(11) and graph.ignored == set()
    graph.participant_added(Participant(SERN, "robot after all"))
    graph.remote_added(remote(12, SERN))
    assert not graph.ignores(12)
    graph.participant_added(Participant(SERN, "bridge", "sern_two"))
    for number in range(100, 101 + MAX_IGNORED_BEFORE):
        graph.remote_added(remote(number, SERN))
        graph.remote_removed(UUID(int=number))
    assert graph.ignores(12) and not graph.ignores(100) and graph.ignores(101)
    assert len(graph._ignored_before) == MAX_IGNORED_BEFORE


class Network:
    """What discovery may tell, in any order, of three participants; and what follows from it, from scratch."""

    def __init__(self, *, accept_bridged: bool) -> None:
        self.heard: dict[str, list[Remote]] = {}
        self.graph = Graph(OWN, self, accept_bridged=accept_bridged, own_guard="guard")
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
            return not sern or (self.graph.accept_bridged and sern != "guard")

        here = [one for one in self.remotes.values() if one.topic == topic and foreign(one)]
        return sorted(here, key=lambda one: one.guid.bytes)


@given(
    accept_bridged=st.booleans(),
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
def test_in_whatever_order_discovery_tells_it(accept_bridged: bool, acts: list[tuple[str, int, int, int]]) -> None:
    network = Network(accept_bridged=accept_bridged)
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
        for one in network.remotes.values():
            assert graph.writer(one.handle) == one
        assert graph.ignored == {one.handle for one in graph.remotes.values() if one not in shown}
        unreliable = {one.guid for one in shown if one.topic == "rt/t0" and not one.qos.reliable}
        assert {theirs for _, theirs in graph.complaints} == unreliable
    for participant in (2, 3, 4):
        network.act("no participant", participant, 0, 0)
    for number in (1, 2):
        graph.local_removed(UUID(int=number))
    empty = ("_writers", "_of_participant", "_told", "_on_topic", "_locals_on", "_complained", "complaints", "ignored")
    assert [name for name in empty if getattr(graph, name)] == []
